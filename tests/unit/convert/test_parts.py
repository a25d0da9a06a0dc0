"""Folders of a part of the networks, stacks of several dtypes, T5, and hashes of weights."""

import numpy as np
import pytest
import torch
from safetensors.numpy import save_file as save_numpy
from safetensors.torch import save_file

from egosim_jax import configs
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.detect import detect
from egosim_jax.convert.plan import fits
from egosim_jax.convert.tables import table_of, weight_shapes
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_safetensors
from tests.translation import translate_back
from tests.unit.convert.made import CONFIG, arrays, foreign, one_line, ours, sharded

ALL = ("dit", "vae", "text", "image")


def folder_of(tmp_path, *networks):
    source = tmp_path / "theirs"
    source.mkdir()
    for network in networks:
        save_file(foreign(network), source / f"{network}.safetensors")
    return source


def convert(source, out, *more):
    return ["weights", source, "--config", "debug", "--out", out, *more]


@pytest.mark.parametrize("has", [("vae",), ("text", "image")], ids=str)
def test_a_folder_without_all_networks_names_the_missing_ones(has, tmp_path, capsys):
    source, out = folder_of(tmp_path, *has), tmp_path / "out"
    said = one_line(capsys, 2, *convert(source, out))
    missing = [network for network in ALL if network not in has]
    assert f"has no {', '.join(missing)}, which debug needs" in said
    assert not out.exists()
    options = said[said.index("(--only ") + 1 : said.rindex(")")].split()
    assert main([str(arg) for arg in convert(source, out, *options)]) == 0
    assert {file.stem for file in out.glob("[!.]*")} == set(has)


def test_networks_that_are_converted_already_are_not_missing(tmp_path):
    source = folder_of(tmp_path, "vae")
    out = ours(tmp_path / "out", "dit", "text", "image")
    assert main([str(arg) for arg in convert(source, out)]) == 0


def test_a_file_has_what_it_has_and_the_rest_is_said(tmp_path, capsys):
    source = folder_of(tmp_path, "vae") / "vae.safetensors"
    assert main([str(arg) for arg in convert(source, tmp_path / "out")]) == 0
    assert "still missing in" in capsys.readouterr().err


MIXES = {
    "one float32 layer": ({"blocks.1.self_attn.q.weight": torch.float32}, torch.bfloat16),
    "float32 norms of one block": ({"blocks.0.norm3.weight": torch.float32}, torch.float16),
    "a float8 layer": ({"blocks.0.ffn.0.weight": torch.float8_e4m3fn}, torch.bfloat16),
}


@pytest.mark.parametrize(
    ("mix", "dtype"), [*zip(MIXES, ("bfloat16", "float32", "bfloat16"), strict=True)]
)
def test_a_stack_of_several_dtypes_is_stored_as_one(mix, dtype, tmp_path, capsys):
    changed, rest = MIXES[mix]
    tensors = {name: t.to(changed.get(name, rest)) for name, t in foreign().items()}
    save_file(tensors, tmp_path / "dit.safetensors")
    args = convert(tmp_path / "dit.safetensors", tmp_path / "out")
    assert "store one dtype (--dtype)" in one_line(capsys, 2, *args)
    assert main([*map(str, args), "--dtype", dtype]) == 0
    have = read_safetensors(tmp_path / "out" / "dit.safetensors")
    assert {tensor.dtype.name for tensor in have.values()} == {dtype}
    (found,) = detect(tmp_path / "dit.safetensors").found
    assert fits(found, CONFIG)
    verify = ["verify", str(tmp_path / "dit.safetensors"), str(tmp_path / "out")]
    assert main([*verify, "--config", "debug"]) == 0


def test_layers_of_integers_and_numbers_are_no_stack(tmp_path, capsys):
    tensors = foreign()
    tensors["blocks.1.norm3.weight"] = tensors["blocks.1.norm3.weight"].to(torch.int8)
    save_file(tensors, tmp_path / "dit.safetensors")
    args = convert(tmp_path / "dit.safetensors", tmp_path / "out", "--dtype", "float32")
    assert "the layers are float32 and int8" in one_line(capsys, 2, *args)


