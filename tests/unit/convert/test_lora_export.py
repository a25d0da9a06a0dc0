"""LoRAs are merged, written for other projects, and written to be trained further."""

import json
import os

import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers.loaders import lora_conversion_utils as diffusers_rules
from flax import nnx
from safetensors.numpy import load_file
from safetensors.torch import load_file as load_torch

from egosim_jax.convert.__main__ import main
from egosim_jax.convert.lora import read_lora
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_metadata
from egosim_jax.models import lora
from egosim_jax.models.wan.dit import WanDiT
from egosim_jax.types import InputError
from tests.unit.convert.made import CONFIG, DIM, LAYER, NAME, arrays, one_line, ours, pair, save

DIT = CONFIG.dit


def product(tensors):
    down, up = tensors.values()
    return (up @ down).numpy().T


@pytest.fixture
def full(tmp_path):
    """A LoRA with a low-rank change, and differences of all kinds of weights."""
    torch.manual_seed(0)
    base = "diffusion_model.blocks.1"
    tensors = pair() | {
        f"{NAME}.diff_b": torch.randn(DIM),
        f"{base}.cross_attn.norm_k.diff": torch.randn(DIM),
        f"{base}.self_attn.q.diff": torch.randn(DIM, DIM),
        f"{base}.diff_m": torch.randn(1, 6, DIM),
        "diffusion_model.head.head.diff_b": torch.randn(*arrays("dit")["head.linear.bias"].shape),
    }
    return save(tmp_path / "x.safetensors", tensors), tensors


def test_all_changes_are_merged_applied_and_written_alike(tmp_path, full):
    file, tensors = full
    folder, base = ours(tmp_path / "base", "dit"), "diffusion_model.blocks.1"
    args = ["lora", str(file), "--config", "debug"]
    merge = ["--merge", str(folder), "--lora-scale", "0.5", "--out", str(tmp_path / "out")]
    assert main([*args, *merge]) == 0
    have, before = load_file(tmp_path / "out" / "dit.safetensors"), arrays("dit")
    added = {path: have[path] - before[path] for path in have}
    for path, at, expected in (
        ("blocks.self_attn.q.kernel", 0, product(pair())),
        ("blocks.self_attn.q.kernel", 1, tensors[f"{base}.self_attn.q.diff"].numpy().T),
        ("blocks.self_attn.q.bias", 0, tensors[f"{NAME}.diff_b"].numpy()),
        ("blocks.cross_attn.norm_k.scale", 1, tensors[f"{base}.cross_attn.norm_k.diff"].numpy()),
        ("blocks.modulation", 1, tensors[f"{base}.diff_m"][0].numpy()),
        ("head.linear.bias", ..., tensors["diffusion_model.head.head.diff_b"].numpy()),
    ):
        np.testing.assert_allclose(added[path][at], 0.5 * expected, atol=1e-5)
    assert not added["blocks.self_attn.k.kernel"].any()

    applied = nnx.eval_shape(lambda: WanDiT(DIT, rngs=nnx.Rngs(0)))
    weights.load(folder / "dit.safetensors", applied)
    lora.apply(applied, read_lora(file, DIT), scale=0.5)
    merged = nnx.eval_shape(lambda: WanDiT(DIT, rngs=nnx.Rngs(0)))
    weights.load(tmp_path / "out" / "dit.safetensors", merged)
    first, second = velocity(applied), velocity(merged)
    np.testing.assert_allclose(first, second, atol=1e-4 * np.abs(second).max())

    assert main([*args, "--out", str(tmp_path / "again" / "x.safetensors")]) == 0
    again, first = (read_lora(path, DIT) for path in (tmp_path / "again" / "x.safetensors", file))
    assert again.keys() == first.keys()
    np.testing.assert_array_equal(again["blocks.modulation"], first["blocks.modulation"])


def velocity(network):
    rng = np.random.default_rng(2)
    shapes = ((1, 3, 4, 6, DIT.in_channels), (1, 5, DIT.text_dim), (1, 5, DIT.image_dim))
    latents, text, image = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in shapes)
    return np.asarray(network(latents, jnp.array([400.0]), text, image))


