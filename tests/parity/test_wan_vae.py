"""The video VAE and its name tables against diffusers and the released file."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLWan
from flax import nnx

from egosim_jax.convert.tables import wan_vae as table
from egosim_jax.io.weights import fill, flat_shapes
from egosim_jax.models.wan.vae import WanVAE, WanVAEConfig
from tests.translation import translate, translate_back

CONFIG = WanVAEConfig(dim=8)
TOLERANCE = 1e-5
"""Relative L2 in float32: the order of sums over up to 864 terms in some 40 convolutions."""
QUICK = {"xla_backend_optimization_level": 0}
"""Compiler options: the arrays are so small that compiling is what takes time."""


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
    fill(model, translate(state, table.diffusers(CONFIG), ignore=table.TABLE.ignored(CONFIG)))
    return model


def relative_error(have, want):
    return np.linalg.norm(np.asarray(have) - want) / np.linalg.norm(want)


@pytest.mark.parametrize("frames", [1, 5, 17])
def test_encoding_gives_the_moments_of_diffusers(ours, theirs, frames):
    video = np.random.default_rng(0).uniform(-1, 1, (1, frames, 32, 24, 3)).astype(np.float32)
    with torch.no_grad():
        posterior = theirs.encode(torch.tensor(video).permute(0, 4, 1, 2, 3)).latent_dist
    mean, logvar = (x.permute(0, 2, 3, 4, 1).numpy() for x in (posterior.mean, posterior.logvar))
    with jax.default_matmul_precision("highest"):
        both = jax.jit(lambda x: (ours.encode(x), *ours.moments(x)), compiler_options=QUICK)
        have = both(video)
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
        have = jax.jit(ours.decode, compiler_options=QUICK)(jnp.array(latents))
    assert relative_error(have, video.permute(0, 2, 3, 4, 1).numpy()) <= TOLERANCE


def test_a_decoder_of_another_width_has_the_shapes_of_diffusers():
    config = WanVAEConfig(dim=8, decoder_dim=12)
    with torch.device("meta"):
        module = AutoencoderKLWan(**table.arguments(config))
    vae = nnx.eval_shape(lambda: WanVAE(config, rngs=nnx.Rngs(0)))
    arrays = {
        path: np.broadcast_to(np.float32(0), shape) for path, shape in flat_shapes(vae).items()
    }
    have = translate_back(arrays, table.diffusers(config))
    want = {name: tuple(tensor.shape) for name, tensor in module.state_dict().items()}
    assert {name: tensor.shape for name, tensor in have.items()} == want


def test_official_names_and_shapes_are_those_of_the_released_file():
    config = WanVAEConfig()
    vae = nnx.eval_shape(lambda: WanVAE(config, rngs=nnx.Rngs(0)))
    full_size = {
        path: np.broadcast_to(np.float32(0), shape) for path, shape in flat_shapes(vae).items()
    }
    have = {
        name: tensor.shape for name, tensor in translate_back(full_size, table.wan(config)).items()
    }
    want = released_shapes()
    assert len(want) == 194
    assert have == want


def released_shapes():
    """Every tensor of the released file, block by block."""
    down, up = "encoder.downsamples", "decoder.upsamples"
    shapes = {
        **conv("conv1", 32, 32, 1, 1, 1),
        **conv("conv2", 16, 16, 1, 1, 1),
        **conv("encoder.conv1", 3, 96, 3, 3, 3),
        **conv(f"{down}.2.resample.1", 96, 96, 3, 3),
        **conv("encoder.head.2", 384, 32, 3, 3, 3),
        "encoder.head.0.gamma": (384, 1, 1, 1),
        **conv("decoder.conv1", 16, 384, 3, 3, 3),
        **conv(f"{up}.11.resample.1", 192, 96, 3, 3),
        **conv("decoder.head.2", 96, 3, 3, 3, 3),
        "decoder.head.0.gamma": (96, 1, 1, 1),
    }
    for layer, width in ((5, 192), (8, 384)):
        shapes |= conv(f"{down}.{layer}.resample.1", width, width, 3, 3)
        shapes |= conv(f"{down}.{layer}.time_conv", width, width, 3, 1, 1)
    for layer in (3, 7):
        shapes |= conv(f"{up}.{layer}.resample.1", 384, 192, 3, 3)
        shapes |= conv(f"{up}.{layer}.time_conv", 384, 768, 3, 1, 1)
    for half in ("encoder", "decoder"):
        shapes |= residual(f"{half}.middle.0", 384, 384) | residual(f"{half}.middle.2", 384, 384)
        shapes |= conv(f"{half}.middle.1.to_qkv", 384, 1152, 1, 1)
        shapes |= conv(f"{half}.middle.1.proj", 384, 384, 1, 1)
        shapes |= {f"{half}.middle.1.norm.gamma": (384, 1, 1)}
    blocks = {
        down: {(96, 96): (0, 1), (96, 192): (3,), (192, 192): (4,), (192, 384): (6,)}
        | {(384, 384): (7, 9, 10)},
        up: {(384, 384): (0, 1, 2, 5, 6), (192, 384): (4,), (192, 192): (8, 9, 10)}
        | {(96, 96): (12, 13, 14)},
    }
    for side, by_width in blocks.items():
        for (before, after), layers in by_width.items():
            for layer in layers:
                shapes |= residual(f"{side}.{layer}", before, after)
    return shapes


def conv(name, before, after, *size):
    return {f"{name}.weight": (after, before, *size), f"{name}.bias": (after,)}


def residual(name, before, after):
    return {
        f"{name}.residual.0.gamma": (before, 1, 1, 1),
        **conv(f"{name}.residual.2", before, after, 3, 3, 3),
        f"{name}.residual.3.gamma": (after, 1, 1, 1),
        **conv(f"{name}.residual.6", after, after, 3, 3, 3),
        **(conv(f"{name}.shortcut", before, after, 1, 1, 1) if before != after else {}),
    }


@pytest.mark.parametrize("naming", [table.wan, table.diffusers])
def test_translating_there_and_back_gives_every_weight_again(ours, naming):
    rules = naming(CONFIG)
    weights = {
        ".".join(map(str, path)): np.asarray(leaf.get_value())
        for path, leaf in nnx.to_flat_state(nnx.state(ours, nnx.Param))
    }
    again = translate(translate_back(weights, rules), rules)
    assert again.keys() == weights.keys()
    for path, tensor in weights.items():
        np.testing.assert_array_equal(again[path], tensor)
