"""A setting of an adapter that changes its meaning is applied, or refused by its name."""

import json
import math

import numpy as np
import pytest
import torch

from egosim_jax.convert.__main__ import main
from egosim_jax.convert.lora import read_lora
from egosim_jax.io.mapped import read_safetensors
from egosim_jax.models.lora import Value
from egosim_jax.types import InputError
from tests.unit.convert.made import CONFIG, DIM, LAYER, arrays, one_line, ours, pair, save

NAME = "base_model.model.blocks.0.self_attn.q"
PLAIN = {"peft_type": "LORA", "r": 2, "lora_alpha": 2, "target_modules": ["q"]}


def adapter(folder, tensors=None, stem="adapter_model", **settings):
    """A folder with an adapter and PEFT's settings."""
    folder.mkdir(exist_ok=True)
    save(folder / f"{stem}.safetensors", pair(name=NAME) if tensors is None else tensors)
    (folder / "adapter_config.json").write_text(json.dumps(PLAIN | settings), encoding="utf-8")
    return folder


def product(folder):
    change = read_lora(folder, CONFIG.dit)[LAYER]
    return change.down[0] @ change.up[0]


def expected(scale, rank=2):
    down, up = pair(rank=rank, name=NAME).values()
    return scale * (up @ down).numpy().T


REFUSED = {
    "init_lora_weights": ["pissa", "pissa_niter_16", "olora", "corda", "loftq", "lora_ga", "new"],
    "peft_type": ["LOKR", "LOHA", "ADALORA", "VERA"],
    "use_dora": [True],
    "alpha_pattern": [{"blocks.0.self_attn.q": 8}],
    "fan_in_fan_out": [True],
    "bias": ["all", "lora_only"],
    "lora_bias": [True],
    "modules_to_save": [["head"]],
    "layer_replication": [[[0, 1], [0, 1]]],
    "target_parameters": [["blocks.0.mlp.kernel"]],
    "megatron_config": [{"tensor_model_parallel_size": 2}],
    "trainable_token_indices": [[0, 1]],
    "alora_invocation_tokens": [[5]],
    "a_setting_of_next_year": [0.5, True, "on"],
}


@pytest.mark.parametrize(
    ("key", "value"), [(key, value) for key, values in REFUSED.items() for value in values]
)
def test_a_setting_that_cannot_be_applied_is_named(tmp_path, key, value):
    folder = adapter(tmp_path / "a", **{key: value})
    with pytest.raises(InputError, match=rf"adapter_config\.json has .*{key}") as caught:
        read_lora(folder, CONFIG.dit)
    assert "egosim convert weights" in str(caught.value)


@pytest.mark.parametrize(
    "settings",
    [
        *({"init_lora_weights": value} for value in (True, False, "gaussian", "eva", "orthogonal")),
        {"use_dora": False, "modules_to_save": None, "layer_replication": None, "lora_bias": False},
        {"lora_dropout": 0.1, "task_type": None, "inference_mode": True, "megatron_core": "x"},
        {"alpha_pattern": {"blocks.0.self_attn.q": 2}, "rank_pattern": {}, "bias": "none"},
        {"target_modules": "all-linear"},
        {"target_modules": ["self_attn.q", "ffn.0"], "peft_version": "0.18.1"},
    ],
    ids=str,
)
def test_a_setting_without_meaning_changes_nothing(tmp_path, settings):
    np.testing.assert_allclose(product(adapter(tmp_path / "a", **settings)), expected(1), atol=1e-5)


@pytest.mark.parametrize(
    ("settings", "rank", "scale"),
    [
        ({"lora_alpha": 6}, 2, 3),
        ({"lora_alpha": 6, "use_rslora": True}, 2, 6 / math.sqrt(2)),
        ({"lora_alpha": 6, "rank_pattern": {"q": 4}}, 4, 6 / 4),
        ({"lora_alpha": 6, "rank_pattern": {"q": 4}, "use_rslora": True}, 4, 6 / 2),
    ],
)
def test_a_setting_of_the_scale_is_applied(tmp_path, settings, rank, scale):
    folder = adapter(tmp_path / "a", pair(rank=rank, name=NAME), **settings)
    np.testing.assert_allclose(product(folder), expected(scale, rank), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("settings", "tensors", "why"),
    [
        ({"r": 16}, None, "rank 2; expected 16"),
        ({"r": 16, "rank_pattern": {"k": 8}}, None, "rank 2; expected 16; 8"),
        ({"target_modules": ["to_q", "to_k"]}, None, "not of its target_modules"),
        (
            {"lora_alpha": 4},
            pair(name=NAME) | {f"{NAME}.alpha": torch.tensor(1.0)},
            "has alpha 1; expected lora_alpha 4",
        ),
    ],
)
def test_settings_of_another_adapter_next_to_the_file_are_refused(
    tmp_path, settings, tensors, why, capsys
):
    folder = adapter(tmp_path / "a", tensors, **settings)
    args = ["lora", folder, "--config", "debug", "--out", tmp_path / "x.safetensors"]
    said = one_line(capsys, 2, *args)
    assert why in said
    assert "move adapter_model.safetensors to a folder without one" in said
    alone = tmp_path / "alone"
    alone.mkdir()
    (folder / "adapter_model.safetensors").rename(alone / "adapter_model.safetensors")
    assert read_lora(alone, CONFIG.dit).keys() == {LAYER}


