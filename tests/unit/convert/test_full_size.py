"""Names and shapes of the released files at their real size, without their values."""

import hashlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLWan, WanTransformer3DModel
from transformers import CLIPVisionConfig, CLIPVisionModel, UMT5Config, UMT5EncoderModel

from egosim_jax import configs
from egosim_jax.convert.detect import known_tables, networks_of
from egosim_jax.convert.plan import to_jax, to_torch
from egosim_jax.convert.source import Source
from egosim_jax.convert.tables import weight_shapes
from egosim_jax.io.mapped import Tensor

EGOSIM_14B, EGOSIM_1_3B = configs.get("egosim_14b"), configs.get("egosim_1_3b")


def changed(config, network, **changes):
    """Return a model config of one changed network."""
    networks = {network: replace(config.networks[network], **changes)}
    return SimpleNamespace(name="changed", networks=networks)


def shaped(shapes):
    """Return tensors of these shapes without values."""
    return {
        name: Tensor(
            shape=tuple(shape),
            dtype=np.dtype(np.float32),
            data=memoryview(b""),
            strides=(0,) * len(shape),
        )
        for name, shape in shapes.items()
    }


def there_and_back(config, network, naming, theirs):
    """Return the names and shapes of tensors after a conversion to JAX and back."""
    source = Source(name="released", files=(), tensors=shaped(theirs))
    (found,) = networks_of(source, known_tables())
    assert (found.network, found.naming) == (network, naming)
    ours = shaped({weight.name: weight.shape for weight in to_jax(found, config)})
    back = to_torch(ours, config.networks[network], naming)
    return {weight.name: weight.shape for weight in back}


def leaves(config, network, naming):
    """Return the names and shapes of a foreign file by the network's table."""
    ours = shaped(weight_shapes(config.networks[network]))
    written = to_torch(ours, config.networks[network], naming)
    return {weight.name: weight.shape for weight in written}


