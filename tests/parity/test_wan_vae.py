"""The video VAE and its name tables against diffusers and the released file."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLWan
from flax import nnx

from egosim_jax.convert.tables import wan_vae as table
from egosim_jax.io.weights import fill, flat_shapes, translate, translate_back
from egosim_jax.models.wan_vae import WanVAE, WanVAEConfig

CONFIG = WanVAEConfig(dim=8)
TOLERANCE = 1e-5
"""Relative L2 in float32: the order of sums over up to 864 terms in some 40 convolutions."""


@pytest.fixture(scope="module")
def theirs():
    torch.manual_seed(0)
    model = AutoencoderKLWan(base_dim=CONFIG.dim, z_dim=CONFIG.z_dim).eval()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.endswith("gamma"):
                parameter.uniform_(0.5, 1.5)
            elif name.endswith("bias"):
                parameter.normal_(std=0.1)
    return model


@pytest.fixture(scope="module")
def ours(theirs):
    model = nnx.eval_shape(lambda: WanVAE(CONFIG, rngs=nnx.Rngs(0)))
    state = {name: tensor.numpy() for name, tensor in theirs.state_dict().items()}
    fill(model, translate(state, table.diffusers(CONFIG), ignore=table.ignored(CONFIG)))
    return model


def relative_error(have, want):
    return np.linalg.norm(np.asarray(have) - want) / np.linalg.norm(want)


@pytest.mark.parametrize("frames", [1, 5, 17])
def test_encoding_gives_the_moments_of_diffusers(ours, theirs, frames):
    video = np.random.default_rng(0).uniform(-1, 1, (1, frames, 32, 24, 3)).astype(np.float32)
    with torch.no_grad():
        posterior = theirs.encode(torch.tensor(video).permute(0, 4, 1, 2, 3)).latent_dist
    mean, logvar = (
        x.permute(0, 2, 3, 4, 1).numpy() for x in (posterior.mean, posterior.logvar)
    )
    with jax.default_matmul_precision("highest"):
        have = jax.jit(lambda x: (ours.encode(x), *ours.moments(x)))(video)
    latents = (mean - np.array(CONFIG.latent_mean)) / np.array(CONFIG.latent_std)
    for part, want in zip(have, (latents, mean, logvar), strict=True):
        assert relative_error(part, want) <= TOLERANCE


@pytest.mark.parametrize("frames", [1, 2, 5])
def test_decoding_gives_the_video_of_diffusers(ours, theirs, frames):
    latents = np.random.default_rng(0).normal(size=(1, frames, 4, 3, 16)).astype(np.float32)
    hidden = latents * np.array(CONFIG.latent_std) + np.array(CONFIG.latent_mean)
    with torch.no_grad():
        video = theirs.decode(torch.tensor(hidden).float().permute(0, 4, 1, 2, 3)).sample
    with jax.default_matmul_precision("highest"):
        have = jax.jit(ours.decode)(jnp.array(latents))
    assert relative_error(have, video.permute(0, 2, 3, 4, 1).numpy()) <= TOLERANCE
