"""LoRA files of every naming give the same changes, and other projects load written files."""

import json

import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers.loaders import lora_conversion_utils as diffusers_rules
from flax import nnx
from safetensors.torch import load_file, save_file

from egosim_jax import configs
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.lora import read_lora
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_metadata
from egosim_jax.models import lora
from egosim_jax.models.wan.dit import WanDiT
from egosim_jax.types import InputError

CONFIG = configs.get("debug").dit
RANK, ALPHA = 3, 6.0


def layers():
    """Wan's name of every linear layer of the blocks, and its shape [out, in]."""
    dim, ffn = CONFIG.dim, CONFIG.ffn_dim
    for block in range(CONFIG.layers):
        for attention in ("self_attn", "cross_attn"):
            for name in "qkvo":
                yield f"blocks.{block}.{attention}.{name}", (dim, dim)
        for name in ("k_img", "v_img"):
            yield f"blocks.{block}.cross_attn.{name}", (dim, dim)
        yield f"blocks.{block}.ffn.0", (ffn, dim)
        yield f"blocks.{block}.ffn.2", (dim, ffn)


def in_diffusers(name: str) -> str:
    for theirs, ours in {
        "self_attn": "attn1", "cross_attn": "attn2", ".ffn.0": ".ffn.net.0.proj",
        ".ffn.2": ".ffn.net.2",
    }.items():  # fmt: skip
        name = name.replace(theirs, ours)
    *front, last = name.split(".")
    if "attn" in name:
        words = {"o": "to_out.0", "k_img": "add_k_proj", "v_img": "add_v_proj"}
        last = words.get(last, f"to_{last}")
    return ".".join([*front, last])


@pytest.fixture(scope="module")
def pairs():
    torch.manual_seed(0)
    return {
        name: (torch.randn(RANK, wide), torch.randn(out, RANK)) for name, (out, wide) in layers()
    }


def written(form, pairs, folder):
    """The same LoRA in the files of other projects."""
    tensors, path = {}, folder / "lora.safetensors"
    scale = ALPHA / RANK
    for name, (down, up) in pairs.items():
        kohya = name.replace(".", "_")
        match form:
            case "ComfyUI":
                base, ends = f"diffusion_model.{name}", ("lora_A.weight", "lora_B.weight")
                tensors[f"{base}.alpha"] = torch.tensor(ALPHA)
            case "ComfyUI, down and up":
                base, ends = f"diffusion_model.{name}", ("lora_down.weight", "lora_up.weight")
                tensors[f"{base}.alpha"] = torch.tensor(ALPHA)
            case "VideoX-Fun":
                base, ends = f"lora_unet__{kohya}", ("lora_down.weight", "lora_up.weight")
                tensors[f"{base}.alpha"] = torch.tensor(ALPHA)
            case "musubi":
                base, ends = f"lora_unet_{kohya}", ("lora_down.weight", "lora_up.weight")
                tensors[f"{base}.alpha"] = torch.tensor(ALPHA)
            case "PEFT":
                base = f"base_model.model.{name}"
                ends = ("lora_A.default.weight", "lora_B.default.weight")
            case "diffusers":
                base = f"transformer.{in_diffusers(name)}"
                ends = ("lora_A.weight", "lora_B.weight")
                up = scale * up  # as diffusers saves it: without an alpha
        tensors |= {f"{base}.{ends[0]}": down, f"{base}.{ends[1]}": up}
    if form == "PEFT":
        config = {"r": RANK, "lora_alpha": ALPHA}
        (folder / "adapter_config.json").write_text(json.dumps(config), encoding="utf-8")
        path = folder / "adapter_model.safetensors"
    save_file({name: tensor.contiguous() for name, tensor in tensors.items()}, path)
    return folder if form == "PEFT" else path


FORMS = ("ComfyUI", "ComfyUI, down and up", "VideoX-Fun", "musubi", "PEFT", "diffusers")


