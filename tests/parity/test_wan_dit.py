"""The video transformer and its name tables against diffusers, run in float64."""

import jax
import numpy as np
import pytest
import torch
from diffusers import WanTransformer3DModel
from diffusers.loaders.single_file_utils import convert_wan_transformer_to_diffusers
from einops import rearrange
from flax import nnx

from egosim_jax.convert.tables import wan_dit as table
from egosim_jax.io.weights import fill
from egosim_jax.models.wan.dit import WanDiT, WanDiTConfig
from tests.translation import translate, translate_back

TOLERANCE = 1e-6
"""Relative L2 of float32 against float64: two blocks of sums over 512 to 768 terms."""

TEXT_TO_VIDEO, IMAGE_TO_VIDEO, EGOSIM = 16, 36, 52
TEXT_TOKENS, IMAGE_TOKENS = 512, 257
"""diffusers splits the joint context 512 tokens before its end, so that both counts are fixed."""


class Float64Sinusoid(torch.nn.Module):
    """The time's cosines and sines in float64, where diffusers' own has float32 angles."""

    def forward(self, t):
        angles = [[float(time) * 10000 ** (-i / 128) for i in range(128)] for time in t]
        angles = torch.tensor(angles, dtype=torch.float64)
        return torch.cat([torch.cos(angles), torch.sin(angles)], dim=-1)


def config_of(channels):
    image_dim = None if channels == TEXT_TO_VIDEO else 96
    return WanDiTConfig(
        in_channels=channels,
        dim=512,
        heads=4,
        ffn_dim=768,
        layers=2,
        text_dim=256,
        image_dim=image_dim,
    )


def reference(channels):
    """diffusers' model with random gains and biases: ones and zeros would hide errors."""
    config = config_of(channels)
    torch.manual_seed(channels)
    model = WanTransformer3DModel(
        num_attention_heads=config.heads,
        attention_head_dim=config.head_dim,
        in_channels=config.in_channels,
        out_channels=config.out_channels,
        text_dim=config.text_dim,
        ffn_dim=config.ffn_dim,
        num_layers=config.layers,
        cross_attn_norm=True,
        eps=config.eps,
        image_dim=config.image_dim,
        added_kv_proj_dim=config.image_dim and config.dim,
    ).eval()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "norm" in name and name.endswith("weight"):
                parameter.uniform_(0.5, 1.5)
            elif name.endswith("bias"):
                parameter.normal_(std=0.3)
    return model


velocity = nnx.jit(lambda network, *inputs: network(*inputs))


@pytest.fixture(scope="module", params=[TEXT_TO_VIDEO, IMAGE_TO_VIDEO, EGOSIM])
def pair(request):
    theirs, config = reference(request.param), config_of(request.param)
    state = {name: tensor.numpy() for name, tensor in theirs.state_dict().items()}
    ours = nnx.eval_shape(lambda: WanDiT(config, rngs=nnx.Rngs(0)))
    fill(ours, translate(state, table.diffusers(config), ignore=table.TABLE.ignored(config)))
    theirs = theirs.double()
    theirs.condition_embedder.timesteps_proj = Float64Sinusoid()
    return ours, theirs


@pytest.mark.parametrize("time", [1000, 500, 92.6])
def test_velocity_is_that_of_diffusers_in_float64(pair, time, monkeypatch):
    # Its norms and residual sums are cast to float32 by .float().
    monkeypatch.setattr(torch.Tensor, "float", torch.Tensor.double)
    ours, theirs = pair
    config = ours.config
    draw = np.random.default_rng(0).standard_normal
    latents = draw((2, 3, 8, 12, config.in_channels)).astype(np.float32)
    text = draw((2, TEXT_TOKENS, config.text_dim)).astype(np.float32)
    image = None
    if config.image_dim is not None:
        image = draw((2, IMAGE_TOKENS, config.image_dim)).astype(np.float32)
    t = np.full(2, time, np.float32)
    with jax.default_matmul_precision("highest"):
        have = np.asarray(velocity(ours, latents, t, text, image))
    with torch.no_grad():
        want = theirs(
            double(rearrange(latents, "b f h w c -> b c f h w")),
            double(t),
            double(text),
            None if image is None else double(image),
            return_dict=False,
        )[0]
    want = rearrange(want.numpy(), "b c f h w -> b f h w c")
    assert want.dtype == np.float64
    assert np.linalg.norm(have - want) <= TOLERANCE * np.linalg.norm(want)


def double(array):
    return torch.from_numpy(array).double()


@pytest.mark.parametrize("channels", [TEXT_TO_VIDEO, EGOSIM])
def test_official_names_are_those_that_the_converter_of_diffusers_reads(channels):
    config = config_of(channels)
    theirs = {name: tensor.numpy() for name, tensor in reference(channels).state_dict().items()}
    ours = translate(theirs, table.diffusers(config))
    official = translate_back(ours, table.wan(config))
    converted = convert_wan_transformer_to_diffusers(dict(official))
    assert converted.keys() == theirs.keys()
    assert all(np.array_equal(converted[name], theirs[name]) for name in theirs)


def test_official_tensors_come_back_unchanged():
    config = config_of(EGOSIM)
    theirs = {name: tensor.numpy() for name, tensor in reference(EGOSIM).state_dict().items()}
    official = translate_back(translate(theirs, table.diffusers(config)), table.wan(config))
    assert official["patch_embedding.weight"].shape == (512, 52, 1, 2, 2)
    again = translate_back(translate(official, table.wan(config)), table.wan(config))
    assert again.keys() == official.keys()
    assert all(np.array_equal(again[name], official[name]) for name in official)
