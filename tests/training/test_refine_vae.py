"""A wider decoder that starts from a narrower one."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from flax import nnx

from egosim_jax.io import weights
from egosim_jax.io.weights import WeightsError
from egosim_jax.models import abstract
from egosim_jax.models.wan.vae import WanVAEConfig
from egosim_jax.train.refine_vae import widen_decoder

NARROW = WanVAEConfig(
    dim=4, dim_mult=(1, 2, 3, 5), res_blocks=1, latent_mean=(0.0,) * 16, latent_std=(1.0,) * 16
)
ERROR = 2e-5
"""Maximum relative difference of float32 videos, whose sums have another order."""


@pytest.fixture(scope="module")
def narrow(tmp_path_factory):
    vae, draw = abstract(NARROW), np.random.default_rng(0)
    shapes = weights.flat_shapes(vae)
    weights.fill(vae, {name: 0.2 * draw.normal(size=shapes[name]) for name in shapes})
    folder = tmp_path_factory.mktemp("narrow")
    weights.save(folder / "vae.safetensors", vae)
    weights.write(folder / "text.safetensors", {"table": np.ones(3, np.float32)})
    return vae, folder


def load_wide(folder, out, *, decoder_dim):
    config = replace(NARROW, decoder_dim=decoder_dim)
    vae = abstract(config)
    weights.load(widen_decoder(config, folder, out) / "vae.safetensors", vae)
    return vae


def test_it_decodes_what_the_narrower_one_does(narrow, tmp_path):
    vae, folder = narrow
    wide = load_wide(folder, tmp_path / "wide", decoder_dim=5)
    latents = jax.random.normal(jax.random.key(1), (1, 2, 2, 3, 16))
    decode = nnx.jit(lambda vae: vae.decode_whole(latents))
    expected, found = decode(vae), decode(wide)
    assert np.linalg.norm(found - expected) <= ERROR * np.linalg.norm(expected)
    copied, text = (weights.hashes(f, only=["text"]) for f in (tmp_path / "wide", folder))
    assert copied == text != {}


def test_every_new_channel_is_trained(narrow, tmp_path):
    _, folder = narrow
    wide = load_wide(folder, tmp_path / "wide", decoder_dim=6)
    latents = jax.random.normal(jax.random.key(1), (1, 2, 2, 3, 16))
    loss = lambda vae: (vae.decode_whole(latents) ** 2).mean()  # noqa: E731
    gradients = nnx.jit(nnx.grad(loss))(wide)
    kernel = gradients.decoder.levels[0].conv1.kernel[...]
    assert (np.abs(kernel[..., :, 20:]).max(axis=(0, 1, 2, 3)) > 0).all()


def test_weights_of_the_same_width_are_used_as_they_are(narrow, tmp_path):
    _, folder = narrow
    assert widen_decoder(NARROW, folder, tmp_path / "wide") == folder


def test_another_encoder_is_refused(narrow, tmp_path):
    _, folder = narrow
    with pytest.raises(WeightsError, match=r"encoder"):
        widen_decoder(replace(NARROW, dim=6, decoder_dim=6), folder, tmp_path / "wide")
