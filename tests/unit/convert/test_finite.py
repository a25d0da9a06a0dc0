"""Values that are not finite, or not in the range of a dtype, are named with their tensor."""

import ml_dtypes
import numpy as np
import pytest
import torch

from egosim_jax.convert.__main__ import main
from egosim_jax.convert.finite import all_finite
from egosim_jax.convert.lora import read_lora
from egosim_jax.convert.tables import weight_shapes
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.models import abstract, lora
from egosim_jax.types import InputError
from tests.unit.convert.made import CONFIG, DIM, LAYER, NAME, arrays, foreign, one_line, pair, save

THEIRS = "blocks.1.self_attn.k.weight"


def checkpoint(tmp_path, value, dtype=torch.float32, name=THEIRS):
    tensors = {key: tensor.to(dtype) for key, tensor in foreign().items()}
    tensors[name].view(-1)[3] = value
    return save(tmp_path / "theirs.safetensors", tensors)


def base(tmp_path, value=None, dtype=np.float32):
    values = {path: array.astype(dtype) for path, array in arrays("dit").items()}
    if value is not None:
        values[f"{LAYER}.kernel"] = values[f"{LAYER}.kernel"].copy()
        values[f"{LAYER}.kernel"][1, 3, 5] = value
    weights.write(tmp_path / "base" / "dit.safetensors", values)
    return tmp_path / "base"


@pytest.mark.parametrize(
    ("value", "dtype", "to"),
    [
        (np.nan, torch.float32, None), (np.inf, torch.bfloat16, "bfloat16"),
        (-np.inf, torch.float16, "bfloat16"), (np.nan, torch.float64, "bfloat16"),
    ],
)  # fmt: skip
def test_weights_names_a_value_that_is_not_finite(value, dtype, to, tmp_path, capsys):
    file = checkpoint(tmp_path, value, dtype)
    args = ["weights", file, "--config", "debug", "--out", tmp_path / "out"]
    said = one_line(capsys, 2, *args, *(["--dtype", to] if to else []))
    assert f"{THEIRS} of theirs.safetensors has 1 of 2,304 values that are not finite" in said
    assert not list((tmp_path / "out").glob("[!.]*"))


@pytest.mark.parametrize(
    ("value", "dtype", "to", "fix", "name"),
    [
        (1e5, torch.float32, "float16", "bfloat16", THEIRS),
        (-7e4, torch.bfloat16, "float16", "bfloat16", "head.head.bias"),
        (3.4e38, torch.float32, "bfloat16", "float32", "blocks.0.modulation"),
        (1e39, torch.float64, "float32", None, THEIRS),
    ],
)
def test_weights_names_a_value_that_a_dtype_cannot_hold(
    value, dtype, to, fix, name, tmp_path, capsys
):
    file = checkpoint(tmp_path, value, dtype, name)
    args = ["weights", file, "--config", "debug", "--out", tmp_path / "out"]
    said = one_line(capsys, 2, *args, "--dtype", to)
    assert f"{name} of theirs.safetensors has values up to" in said
    assert "(--dtype)" in said
    args += ["--dtype", fix] if fix else []
    assert main([str(arg) for arg in args]) == 0
    have = read_safetensors(tmp_path / "out" / "dit.safetensors")
    assert all(all_finite(tensor.array()) for tensor in have.values())


HUGE = {
    "alpha 1e38": (pair() | {f"{NAME}.alpha": torch.tensor(1e38)}, "1"),
    "values 1e30": ({name: 0 * tensor + 1e30 for name, tensor in pair().items()}, "1"),
    "scale 3e38": (pair(), "3e38"),
    "a difference of 3e38": ({f"{NAME}.diff": torch.full((DIM, DIM), 3e38)}, "2"),
}


