"""Conditions as the denoiser gets them: their noise, and image tokens without an encoder."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.conditioning.layout import DWM_WAN
from egosim_jax.conditioning.posterior import EncodingNoise
from egosim_jax.generation.encoding import pack
from egosim_jax.generation.generator import Generator
from egosim_jax.testing import random_triplet, tiny_model
from tests import shown

DIT = tiny_model().dit
MODEL = tiny_model(image=None, dit=replace(DIT, image_dim=None), layout=DWM_WAN, steps=1)
TOKENS = replace(MODEL, dit=DIT, zero_image_tokens=3)
SEEDS = (1, 2, 3, 4, 5, 6, 7, 8)


@pytest.fixture(autouse=True)
def uncached(monkeypatch):
    shown.uncached(monkeypatch)


@pytest.fixture(scope="module")
def clip():
    """A prior whose left half is black, and hands of another gray."""
    noise = random_triplet(MODEL.video, observed=True)
    prior, hands = np.full_like(noise.prior, 140), np.full_like(noise.hands, 200)
    prior[:, :, : prior.shape[2] // 2] = 0
    return replace(noise, prior=prior, hands=hands)


def latents(clip, part, noise=None, model=MODEL, seeds=SEEDS):
    """Return the latents of a part of the condition, as generation encodes it."""
    model = replace(model, encoding_noise=noise)
    generator = Generator(model, shown.networks(model, part))
    return np.asarray(generator.latents([clip] * len(seeds), seeds))


def same(one, other):
    return np.allclose(one, other, rtol=0, atol=1e-5)


def test_the_hands_alone_are_drawn_from_their_posterior(clip):
    noise = EncodingNoise(hands=True)
    assert same(latents(clip, "prior", noise), latents(clip, "prior"))
    mean, drawn = latents(clip, "hands"), latents(clip, "hands", noise)
    assert same(mean, (2 * 200 / 255 - 1) / 2)
    assert (drawn - mean).std() == pytest.approx(0.25, rel=0.05)
    assert abs((drawn - mean).mean()) < 0.02
    assert not same(drawn[0], drawn[1])
    assert same(latents(clip, "hands", noise, seeds=SEEDS[1:3]), drawn[1:3])


def test_pixels_of_the_prior_alone_get_noise_unless_they_are_black(clip):
    noise = EncodingNoise(prior_pixels=0.2)
    assert same(latents(clip, "hands", noise), latents(clip, "hands"))
    mean, noisy = latents(clip, "prior"), latents(clip, "prior", noise)
    black = mean.shape[3] // 2
    assert same(noisy[:, :, :, :black], -0.5)
    added = (noisy - mean)[:, :, :, black:]
    values = 3 * shown.CELL**2  # whose mean, halved, is a latent
    assert added.std() == pytest.approx(0.2 / values**0.5 / 2, rel=0.3)
    assert not same(added[0], added[1])


def test_image_tokens_without_an_encoder_are_zeros_unless_a_clip_has_others(clip):
    zeros = np.zeros((3, DIT.image_dim), np.float32)
    np.testing.assert_array_equal(pack([clip], TOKENS)["image"], zeros[None])
    without = latents(clip, "hands", model=TOKENS)
    given = latents(replace(clip, tokens=zeros), "hands", model=TOKENS)
    np.testing.assert_array_equal(without, given)
    assert same(without, latents(clip, "hands"))
    other = latents(replace(clip, tokens=zeros + 1), "hands", model=TOKENS)
    assert same(other, without + 1)
