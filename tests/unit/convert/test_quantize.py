"""Weights folders in 8 bits: conversion, verification, refusals, and generation with them."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from egosim_jax.configs.model import Networks
from egosim_jax.convert import writer
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.quantize import quantized_metadata, quantized_weights
from egosim_jax.generation.generator import Generator
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_metadata, read_safetensors, read_weights_hash
from egosim_jax.models.eight_bit import DTYPES, EightBitLinear
from egosim_jax.types import InputError
from tests.unit.convert.made import CONFIG, arrays, one_line, ours

NETWORKS = ("dit", "text", "image", "vae")


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return ours(tmp_path_factory.mktemp("source"), *NETWORKS)


def quantize(source, out, kind="int8", *more):
    args = ["quantize", source, "--out", out, "--kind", kind, *more]
    return main([str(arg) for arg in args])


def verify(source, folder):
    return main(["verify", str(source), str(folder), "--config", "debug"])


@pytest.mark.parametrize("kind", DTYPES)
def test_kernels_are_in_8_bits_and_all_else_is_as_it_was(source, tmp_path, kind):
    assert quantize(source, tmp_path / "out", kind) == 0
    for network in NETWORKS[:2]:
        file = tmp_path / "out" / f"{network}.safetensors"
        tensors, before = read_all(file), arrays(network)
        for name, array in before.items():
            scales = tensors.get(f"{name.removesuffix('.kernel')}.scale")
            if name.endswith(".kernel") and scales is not None:
                assert tensors[name].dtype == DTYPES[kind]
                back = tensors[name].astype(np.float32) * scales[:, None]
                step = 0.51 / 127 if kind == "int8" else 1 / 16
                assert (np.abs(back - array) <= step * np.abs(array).max(axis=1)[:, None]).all()
            else:
                np.testing.assert_array_equal(tensors[name], array)
        metadata = read_metadata(file)
        assert metadata["quantized"] == kind
        assert metadata["source_sha256"] == read_weights_hash(source / file.name)
        assert metadata["config"] == "debug"
    for network in NETWORKS[2:]:
        name = f"{network}.safetensors"
        assert (tmp_path / "out" / name).read_bytes() == (source / name).read_bytes()


def read_all(file):
    return {name: tensor.array() for name, tensor in read_safetensors(file).items()}


@pytest.mark.parametrize("kind", DTYPES)
def test_an_interrupted_conversion_continues_to_the_same_bytes(source, tmp_path, kind, monkeypatch):
    assert quantize(source, tmp_path / "once", kind) == 0
    monkeypatch.setattr(writer, "SYNC_BYTES", 0)
    file, target = source / "dit.safetensors", tmp_path / "twice" / "dit.safetensors"
    pieces = writer.write(
        target,
        quantized_weights(file, kind),
        origin=[file],
        metadata=quantized_metadata(file, kind),
        settings=kind,
    )
    written = sum(next(pieces) for _ in range(25))
    pieces.close()
    (part,) = target.parent.glob("dit.*")
    assert part.stat().st_size >= written
    inode = part.stat().st_ino
    assert quantize(source, tmp_path / "twice", kind) == 0
    assert target.stat().st_ino == inode
    assert target.read_bytes() == (tmp_path / "once" / "dit.safetensors").read_bytes()


def test_verify_detects_a_changed_byte_and_another_source(source, tmp_path, capsys):
    assert quantize(source, tmp_path / "out") == 0
    assert verify(source, tmp_path / "out") == 0
    said = capsys.readouterr().out
    assert f"dit: {len(arrays('dit')) + 12} of {len(arrays('dit')) + 12} weights equal" in said
    larger = {name: array * np.float32(1.5) for name, array in arrays("dit").items()}
    ours(tmp_path / "other", *NETWORKS[1:])
    weights.write(tmp_path / "other" / "dit.safetensors", larger)
    assert verify(tmp_path / "other", tmp_path / "out") == 1
    said = capsys.readouterr().out
    assert "dit: blocks.self_attn.q.scale differs" in said
    assert "dit: made of weights with the hash" in said
    for name in ("dit", "vae"):
        file = tmp_path / "out" / f"{name}.safetensors"
        data = bytearray(file.read_bytes())
        data[-5] ^= 1
        file.unlink()  # not the source that it may be linked to
        file.write_bytes(data)
        assert verify(source, tmp_path / "out") == 1
        assert f"{name}: " in (said := capsys.readouterr().out)
        assert "does not match its checksum" in said


KERNEL = "blocks.self_attn.q.kernel"
VALUES = {
    "NaN": (np.nan, "not finite"),
    "infinite": (np.inf, "not finite"),
    "tiny": (1e-44, "whose scale float32 cannot hold"),
}


@pytest.mark.parametrize("kind", DTYPES)
@pytest.mark.parametrize("case", VALUES)
def test_weights_that_8_bits_cannot_represent_are_refused(tmp_path, capsys, kind, case):
    value, message = VALUES[case]
    kernel = arrays("dit")[KERNEL].copy()
    kernel[1, :, 4] = value
    changed = arrays("dit") | {KERNEL: kernel}
    weights.write(tmp_path / "source" / "dit.safetensors", changed)
    args = ("--out", tmp_path / "out", "--kind", kind, "--only", "dit")
    said = one_line(capsys, 2, "quantize", tmp_path / "source", *args)
    assert message in said
    assert "blocks.self_attn.q of block 1" in said
    assert not [path for path in (tmp_path / "out").iterdir() if "dit" in path.name]


def test_a_channel_of_zeros_is_converted(tmp_path):
    kernel = arrays("dit")[KERNEL].copy()
    kernel[0, :, 2] = 0
    weights.write(tmp_path / "source" / "dit.safetensors", arrays("dit") | {KERNEL: kernel})
    assert quantize(tmp_path / "source", tmp_path / "out", "int8", "--only", "dit") == 0
    tensors = read_all(tmp_path / "out" / "dit.safetensors")
    assert tensors["blocks.self_attn.q.scale"][0, 2] == 1
    assert not tensors[KERNEL][0, :, 2].any()


def test_what_cannot_be_in_8_bits_or_comes_from_8_bits_is_refused(source, tmp_path, capsys):
    out, more = tmp_path / "out", ("--kind", "int8", "--out")
    assert quantize(source, out) == 0
    capsys.readouterr()
    ours(tmp_path / "less", "image")
    lora = tmp_path / "lora.safetensors"
    for wanted, args in {
        "in 8 bits already": ("quantize", out, *more, tmp_path / "again"),
        "separate output path": ("quantize", source, *more, source),
        "No weights file": ("quantize", tmp_path / "less", *more, tmp_path / "new"),
        "(--only)": ("quantize", source, *more, tmp_path / "new", "--only", "vae"),
        "cannot be converted further": (
            "to-torch", out, "--config", "debug", "--out", tmp_path / "torch",
        ),
        "Give the weights that they were made of": (
            "lora", lora, "--config", "debug", "--merge", out, "--out", tmp_path / "merged",
        ),
    }.items():  # fmt: skip
        assert wanted in one_line(capsys, 2, *args)


def test_a_set_in_8_bits_is_not_trained_and_takes_no_lora(source, tmp_path):
    out = tmp_path / "out"
    assert quantize(source, out, "float8") == 0
    abstract = nnx.state(Networks.abstract(CONFIG, only=["dit"]), nnx.Param)
    for refused, use in (
        (lambda: weights.check_trainable(out), "cannot be trained"),
        (lambda: weights.place(out, abstract, abstract), "cannot be trained"),
        (lambda: Generator.load(CONFIG, out, lora=tmp_path / "lora.safetensors"), "take no LoRA"),
    ):
        with pytest.raises(InputError, match=use):
            refused()
    weights.check_trainable(source)


def test_the_lora_of_a_student_is_omitted(tmp_path, capsys):
    ours(tmp_path / "source", *NETWORKS)
    (tmp_path / "source" / weights.STUDENT).write_bytes(b"a LoRA")
    assert quantize(tmp_path / "source", tmp_path / "out") == 0
    assert not (tmp_path / "out" / weights.STUDENT).exists()
    assert "Merge it first" in capsys.readouterr().err


def forward(networks):
    """The velocity of a fixed input."""
    config = CONFIG.dit
    x = jax.random.normal(jax.random.key(0), (1, 2, 4, 4, config.in_channels))
    text = jax.random.normal(jax.random.key(1), (1, 6, config.text_dim))
    image = jax.random.normal(jax.random.key(2), (1, 5, config.image_dim))
    return np.asarray(networks.dit(x, jnp.array([500.0]), text, image))


@pytest.mark.parametrize("kind", DTYPES)
def test_networks_recognize_8_bits_by_themselves(source, tmp_path, kind):
    assert quantize(source, tmp_path, kind) == 0
    whole = Networks.load(CONFIG, source)
    assert not has_8_bits(whole.dit)
    loaded = Networks.load(CONFIG, tmp_path)
    assert has_8_bits(loaded.dit)
    assert has_8_bits(loaded.text)
    want, got = forward(whole), forward(loaded)
    error = np.linalg.norm(got - want) / np.linalg.norm(want)
    assert 1e-4 < error < (0.02 if kind == "int8" else 0.08)
    # The same as the original network with the dequantized kernels, up to the order of sums.
    for path, module in nnx.iter_modules(loaded.dit):
        if isinstance(module, EightBitLinear):
            kernel = np.asarray(module.kernel[...], np.float32)
            linear = whole.dit
            for name in path:
                linear = getattr(linear, str(name))
            linear.kernel[...] = jnp.asarray(kernel * np.asarray(module.scale[...])[:, None])
    np.testing.assert_allclose(forward(whole), got, rtol=1e-4, atol=1e-4 * np.abs(got).max())


def has_8_bits(network):
    return any(isinstance(module, EightBitLinear) for _, module in nnx.iter_modules(network))


def test_a_loaded_set_can_be_saved_and_loaded_again(source, tmp_path):
    assert quantize(source, tmp_path / "out") == 0
    loaded = Networks.load(CONFIG, tmp_path / "out", only=["dit"])
    loaded.save(tmp_path / "saved")
    before = read_all(tmp_path / "out" / "dit.safetensors")
    after = read_all(tmp_path / "saved" / "dit.safetensors")
    assert all(np.array_equal(after[name], array) for name, array in before.items())
    assert has_8_bits(Networks.load(CONFIG, tmp_path / "saved", only=["dit"]).dit)


def test_activations_in_8_bits_need_weights_in_8_bits(source, tmp_path):
    config = replace(CONFIG, activations="8bit")
    with pytest.raises(InputError, match="--activations-8bit"):
        Networks.load(config, source)
    assert quantize(source, tmp_path) == 0
    networks = Networks.load(config, tmp_path)
    assert networks.dit.blocks.mlp.up.activations
    assert not networks.text.blocks.ffn.up.activations
    error = np.linalg.norm(forward(networks) - (want := forward(Networks.load(CONFIG, tmp_path))))
    assert 0 < error < 0.05 * np.linalg.norm(want)