@pytest.mark.parametrize(("name", "prefix"), [("dwm_tabletop", ""), ("debug", "model.t5.")])
def test_inspect_distinguishes_t5_and_umt5(name, prefix, tmp_path, capsys):
    """They have the same names, but T5 has a position bias in its first block alone."""
    config = configs.get(name).text
    rng = np.random.default_rng(0)
    shapes = weight_shapes(config)
    values = {path: rng.normal(size=s).astype(np.float32) for path, s in shapes.items()}
    theirs = translate_back(values, table_of(config).rules("transformers", config))
    tensors = {f"{prefix}{key}": np.ascontiguousarray(array) for key, array in theirs.items()}
    save_numpy(tensors, tmp_path / "model.safetensors")
    assert main(["inspect", str(tmp_path / "model.safetensors")]) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if "│ text" in line]
    assert name in row
    (found,) = detect(tmp_path / "model.safetensors", configs.get("dwm_tabletop")).found
    assert found.table is table_of(config)


@pytest.mark.parametrize("network", ["dit", "image"])
def test_bit_equal_weights_have_one_hash_whatever_their_file(network, tmp_path):
    """Written here, converted, converted by another command, and by another library."""
    ours(tmp_path / "a", network)
    args = ["--config", "debug", "--only", network, "--out"]
    assert main(["to-torch", str(tmp_path / "a"), *args, str(tmp_path / "theirs")]) == 0
    assert main(["weights", str(tmp_path / "theirs"), *args, str(tmp_path / "b")]) == 0
    (tmp_path / "c").mkdir()
    (tmp_path / "d").mkdir()
    values = arrays(network)
    save_numpy(values, tmp_path / "c" / f"{network}.safetensors", {"any": "thing"})
    shuffled = dict(reversed(values.items()))
    weights.write(tmp_path / "d" / f"{network}.safetensors", shuffled, metadata={"x": "y"})
    found = {weights.hashes(tmp_path / name)[network] for name in "abcd"}
    assert len(found) == 1
    assert len(found.pop()) == 64


def test_a_student_counts_only_where_it_is_used(tmp_path):
    """A run of the teacher resumes after a student was put into its folder."""
    ours(tmp_path, "dit")
    teacher = weights.hashes(tmp_path)
    weights.write(tmp_path / weights.STUDENT, {"a.kernel": np.ones((2, 3), np.float16)})
    assert weights.hashes(tmp_path) == teacher
    assert set(weights.hashes(tmp_path, student=True)) == {"dit", "student"}


@pytest.mark.parametrize("change", ["value", "name", "dtype", "shape", "sign of zero"])
def test_other_weights_have_another_hash(change, tmp_path):
    values = {"a.kernel": np.zeros((2, 3), np.float32), "b": np.ones(3, np.float16)}
    weights.write(tmp_path / "1" / "dit.safetensors", values)
    other = {
        "value": values | {"b": np.array([1, 1, 2], np.float16)},
        "name": {"a.kernel": values["a.kernel"], "c": values["b"]},
        "dtype": values | {"b": values["b"].view(np.int16)},
        "shape": values | {"a.kernel": values["a.kernel"].reshape(3, 2)},
        "sign of zero": values | {"a.kernel": -values["a.kernel"]},
    }[change]
    weights.write(tmp_path / "2" / "dit.safetensors", other)
    assert weights.hashes(tmp_path / "1") != weights.hashes(tmp_path / "2")


def test_the_index_of_a_checkpoint_is_its_path(tmp_path):
    index = sharded(tmp_path, foreign("vae"), "vae", 2)
    (found,) = detect(index).found
    assert found.tensors.keys() == foreign("vae").keys()
    assert found.source.path == index
