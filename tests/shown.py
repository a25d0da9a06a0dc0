"""Networks without layers, so that a generated clip shows one of its conditions."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from einops import reduce, repeat
from flax import nnx

from egosim_jax.configs.model import Networks
from egosim_jax.data.clips import write_clips
from egosim_jax.data.metadata import read_metadata
from egosim_jax.data.windows import windows_of
from egosim_jax.testing import random_triplet, tiny_model

CELL, STRIDE = 8, 4


class Codec(nnx.Module):
    """Codec whose latents are half the gray of a cell; their posterior has deviation 0.25."""

    def moments(self, video):
        gray = video[:, ::STRIDE].mean(-1, keepdims=True)
        cells = reduce(gray, "b f (h y) (w x) c -> b f h w c", "mean", y=CELL, x=CELL)
        mean = jnp.repeat(cells, 16, axis=-1)
        return mean, jnp.full_like(mean, 2 * np.log(0.5))

    def normalize(self, mean):
        return mean / 2

    def encode(self, video):
        return self.normalize(self.moments(video)[0])

    def decode(self, latents):
        gray = repeat(2 * latents[..., :3], "b f h w c -> b f (h y) (w x) c", y=CELL, x=CELL)
        return jnp.repeat(gray, STRIDE, axis=1)[:, STRIDE - 1 :].clip(-1, 1)


class Text(nnx.Module):
    """Encoder of any prompt to zeros."""

    def __init__(self, dim):
        self.dim = dim

    def __call__(self, ids, mask):
        return jnp.zeros((*ids.shape, self.dim))


class Denoiser(nnx.Module):
    """Denoiser of one Euler step from noise to a part of its condition, plus its image tokens."""

    def __init__(self, channels, tokens):
        self.channels, self.tokens = channels, tokens

    def prepare(self, condition, text, image=None):
        assert (0 if image is None else image.shape[1]) == self.tokens
        shown = condition[..., self.channels]
        return shown if image is None else shown + image.mean((1, 2))[:, None, None, None, None]

    def denoise(self, noisy, t, context):
        return noisy - context


def networks(model, part):
    """Return networks that show `part` of the condition, for a model of one Euler step."""
    where, noisy = model.layout.slice(part), model.layout.count("noisy")
    dit = Denoiser(slice(where.start - noisy, where.stop - noisy), model.image_tokens)
    return Networks(dit=dit, vae=Codec(), text=Text(model.text.dim))


MODEL = tiny_model(image=None, dit=replace(tiny_model().dit, image_dim=None), steps=1)
"""Model of one Euler step, whose condition has no image."""


def show_hands(monkeypatch):
    """Replace the networks of batch jobs of `MODEL`: a clip ends as bright as its hands."""
    uncached(monkeypatch)
    made = networks(MODEL, "hands")
    monkeypatch.setattr("egosim_jax.generation.batch.Networks.random", lambda config, *, seed: made)


def windows_of_hands(folder, grays, **changes):
    """Write a clip of `MODEL` for each gray of its hands; return their windows."""
    clip = replace(random_triplet(MODEL.video), **changes)
    clips = [
        replace(clip, video_id=name, hands=np.full_like(clip.hands, gray))
        for name, gray in grays.items()
    ]
    return windows_of(read_metadata(write_clips(folder, clips, fps=MODEL.video.fps)), (0,))


def uncached(monkeypatch):
    """Compile without the cache, which knows networks by their configs alone."""
    monkeypatch.setattr(
        "egosim_jax.generation.compiled.cached_compile",
        lambda key, args, compile, about: compile(),
    )
