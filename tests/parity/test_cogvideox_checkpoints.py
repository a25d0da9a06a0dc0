"""Checkpoints of CogVideoX-Fun, in diffusers' layout, to weights and back, by the commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXTransformer3DModel
from safetensors.numpy import save_file
from transformers import T5Config, T5EncoderModel

from egosim_jax import configs
from egosim_jax.configs.model import Networks
from egosim_jax.convert.__main__ import main as egosim_convert
from egosim_jax.convert.lora import read_lora
from egosim_jax.convert.tables import cogvideox_dit, cogvideox_vae, umt5
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.models.lora import apply
from egosim_jax.types import InputError


@pytest.fixture(scope="module")
def model():
    with pytest.MonkeyPatch.context() as patch:
        folder = str(Path(__file__).with_name("cogvideox_configs"))
        patch.setattr(configs, "__path__", [*configs.__path__, folder])
        yield configs.get("dwm_tiny")


@pytest.fixture(scope="module")
def released(model, tmp_path_factory):
    """A base model of 33 channels as CogVideoX-Fun publishes it."""
    folder = tmp_path_factory.mktemp("released")
    torch.manual_seed(0)
    base = replace(model.dit, in_channels=33)
    CogVideoXTransformer3DModel(**cogvideox_dit.arguments(base)).save_pretrained(
        folder / "transformer"
    )
    AutoencoderKLCogVideoX(**cogvideox_vae.arguments(model.vae)).save_pretrained(folder / "vae")
    T5EncoderModel(T5Config(**umt5.arguments(model.text))).save_pretrained(folder / "text_encoder")
    return folder


@pytest.fixture(scope="module")
def converted(released, tmp_path_factory):
    out = tmp_path_factory.mktemp("converted") / "weights"
    command = f"weights {released} --config dwm_tiny --out {out} --widen polarity"
    assert egosim_convert(command.split()) == 0
    return out


def arrays_of(file):
    return {name: tensor.array() for name, tensor in read_safetensors(file).items()}


def test_the_widened_model_is_its_base_until_it_is_trained(released, converted):
    kernel = arrays_of(converted / "dit.safetensors")["patch.kernel"]
    (file,) = (released / "transformer").glob("*.safetensors")
    base = arrays_of(file)["patch_embed.proj.weight"]
    np.testing.assert_array_equal(kernel[:33], np.moveaxis(base, 0, -1))
    assert not kernel[33:].any()


@pytest.mark.slow
def test_conversion_is_verified_value_by_value_and_by_a_forward(released, converted, capsys):
    command = f"verify {released} {converted} --config dwm_tiny --widen polarity"
    assert egosim_convert(command.split()) == 0
    said = capsys.readouterr().out
    for name in ("dit", "vae", "text"):
        assert name in said


def test_diffusers_loads_what_is_written_for_it_bit_for_bit(model, converted, tmp_path):
    out = tmp_path / "torch"
    command = f"to-torch {converted} --config dwm_tiny --out {out} --layout diffusers"
    assert egosim_convert(command.split()) == 0
    transformer = CogVideoXTransformer3DModel.from_pretrained(out / "transformer")
    assert transformer.config.in_channels == 49
    AutoencoderKLCogVideoX.from_pretrained(out / "vae")
    T5EncoderModel.from_pretrained(out / "text_encoder")
    again = tmp_path / "again"
    command = f"weights {out} --config dwm_tiny --out {again}"
    assert egosim_convert(command.split()) == 0
    for name in ("dit", "vae", "text"):
        have, want = (arrays_of(f / f"{name}.safetensors") for f in (again, converted))
        assert have.keys() == want.keys()
        for path in want:
            np.testing.assert_array_equal(have[path], want[path], err_msg=path)


@pytest.mark.parametrize("prefix", ["", "base_model.model."])
def test_a_checkpoint_of_dwm_is_merged_as_its_own_formula_says(model, converted, tmp_path, prefix):
    """Low-rank attention with alpha = rank, and a patch projection that replaces the base's."""
    rng, rank, dim = np.random.default_rng(0), 4, model.dit.dim
    source = tmp_path / "checkpoint-8000"
    source.mkdir()
    tensors, products = {}, {}
    for block in range(model.dit.layers):
        for name in ("to_q", "to_k", "to_v", "to_out.0"):
            key = f"transformer_blocks.{block}.attn1.{name}"
            down, up = rng.normal(size=(rank, dim)), rng.normal(size=(dim, rank))
            tensors[f"{prefix}{key}.lora_A.weight"] = down.astype(np.float32)
            tensors[f"{prefix}{key}.lora_B.weight"] = up.astype(np.float32)
            products[block, name] = (up @ down).T
    save_file(tensors, source / "pytorch_lora_weights.safetensors")
    kernel = rng.normal(size=(dim, 49, 2, 2)).astype(np.float32)
    bias = rng.normal(size=dim).astype(np.float32)
    in_full = {"patch_embed.proj.weight": kernel, "patch_embed.proj.bias": bias}
    save_file(in_full, source / "non_lora_weights.safetensors")
    out = tmp_path / "merged"
    command = f"lora {source} --config dwm_tiny --merge {converted} --out {out}"
    assert egosim_convert(command.split()) == 0
    have, base = (arrays_of(folder / "dit.safetensors") for folder in (out, converted))
    np.testing.assert_array_equal(have["patch.kernel"], np.moveaxis(kernel, 0, -1))
    np.testing.assert_array_equal(have["patch.bias"], bias)
    for name, ours in (("to_q", "q"), ("to_out.0", "o")):
        path = f"blocks.attn.{ours}.kernel"
        for block in range(model.dit.layers):
            want = base[path][block] + products[block, name]
            np.testing.assert_allclose(have[path][block], want, atol=1e-5)
    applied = Networks.load(model, converted, only=["dit"]).dit
    apply(applied, read_lora(source, model.dit))
    kernel = applied.patch.kernel.get_value()
    np.testing.assert_allclose(kernel, have["patch.kernel"], atol=1e-6)
    command = f"lora {source} --config dwm_tiny --out {tmp_path / 'lora.safetensors'}"
    assert egosim_convert(command.split()) == 2  # it could not name a value that replaces