@pytest.mark.parametrize(
    ("config", "network", "naming", "released", "tensors", "fingerprint"),
    [
        (
            changed(EGOSIM_14B, "dit", in_channels=36), "dit", "wan",
            "Wan2.1-I2V-14B", 1303, "6bfcfb3b342cb286ce886889d519a77e",
        ),
        (
            changed(EGOSIM_14B, "dit", in_channels=16, image_dim=None), "dit", "wan",
            "Wan2.1-T2V-14B", 1095, "aafcfd9672c3a2456dc46e1cb6e52c70",
        ),
        (
            changed(EGOSIM_14B, "dit", in_channels=16, image_dim=None), "dit", "diffusers",
            "Wan2.1-T2V-14B-Diffusers", 1095, "cb104773c6c2cb6df4f9529ad5c60d0b",
        ),
        (
            changed(EGOSIM_1_3B, "dit", in_channels=36), "dit", "wan",
            "Wan2.1-Fun-1.3B-InP", 983, "6d6ccde6845b95ad9114ab993d917893",
        ),
        (
            changed(EGOSIM_1_3B, "dit", in_channels=16, image_dim=None), "dit", "wan",
            "Wan2.1-T2V-1.3B", 825, "9269f8db9040a9d860eaca435be61814",
        ),
        (EGOSIM_14B, "vae", "wan", "Wan2.1_VAE", 194, "ccc42284ea13e1ad04693284c7a09be6"),
        (EGOSIM_14B, "text", "wan", "umt5-xxl-enc", 242, "9c8818c2cbea55eca56c7b447df170da"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_names_and_shapes_are_those_of_the_released_files(
    config, network, naming, released, tensors, fingerprint
):
    """DiffSynth-Studio identifies files by these fingerprints: MD5 over names and shapes."""
    theirs = leaves(config, network, naming)
    assert len(theirs) == tensors
    shapes = {name: "_".join(map(str, shape)) for name, shape in theirs.items()}
    keys = sorted([*shapes, *(f"{name}:{shape}" for name, shape in shapes.items())])
    assert hashlib.md5(",".join(keys).encode(), usedforsecurity=False).hexdigest() == fingerprint
    assert there_and_back(config, network, naming, theirs) == theirs


def test_the_released_egosim_transformer_reads_52_channels():
    theirs = leaves(EGOSIM_14B, "dit", "wan")
    assert theirs["patch_embedding.weight"] == (5120, 52, 1, 2, 2)
    base = leaves(changed(EGOSIM_14B, "dit", in_channels=36), "dit", "wan")
    assert {name for name in base if base[name] != theirs[name]} == {"patch_embedding.weight"}
    assert there_and_back(EGOSIM_14B, "dit", "wan", theirs) == theirs


def test_the_released_clip_has_what_we_use_and_what_we_name_as_unused():
    """Names as in `models_clip_open-clip-xlm-roberta-large-vit-huge-14.pth`, of 32 layers."""
    used = {
        "cls_embedding": (1, 1, 1280),
        "pos_embedding": (1, 257, 1280),
        "patch_embedding.weight": (1280, 3, 14, 14),
        "pre_norm.weight": (1280,),
        "pre_norm.bias": (1280,),
    }
    layer = {
        "norm1.weight": (1280,), "norm1.bias": (1280,),
        "attn.to_qkv.weight": (3840, 1280), "attn.to_qkv.bias": (3840,),
        "attn.proj.weight": (1280, 1280), "attn.proj.bias": (1280,),
        "norm2.weight": (1280,), "norm2.bias": (1280,),
        "mlp.0.weight": (5120, 1280), "mlp.0.bias": (5120,),
        "mlp.2.weight": (1280, 5120), "mlp.2.bias": (1280,),
    }  # fmt: skip
    unused = {
        "log_scale": (),
        "visual.head": (1280, 1024),
        "visual.post_norm.weight": (1280,),
        "visual.post_norm.bias": (1280,),
        # Names of the text half that umT5 has too.
        "textual.token_embedding.weight": (250002, 1024),
        "textual.blocks.0.attn.q.weight": (1024, 1024),
        "textual.blocks.0.norm1.weight": (1024,),
    } | {f"visual.transformer.31.{name}": shape for name, shape in layer.items()}
    for index in range(31):
        used |= {f"transformer.{index}.{name}": shape for name, shape in layer.items()}
    used = {f"visual.{name}": shape for name, shape in used.items()}
    released = {f"model.{name}": shape for name, shape in (used | unused).items()}
    assert there_and_back(EGOSIM_14B, "image", "wan", released) == used


def meta(network):
    """The module of diffusers or transformers at full size, which takes no memory."""
    dit, text, image = EGOSIM_14B.dit, EGOSIM_14B.text, EGOSIM_14B.image
    with torch.device("meta"):
        if network == "dit":
            return WanTransformer3DModel(
                num_attention_heads=40, attention_head_dim=128, in_channels=dit.in_channels,
                out_channels=16, text_dim=4096, freq_dim=256, ffn_dim=13824, num_layers=40,
                cross_attn_norm=True, image_dim=1280, added_kv_proj_dim=5120,
            )  # fmt: skip
        if network == "vae":
            return AutoencoderKLWan()
        if network == "text":
            return UMT5EncoderModel(
                UMT5Config(
                    vocab_size=text.vocab, d_model=4096, d_kv=64, d_ff=10240, num_layers=24,
                    num_heads=64, feed_forward_proj="gated-gelu",
                )
            )  # fmt: skip
        return CLIPVisionModel(
            CLIPVisionConfig(
                hidden_size=1280, intermediate_size=5120, num_hidden_layers=image.layers,
                num_attention_heads=16, image_size=224, patch_size=14, hidden_act="gelu",
            )
        )  # fmt: skip


@pytest.mark.parametrize("network", ["dit", "vae", "text", "image"])
def test_names_and_shapes_are_those_of_diffusers_and_transformers(network):
    naming = "diffusers" if network in ("dit", "vae") else "transformers"
    theirs = {name: tuple(t.shape) for name, t in meta(network).named_parameters()}
    back = there_and_back(EGOSIM_14B, network, naming, theirs)
    unused = theirs.keys() - back.keys()
    assert back.items() <= theirs.items()
    if network == "image":  # the last layer's output is not used, nor what follows it
        assert all(".layers.31." in name or "post_layernorm" in name for name in unused)
    else:
        assert not unused