@pytest.mark.parametrize("form", FORMS)
def test_every_naming_is_the_same_sum(form, pairs, tmp_path):
    deltas = read_lora(written(form, pairs, tmp_path), CONFIG)
    assert len(deltas) == 12
    for name, path in (
        ("blocks.1.self_attn.q", "blocks.self_attn.q"),
        ("blocks.1.cross_attn.v_img", "blocks.cross_attn.image.v"),
        ("blocks.1.ffn.2", "blocks.mlp.down"),
    ):
        down, up = pairs[name]
        product = deltas[path].down[1] @ deltas[path].up[1]
        expected = (ALPHA / RANK * up @ down).numpy().T
        np.testing.assert_allclose(product, expected, rtol=1e-5, atol=1e-5)


def network():
    """`debug` with weights that all have an effect."""
    made = WanDiT(CONFIG, rngs=nnx.Rngs(0))
    rng = np.random.default_rng(1)
    made.head.linear.kernel.set_value(
        jnp.asarray(rng.normal(size=made.head.linear.kernel.shape), jnp.float32)
    )
    return made


def velocity(made):
    rng = np.random.default_rng(2)
    shapes = ((1, 3, 4, 6, CONFIG.in_channels), (1, 5, CONFIG.text_dim), (1, 5, CONFIG.image_dim))
    latents, text, image = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes)
    return np.asarray(made(latents, jnp.array([400.0]), text, image))


def test_applied_and_merged_are_the_same_and_scaled_as_asked(pairs, tmp_path):
    small = {name: (0.1 * down, 0.1 * up) for name, (down, up) in pairs.items()}
    file = written("ComfyUI", small, tmp_path)
    deltas = read_lora(file, CONFIG)
    without = velocity(network())
    applied = network()
    lora.apply(applied, deltas, scale=0.5)
    first = velocity(applied)
    size = np.abs(first).max()
    assert np.abs(first - without).max() > 0.1 * size
    weights.save(tmp_path / "base" / "dit.safetensors", network())
    args = ["lora", str(file), "--config", "debug", "--scale", "0.5", "--merge"]
    assert main([*args, str(tmp_path / "base"), "--out", str(tmp_path / "out")]) == 0
    merged = nnx.eval_shape(lambda: WanDiT(CONFIG, rngs=nnx.Rngs(0)))
    weights.load(tmp_path / "out" / "dit.safetensors", merged)
    np.testing.assert_allclose(velocity(merged), first, atol=1e-5 * size)


def test_what_is_written_is_read_by_diffusers_own_rules(pairs, tmp_path):
    (tmp_path / "peft").mkdir()
    file = written("PEFT", pairs, tmp_path / "peft")
    out = tmp_path / "out" / "lora.safetensors"
    assert main(["lora", str(file), "--config", "debug", "--out", str(out)]) == 0
    about = read_metadata(out)
    assert (about["rank"], about["alpha"]) == (str(RANK), str(RANK))
    theirs = diffusers_rules._convert_non_diffusers_wan_lora_to_diffusers(load_file(out))
    assert len(theirs) == 2 * len(pairs)
    for name, (down, up) in pairs.items():
        base = f"transformer.{in_diffusers(name)}"
        found = theirs[f"{base}.lora_B.weight"] @ theirs[f"{base}.lora_A.weight"]
        torch.testing.assert_close(found, ALPHA / RANK * up @ down, rtol=1e-5, atol=1e-5)
    again, first = read_lora(out, CONFIG), read_lora(file, CONFIG)
    for path, delta in first.items():
        np.testing.assert_array_equal(again[path].down, delta.down)
        np.testing.assert_array_equal(again[path].up, delta.up)


def test_blocks_may_be_missing_and_ranks_differ(pairs, tmp_path):
    kept = {name: pair for name, pair in pairs.items() if name.startswith("blocks.1.self_attn")}
    down, up = kept["blocks.1.self_attn.q"]
    kept["blocks.0.self_attn.q"] = (down[:1].clone(), up[:, :1].clone())
    deltas = read_lora(written("diffusers", kept, tmp_path), CONFIG)
    assert not deltas["blocks.self_attn.k"].up[0].any()
    product = deltas["blocks.self_attn.q"].down[0] @ deltas["blocks.self_attn.q"].up[0]
    expected = (ALPHA / RANK * up[:, :1] @ down[:1]).numpy().T
    np.testing.assert_allclose(product, expected, rtol=1e-5, atol=1e-5)