def test_settings_next_to_two_files_are_of_pefts_own(tmp_path):
    folder = adapter(tmp_path / "a")
    other = save(folder / "other.safetensors", pair())
    with pytest.raises(InputError, match=r"belongs to adapter_model\.safetensors, not to other"):
        read_lora(other, CONFIG.dit)
    assert read_lora(folder / "adapter_model.safetensors", CONFIG.dit).keys() == {LAYER}


@pytest.mark.parametrize("infix", ["", ".modules_to_save", ".modules_to_save.default"])
def test_modules_to_save_replace_the_weights_of_the_base(tmp_path, infix):
    shape = arrays("dit")["head.linear.bias"].shape
    tensors = pair(name=NAME) | {f"base_model.model.head.head{infix}.bias": torch.ones(shape)}
    folder = adapter(tmp_path / "a", tensors, modules_to_save=["head.head"])
    change = read_lora(folder, CONFIG.dit)["head.linear.bias"]
    assert isinstance(change, Value)
    base = ours(tmp_path / "base", "dit")
    args = ["lora", folder, "--config", "debug", "--merge", base, "--out", tmp_path / "out"]
    assert main([str(arg) for arg in args]) == 0
    assert (
        read_safetensors(tmp_path / "out" / "dit.safetensors")["head.linear.bias"].array() == 1
    ).all()
    plain = adapter(tmp_path / "b", tensors)
    with pytest.raises(InputError, match=r"head\.head.*not of a layer"):
        read_lora(plain, CONFIG.dit)


def test_settings_that_are_not_there_are_said_to_be_assumed(tmp_path, capsys):
    read_lora(save(tmp_path / "adapter_model.safetensors", pair(name=NAME)), CONFIG.dit)
    assert "alpha is taken as the rank" in capsys.readouterr().err
    read_lora(adapter(tmp_path / "a"), CONFIG.dit)
    read_lora(save(tmp_path / "comfyui.safetensors", pair()), CONFIG.dit)
    assert not capsys.readouterr().err


def test_settings_of_a_pipeline_in_the_header_are_those_of_the_denoiser(tmp_path):
    said = {"transformer.lora_alpha": 6, "transformer.r": 2, "text_encoder.lora_alpha": 1}
    file = tmp_path / "x.safetensors"
    tensors = pair(name="transformer.blocks.0.self_attn.q")
    save(file, tensors, {"lora_adapter_metadata": json.dumps(said)})
    np.testing.assert_allclose(product(file), expected(3), atol=1e-5)
    said["transformer.init_lora_weights"] = "pissa"
    save(file, tensors, {"lora_adapter_metadata": json.dumps(said)})
    with pytest.raises(InputError, match="init_lora_weights 'pissa'"):
        read_lora(file, CONFIG.dit)


def test_merged_weights_are_converted_as_a_refusal_says(tmp_path):
    """The fix of each refusal: the sum of base and adapter, written as a checkpoint."""
    args = ["--config", "debug", "--only", "dit", "--out"]
    base = ours(tmp_path / "base", "dit")
    for command in (
        ["to-torch", base, *args, tmp_path / "theirs"],
        ["weights", tmp_path / "theirs", *args, tmp_path / "again"],
    ):
        assert main([str(arg) for arg in command]) == 0
    again = read_safetensors(tmp_path / "again" / "dit.safetensors")
    assert all(np.array_equal(again[name].array(), a) for name, a in arrays("dit").items())
    assert again[f"{LAYER}.kernel"].shape[-1] == DIM
