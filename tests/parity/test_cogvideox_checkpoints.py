"""Checkpoints of CogVideoX-Fun, in diffusers' layout, to weights and back, by the commands."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLCogVideoX, CogVideoXTransformer3DModel
from transformers import T5Config, T5EncoderModel

from egosim_jax import configs
from egosim_jax.convert.__main__ import main as egosim_convert
from egosim_jax.convert.tables import cogvideox_dit, cogvideox_vae, umt5
from egosim_jax.io.mapped import read_safetensors


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