def test_what_is_written_is_read_by_diffusers_own_rules(tmp_path):
    tensors = pair() | {f"{NAME}.alpha": torch.tensor(6.0)}
    file, out = save(tmp_path / "x.safetensors", tensors), tmp_path / "out.safetensors"
    assert main(["lora", str(file), "--config", "debug", "--out", str(out)]) == 0
    assert {read_metadata(out)[key] for key in ("rank", "alpha")} == {"2"}
    theirs = diffusers_rules._convert_non_diffusers_wan_lora_to_diffusers(load_torch(out))
    name = "transformer.blocks.0.attn1.to_q"
    change = theirs[f"{name}.lora_B.weight"] @ theirs[f"{name}.lora_A.weight"]
    np.testing.assert_allclose(change.numpy().T, 3 * product(pair()), rtol=1e-5, atol=1e-5)


def test_a_foreign_lora_is_written_in_our_layout(tmp_path, full, capsys):
    file, _ = full
    base, out = ours(tmp_path / "base", "dit"), tmp_path / "ours.safetensors"
    args = ["lora", file, "--config", "debug", "--layout", "egosim", "--out", out]
    assert "--base" in one_line(capsys, 2, *args)
    assert "--merge" in one_line(capsys, 2, *args, "--merge", base)
    assert main([*map(str, args), "--base", str(base)]) == 0
    assert read_metadata(out)["base_sha256"] == weights.hashes(base)["dit"]
    written, read = lora.read_own(out, convert=""), read_lora(file, DIT)
    assert written.keys() == read.keys()
    np.testing.assert_array_equal(written[LAYER].up, read[LAYER].up)
    np.testing.assert_array_equal(written["head.linear.bias"], read["head.linear.bias"])
    with pytest.raises(InputError, match="egosim convert lora it"):
        lora.read_own(file, convert="egosim convert lora it")


def in_our_names(layers=DIT.layers, dim=DIM, path=LAYER, value=1.0):
    down = np.full((layers, dim, 2), value, np.float32)
    return {f"{path}.down": down, f"{path}.up": down.transpose(0, 2, 1).copy()}


@pytest.mark.parametrize(
    "tensors",
    [
        in_our_names(layers=30),
        in_our_names(dim=DIM + 1),
        in_our_names(path="blocks.nothing"),
        in_our_names(value=np.inf),
        {},
    ],
)
def test_a_lora_in_our_names_that_does_not_fit_is_refused(tmp_path, capsys, tensors):
    path, out = tmp_path / "x.safetensors", tmp_path / "out" / "x.safetensors"
    weights.write(path, tensors, metadata=lora.metadata("debug", base="0"))
    one_line(capsys, 2, "lora", path, "--config", "debug", "--out", out)
    assert not out.parent.exists()


def test_a_sparse_lora_of_four_gigabytes_is_refused_unread(tmp_path):
    rows = (1 << 31) // DIM
    size = rows * DIM
    about = {"dtype": "BF16", "shape": [rows, DIM], "data_offsets": [0, 2 * size]}
    text = json.dumps({f"{NAME}.lora_A.weight": about}).encode()
    path = tmp_path / "x.safetensors"
    path.write_bytes(len(text).to_bytes(8, "little") + text)
    os.truncate(path, 8 + len(text) + 2 * size)
    with pytest.raises(InputError, match="no lora_B"):
        read_lora(path, DIT)


@pytest.mark.parametrize("scale", ["nan", "inf"])
def test_a_scale_is_a_finite_number(tmp_path, capsys, scale):
    file = save(tmp_path / "x.safetensors", pair())
    args = ["lora", file, "--config", "debug", "--out", tmp_path / "out", "--scale", scale]
    assert "(--scale" in one_line(capsys, 2, *args)


def test_a_lora_of_another_base_is_refused(tmp_path, capsys):
    base, out = ours(tmp_path / "base", "dit"), tmp_path / "out"
    file = save(tmp_path / "x.safetensors", pair(), {"base_sha256": 64 * "a"})
    args = ["lora", file, "--config", "debug", "--out", out]
    for option in ("--merge", "--base"):
        assert "trained on other weights" in one_line(capsys, 2, *args, option, base)
    save(tmp_path / "x.safetensors", pair(), {"base_sha256": weights.hashes(base)["dit"]})
    assert main([str(arg) for arg in [*args, "--merge", base]]) == 0
    assert "no dit.safetensors" in one_line(capsys, 2, *args, "--base", tmp_path)