def test_a_fresh_summand_changes_nothing_until_it_is_trained():
    made = network()
    lora.start(made, 2, targets=CONFIG.lora_targets, rngs=nnx.Rngs(3))
    np.testing.assert_array_equal(velocity(made), velocity(network()))
    assert len(lora.deltas_of(made)) == 12
    with pytest.raises(InputError, match="rank"):
        lora.start(made, 0, targets=CONFIG.lora_targets, rngs=nnx.Rngs(3))


@pytest.mark.parametrize(
    ("patterns", "message"),
    [
        ({"targets": ("layers.*",)}, r"none matches .*layers\.\*.*lora_targets"),
        ({"targets": ("blocks.*",), "also_train": ("input.*",)}, r"none of input\.\*"),
    ],
)
def test_patterns_of_a_lora_that_match_nothing_are_refused(patterns, message):
    with pytest.raises(InputError, match=message):
        lora.start(network(), 2, **patterns, rngs=nnx.Rngs(0))


def test_weights_trained_in_full_are_not_those_of_the_lora():
    made = network()
    lora.start(made, 2, targets=("blocks.*",), rngs=nnx.Rngs(0))
    full = lora.full_weights(made, ("blocks.mlp.*",))
    assert full.keys() == {
        f"blocks.mlp.{p}.{w}" for p in ("up", "down") for w in ("kernel", "bias")
    }


def test_a_pair_for_a_layer_that_is_not_linear_is_refused():
    class Conv(nnx.Module):
        def __init__(self):
            self.kernel = nnx.Param(jnp.ones((2, 3)))

    other = nnx.Module()
    other.conv = Conv()
    delta = lora.Delta(down=np.ones((2, 1), np.float32), up=np.ones((1, 3), np.float32))
    with pytest.raises(InputError, match="conv: is not a linear layer"):
        lora.apply(other, {"conv": delta})


def test_what_is_no_lora_of_the_network_is_one_list(pairs, tmp_path):
    base = "diffusion_model.blocks.0.self_attn"
    bad = {
        f"{base}.q.lora_A.weight": torch.rand(3, CONFIG.dim),
        f"{base}.k.lora_A.weight": torch.rand(3, CONFIG.dim),
        f"{base}.k.lora_B.weight": torch.rand(CONFIG.dim, 4),
        f"{base}.v.diff": torch.rand(CONFIG.dim, 7),
        "diffusion_model.blocks.99.self_attn.q.lora_A.weight": torch.rand(3, CONFIG.dim),
    }
    save_file(bad, tmp_path / "bad.safetensors")
    with pytest.raises(InputError) as error:
        read_lora(tmp_path / "bad.safetensors", CONFIG)
    for reason in (
        "q, block 0: has no lora_B", "expected (3, 48) and (48, 3)",
        "v, block 0: has shape (7, 48)",
        "blocks.99", "4 tensors",
    ):  # fmt: skip
        assert reason in str(error.value)
    wide = {
        f"{base}.q.lora_A.weight": torch.rand(3, 7),
        f"{base}.q.lora_B.weight": torch.rand(7, 3),
    }
    save_file(wide, tmp_path / "bad.safetensors")
    with pytest.raises(InputError, match="not of a LoRA of this network"):
        read_lora(tmp_path / "bad.safetensors", CONFIG)
    narrow = np.zeros((CONFIG.layers, 7, 3), np.float32)
    wide = {"blocks.self_attn.q": lora.Delta(down=narrow, up=narrow.transpose(0, 2, 1))}
    with pytest.raises(InputError, match="does not fit this network"):
        lora.apply(network(), wide)
    weights.save(tmp_path / "base" / "dit.safetensors", network())
    args = ["lora", str(tmp_path / "bad.safetensors"), "--config", "debug", "--merge"]
    assert main([*args, str(tmp_path / "base"), "--out", str(tmp_path / "out")]) == 2
    assert not (tmp_path / "out").exists()