def test_weights_in_full_that_are_not_of_the_network_are_refused(model, tmp_path):
    save_file(
        {"transformer_blocks.0.attn1.to_q.lora_A.weight": np.zeros((2, 32), np.float32)},
        tmp_path / "pytorch_lora_weights.safetensors",
    )
    save_file({"head.bias": np.zeros(3)}, tmp_path / "non_lora_weights.safetensors")
    with pytest.raises(InputError, match="has no lora_B"):
        read_lora(tmp_path, model.dit)
    save_file(
        {
            "transformer_blocks.0.attn1.to_q.lora_A.weight": np.zeros((2, 32), np.float32),
            "transformer_blocks.0.attn1.to_q.lora_B.weight": np.zeros((32, 2), np.float32),
        },
        tmp_path / "pytorch_lora_weights.safetensors",
    )
    with pytest.raises(InputError, match=r"head\.bias: not a weight of this network"):
        read_lora(tmp_path, model.dit)


def test_version_1_5_is_refused_with_the_version_to_take(model, tmp_path, capsys):
    base = replace(model.dit, in_channels=33)
    module = CogVideoXTransformer3DModel(**cogvideox_dit.arguments(base), patch_size_t=2)
    module.save_pretrained(tmp_path / "released" / "transformer")
    command = f"weights {tmp_path}/released --config dwm_tiny --out {tmp_path}/out --widen polarity"
    assert egosim_convert([*command.split(), "--only", "dit"]) == 2
    message = " ".join(capsys.readouterr().err.split())
    assert "one latent frame, and its patch_embed.proj.weight of shape (32, 264)" in message
    assert "CogVideoX-Fun-V1.1-5b-InP" in message
    assert not (tmp_path / "out" / "dit.safetensors").exists()
