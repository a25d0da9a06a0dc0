"""The CLIP image encoder and its name tables against transformers and the released file."""

from fnmatch import fnmatchcase

import jax
import numpy as np
import pytest
import torch
from flax import nnx
from transformers import CLIPVisionConfig as TheirConfig
from transformers import CLIPVisionModel

from egosim_jax.convert.tables import clip_vision as table
from egosim_jax.io.weights import WeightsError, fill, flat_shapes
from egosim_jax.models.wan.clip_vision import CLIPVision, CLIPVisionConfig
from tests.translation import translate, translate_back

CONFIG = CLIPVisionConfig(image_size=56, patch=14, dim=64, layers=3, heads=4, ffn_dim=96)
TOLERANCE = 1e-5
"""Relative L2 in float32: the order of sums over up to 588 terms in 4 residual steps."""


@pytest.fixture(scope="module")
def theirs():
    torch.manual_seed(0)
    model = CLIPVisionModel(
        TheirConfig(
            hidden_size=CONFIG.dim,
            intermediate_size=CONFIG.ffn_dim,
            num_hidden_layers=CONFIG.layers,
            num_attention_heads=CONFIG.heads,
            image_size=CONFIG.image_size,
            patch_size=CONFIG.patch,
            layer_norm_eps=CONFIG.eps,
            hidden_act="gelu",
        )
    ).eval()
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if "norm" in name and name.endswith("weight"):
                parameter.uniform_(0.5, 1.5)
            elif name.endswith("bias"):
                parameter.normal_(std=0.2)
            elif "proj" in name or "mlp" in name:
                parameter.normal_(std=parameter.shape[1] ** -0.5)
    return model


@pytest.fixture(scope="module")
def weights(theirs):
    state = {name: tensor.numpy() for name, tensor in theirs.state_dict().items()}
    return translate(state, table.transformers(CONFIG), ignore=table.TABLE.ignored(CONFIG))


def test_tokens_before_the_last_block_are_those_of_transformers(theirs, weights):
    model = nnx.eval_shape(lambda: CLIPVision(CONFIG, rngs=nnx.Rngs(0)))
    fill(model, weights)
    pixels = np.random.default_rng(0).normal(size=(2, 56, 56, 3)).astype(np.float32)
    with torch.no_grad():
        states = theirs(
            torch.tensor(pixels).permute(0, 3, 1, 2), output_hidden_states=True
        ).hidden_states
    want = states[-2].numpy()
    with jax.default_matmul_precision("highest"):
        have = np.asarray(jax.jit(model)(pixels))
    assert have.shape == (2, 4 * 4 + 1, CONFIG.dim)
    assert np.linalg.norm(have - want) / np.linalg.norm(want) <= TOLERANCE


def test_official_names_and_shapes_are_those_of_the_released_file():
    config = CLIPVisionConfig()
    model = nnx.eval_shape(lambda: CLIPVision(config, rngs=nnx.Rngs(0)))
    full_size = {
        path: np.broadcast_to(np.float32(0), shape) for path, shape in flat_shapes(model).items()
    }
    tensors = translate_back(full_size, table.wan(config))
    have = {name: tensor.shape for name, tensor in tensors.items()}
    released = released_clip()
    assert len(released) == 393
    ignored = {
        name
        for name in released
        if any(fnmatchcase(name, pattern) for pattern in table.TABLE.ignored(config))
    }
    assert have == {name: shape for name, shape in released.items() if name not in ignored}


def released_clip():
    """Names and shapes of the released file but for its text half."""
    released = {
        "log_scale": (),
        "visual.cls_embedding": (1, 1, 1280),
        "visual.pos_embedding": (1, 257, 1280),
        "visual.head": (1280, 1024),
        "visual.patch_embedding.weight": (1280, 3, 14, 14),
        "visual.pre_norm.weight": (1280,),
        "visual.pre_norm.bias": (1280,),
        "visual.post_norm.weight": (1280,),
        "visual.post_norm.bias": (1280,),
    }
    linears = {"attn.to_qkv": (3840, 1280), "attn.proj": (1280, 1280)}
    linears |= {"mlp.0": (5120, 1280), "mlp.2": (1280, 5120)}
    for block in (f"visual.transformer.{i}" for i in range(32)):
        for norm in ("norm1", "norm2"):
            released |= {f"{block}.{norm}.weight": (1280,), f"{block}.{norm}.bias": (1280,)}
        for name, shape in linears.items():
            released |= {f"{block}.{name}.weight": shape, f"{block}.{name}.bias": shape[:1]}
    return released


def test_the_fused_projection_of_the_official_file_holds_q_then_k_then_v(theirs, weights):
    official = translate_back(weights, table.wan(CONFIG))
    attention = theirs.encoder.layers[1].self_attn
    projections = [attention.q_proj, attention.k_proj, attention.v_proj]
    for kind in ("weight", "bias"):
        want = torch.cat([getattr(projection, kind).detach() for projection in projections])
        have = official[f"visual.transformer.1.attn.to_qkv.{kind}"]
        np.testing.assert_array_equal(have, want)


def test_translating_to_the_official_names_and_back_gives_every_weight_again(weights):
    rules = table.wan(CONFIG)
    again = translate(translate_back(weights, rules), rules)
    assert again.keys() == weights.keys()
    for path, tensor in weights.items():
        np.testing.assert_array_equal(again[path], tensor)


def test_the_last_block_the_head_and_the_text_half_of_a_file_are_ignored(weights):
    rules = table.wan(CONFIG)
    official = translate_back(weights, rules)
    rest = {
        name.replace(".1.", ".2."): tensor
        for name, tensor in official.items()
        if name.startswith("visual.transformer.1.")
    }
    rest |= {name: np.zeros(1) for name in ("log_scale", "visual.head", "visual.post_norm.bias")}
    rest |= {"textual.blocks.1.norm1.weight": np.zeros(1)}
    read = translate(official | rest, rules, ignore=table.TABLE.ignored(CONFIG))
    assert read["blocks.norm1.scale"].shape == (CONFIG.blocks, CONFIG.dim)


def test_a_fused_projection_that_has_no_three_parts_is_named(weights):
    rules = table.wan(CONFIG)
    name = "visual.transformer.0.attn.to_qkv.bias"
    official = translate_back(weights, rules) | {name: np.zeros(64, np.float32)}
    with pytest.raises(WeightsError) as raised:
        translate(official, rules)
    assert len(raised.value.problems) == 3
    assert all(name in problem and "(64,)" in problem for problem in raised.value.problems)