@pytest.mark.parametrize("form", HUGE)
def test_a_merge_that_is_not_finite_is_refused(form, tmp_path, capsys):
    tensors, scale = HUGE[form]
    file = save(tmp_path / "x.safetensors", tensors)
    args = ["lora", file, "--config", "debug", "--merge", base(tmp_path), "--out", tmp_path / "out"]
    said = one_line(capsys, 2, *args, f"--scale={scale}")
    assert f"{LAYER}.kernel, block 0" in said
    assert not list((tmp_path / "out").glob("[!.]*"))
    if scale == "1":
        assert "alpha" in said
    else:
        assert "Lower it. (--scale)" in said
        assert main([str(arg) for arg in [*args, "--scale", "1"]]) == 0


def test_a_merge_into_half_precision_is_refused_where_it_ends(tmp_path, capsys):
    file = save(tmp_path / "x.safetensors", {f"{NAME}.diff": torch.full((DIM, DIM), 1e5)})
    args = ["lora", file, "--config", "debug", "--out", tmp_path / "out", "--merge"]
    said = one_line(capsys, 2, *args, base(tmp_path, dtype=np.float16))
    assert "float16 ends at 6.55e+04. Lower the scale, or merge into weights of bfloat16" in said
    assert main([*map(str, args), str(base(tmp_path, dtype=ml_dtypes.bfloat16))]) == 0


@pytest.mark.parametrize(
    ("end", "value"),
    [("lora_A.weight", np.nan), ("lora_B.weight", np.inf), ("diff_b", np.nan), ("diff", np.inf)],
)
def test_a_lora_names_the_tensor_that_is_not_finite(end, value, tmp_path, capsys):
    extra = {f"{NAME}.diff_b": torch.ones(DIM), f"{NAME}.diff": torch.ones(DIM, DIM)}
    tensors = pair() | extra
    tensors[f"{NAME}.{end}"].view(-1)[1] = value
    file = save(tmp_path / "x.safetensors", tensors)
    args = ["lora", file, "--config", "debug", "--out", tmp_path / "out.safetensors"]
    assert f"{NAME}.{end}: has values that are not finite" in one_line(capsys, 2, *args)


def test_a_scale_that_overflows_is_refused_by_generation(tmp_path):
    file = save(tmp_path / "x.safetensors", pair())
    network = abstract(CONFIG.dit)
    weights.load(base(tmp_path) / "dit.safetensors", network)
    changes = read_lora(file, CONFIG.dit)
    with pytest.raises(InputError, match=rf"scale 3e\+38 makes values of {LAYER}"):
        lora.apply(network, changes, scale=3e38)
    for scale in (1e308, -1e39, np.nan, -np.inf):
        with pytest.raises(InputError, match=r"at most 3\.4e"):
            lora.apply(network, changes, scale=scale)


@pytest.mark.parametrize(
    "dtype", ["float16", "bfloat16", "float32", "float64", "float8_e4m3fn", "float8_e5m2"]
)
def test_every_floating_dtype_is_checked(dtype):
    values = np.zeros((3, 5), np.float32).astype(dtype)
    assert all_finite(values)
    assert all_finite(values[:0])
    values[1, 2] = -float(ml_dtypes.finfo(dtype).max)
    assert all_finite(values.T)
    values[2, 1] = np.nan
    assert not all_finite(values.T)


def test_a_network_whose_output_is_zero_is_verified(tmp_path, capsys):
    """The head of an untrained network is 0."""
    values = {path: array.copy() for path, array in arrays("dit").items()}
    for path in weight_shapes(CONFIG.dit):
        if path.startswith("head."):
            values[path][...] = 0
    weights.write(tmp_path / "base" / "dit.safetensors", values)
    args = ["--config", "debug", "--only", "dit", "--out"]
    assert main(["to-torch", str(tmp_path / "base"), *args, str(tmp_path / "theirs")]) == 0
    assert main(["weights", str(tmp_path / "theirs"), *args, str(tmp_path / "ours")]) == 0
    verify = ["verify", str(tmp_path / "theirs"), str(tmp_path / "ours"), "--config", "debug"]
    assert main(verify) == 0
    assert "differs from PyTorch's by 0.0e+00" in capsys.readouterr().out
