"""LoRA files of every project give the same change, by one table of names and strengths."""

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
from tests.unit.convert.made import CONFIG, DIM, LAYER, NAME, arrays, one_line, ours, pair, save

RANK = 4
PEFT = {
    "r": RANK,
    "lora_alpha": 6,
    "peft_type": "LORA",
    "target_modules": ["q", "0", "to_q", "proj"],
}
WAN = {"blocks.1.self_attn.q": "blocks.self_attn.q", "blocks.1.ffn.0": "blocks.mlp.up"}
DIFFUSERS = {
    "blocks.1.attn1.to_q": "blocks.self_attn.q",
    "blocks.1.ffn.net.0.proj": "blocks.mlp.up",
}

NAMES = {
    "PEFT": (WAN, "base_model.model.{}", "lora_A.default.weight", "lora_B.default.weight"),
    "diffusers, finetrainers, SimpleTuner": (
        DIFFUSERS, "transformer.{}", "lora_A.weight", "lora_B.weight",
    ),
    "diffusers of before": (DIFFUSERS, "transformer.{}", "lora.down.weight", "lora.up.weight"),
    "ComfyUI": (WAN, "diffusion_model.{}", "lora_A.weight", "lora_B.weight"),
    "LightX2V": (WAN, "diffusion_model.{}", "lora_down.weight", "lora_up.weight"),
    "FastVideo": (DIFFUSERS, "{}", "lora_A", "lora_B"),
    "kohya, musubi": (WAN, "lora_unet_{_}", "lora_down.weight", "lora_up.weight"),
    "VideoX-Fun": (WAN, "lora_unet__{_}", "lora_down.weight", "lora_up.weight"),
    "LyCORIS": (WAN, "lycoris_{_}", "lora_down.weight", "lora_up.weight"),
}  # fmt: skip
"""Layers, their names, and the ends of the two factors by project."""

STRENGTHS = [
    ({}, 1, "alpha is taken as the rank"),
    ({"tensor": ("alpha", 6.0)}, 6 / 4, ""),
    ({"tensor": ("lora_alpha", 6.0)}, 6 / 4, ""),
    ({"tensor": ("alpha", 0.0)}, 1, "alpha 0 is taken as the rank"),
    ({"tensor": ("alpha", 6.0), "rank": "16", "alpha": "16"}, 6 / 4, ""),
    ({"lora_alpha": "6", "lora_rank": "4"}, 6 / 4, ""),
    ({"lora_alpha": "6", "use_rslora": "True"}, 6 / 2, ""),
    ({"network_alpha": "6"}, 6 / 4, ""),
    ({"network_alpha": "0"}, 1, "alpha 0 is taken as the rank"),
    ({"ss_network_alpha": "6.0", "ss_network_dim": "16"}, 6 / 4, ""),
    ({"ss_network_alpha": "0.0"}, 1, "alpha 0 is taken as the rank"),
    ({"ss_network_alpha": "None"}, 1, "alpha is taken as the rank"),
    ({"alpha": "6"}, 6 / 4, ""),
    (
        {"tensor": ("alpha", 6.0), "ss_network_args": '{"rs_lora": "True", "conv_alpha": "1"}'},
        6 / 2,
        "",
    ),
    ({"ss_network_alpha": "6", "ss_tag_frequency": '{"alpha male": 3, "rank 1": 2}'}, 6 / 4, ""),
    ({"training": '{"lora_alpha": 6, "lr": 1e-4}', "note": "{rank"}, 6 / 4, ""),
    ({"lora_config": json.dumps(PEFT | {"target_modules": "(to_q|ffn)"})}, 6 / 4, ""),
    ({"lora_adapter_metadata": json.dumps(PEFT | {"use_rslora": True})}, 6 / 2, ""),
    ({"adapter_config": json.dumps(PEFT | {"r": 8, "rank_pattern": {"q": RANK}})}, 6 / 4, ""),
    ({"peft_config": json.dumps(PEFT), "lora_alpha": "6"}, 6 / 4, ""),
    ({"peft_config": '{"network_alpha": 6}'}, 6 / 4, ""),
    (
        {
            "lora_adapter_metadata": json.dumps(
                {f"transformer.{key}": value for key, value in {"r": 4, "lora_alpha": 6}.items()}
                | {"text_encoder.lora_alpha": 1}
            )
        },
        6 / 4,
        "",
    ),
]
"""Header, or the end and value of a tensor; the factor of B A; and the note that is printed."""


@pytest.fixture(scope="module")
def factors():
    torch.manual_seed(0)
    wide = {"blocks.self_attn.q": DIM, "blocks.mlp.up": CONFIG.dit.ffn_dim}
    return {p: (torch.randn(RANK, DIM) / 4, torch.randn(out, RANK) / 4) for p, out in wide.items()}


@pytest.mark.parametrize("names", NAMES)
def test_the_change_is_the_scaled_product_of_the_factors(names, factors, tmp_path, capsys):
    layers, form, *ends = NAMES[names]
    for said, scale, note in STRENGTHS:
        header, tensors = dict(said), {}
        end, alpha = header.pop("tensor", (None, None))
        for layer, path in layers.items():
            name = form.replace("{_}", layer.replace(".", "_")).replace("{}", layer)
            tensors |= {f"{name}.{e}": t for e, t in zip(ends, factors[path], strict=True)}
            tensors |= {} if end is None else {f"{name}.{end}": torch.tensor(alpha)}
        changes = read_lora(save(tmp_path / "x.safetensors", tensors, header), CONFIG.dit)
        assert changes.keys() == factors.keys()
        for path, (down, up) in factors.items():
            expected = (scale * up.double() @ down.double()).numpy().T
            product = changes[path].down[1] @ changes[path].up[1]
            np.testing.assert_allclose(product, expected, rtol=1e-6, atol=1e-6, err_msg=str(said))
            assert not changes[path].up[0].any()
        printed = capsys.readouterr().err
        assert note in printed if note else not printed, said


def adapter(folder, tensors=None, **settings):
    """A folder with an adapter and PEFT's settings."""
    folder.mkdir(exist_ok=True)
    name = "base_model.model.blocks.0.self_attn.q"
    tensors = pair(rank=RANK, name=name) if tensors is None else tensors
    save(folder / "adapter_model.safetensors", tensors)
    (folder / "adapter_config.json").write_text(json.dumps(PEFT | settings), encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    "settings",
    [
        *({"init_lora_weights": value} for value in (True, False, "gaussian", "eva", "orthogonal")),
        {"use_dora": False, "modules_to_save": None, "layer_replication": None, "lora_bias": False},
        {"lora_dropout": 0.1, "task_type": None, "inference_mode": True, "megatron_core": "x"},
        {"alpha_pattern": {"blocks.0.self_attn.q": 6}, "rank_pattern": {}, "bias": "none"},
        {"target_modules": "all-linear", "peft_version": "0.18.1"},
    ],
    ids=str,
)
def test_the_config_next_to_the_file_is_applied(tmp_path, settings, capsys):
    (change,) = read_lora(adapter(tmp_path / "a", **settings), CONFIG.dit).values()
    down, up = pair(rank=RANK).values()
    np.testing.assert_allclose(
        change.down[0] @ change.up[0], (6 / 4 * up @ down).numpy().T, atol=1e-5
    )
    assert not capsys.readouterr().err


REFUSED = {
    "init_lora_weights": ["pissa", "pissa_niter_16", "olora", "corda", "loftq", "lora_ga", "new"],
    "peft_type": ["LOKR", "LOHA", "ADALORA", "VERA"],
    "use_dora": [True],
    "alpha_pattern": [{"blocks.0.self_attn.q": 8}, [8]],
    "fan_in_fan_out": [True],
    "bias": ["all", "lora_only"],
    "lora_bias": [True],
    "modules_to_save": [["head"]],
    "layer_replication": [[[0, 1], [0, 1]]],
    "target_parameters": [["blocks.0.mlp.kernel"]],
    "megatron_config": [{"tensor_model_parallel_size": 2}],
    "a_setting_of_next_year": [0.5, True, "on"],
    "lora_alpha": [0, None, "a", math.inf],
    "use_rslora": ["perhaps"],
    # of another adapter
    "r": [16],
    "target_modules": [["to_k"]],
}


@pytest.mark.parametrize("key", REFUSED)
def test_a_setting_that_cannot_be_applied_is_named(tmp_path, key):
    for value in REFUSED[key]:
        named = "rank 4; expected 16" if key == "r" else key
        with pytest.raises(InputError, match=named) as caught:
            read_lora(adapter(tmp_path / "a", **{key: value}), CONFIG.dit)
        assert "adapter_config.json" in str(caught.value)


@pytest.mark.parametrize(
    "header",
    [
        {"alpha_scale": "0.5"},
        {"LoRA_Alpha_V2": "8"},
        {"effective_rank": "64"},
        {"rslora": "True"},
        {"trainer": '{"scale_alpha": 0.5}'},
    ],
    ids=str,
)
def test_a_header_key_like_alpha_or_rank_that_is_not_understood_is_named(tmp_path, header):
    ((key, value),) = header.items()
    if value.startswith("{"):
        ((key, value),) = json.loads(value).items()
    file = save(tmp_path / "x.safetensors", pair(rank=RANK), header)
    with pytest.raises(InputError, match=f"'{key}' '?{value}'?, which may be the strength"):
        read_lora(file, CONFIG.dit)


ALPHA = f"{NAME}.alpha"
BAD = {
    "two alphas in a header": (pair(), {"lora_alpha": "8", "network_alpha": "4"}, "is 8.* is 4"),
    "two configs": (
        pair(rank=4),
        {"lora_alpha": "8", "lora_config": json.dumps(PEFT | {"target_modules": "x"})},
        "lora_config of .* is 6.*is 8",
    ),
    "another alpha of a layer": (
        pair() | {ALPHA: torch.tensor(1.0)}, {"lora_alpha": "4"}, "alpha 1; expected lora_alpha 4",
    ),
    "another rank": (pair(), {"lora_rank": "8", "lora_alpha": "8"}, "rank 2; expected 8"),
    "lora_alpha 0": (pair(), {"lora_alpha": "0"}, "lora_alpha .*is 0"),
    "a lora_alpha of 0 of a layer": (
        pair() | {f"{NAME}.lora_alpha": torch.tensor(0.0)}, None, "lora_alpha .*is 0",
    ),
    "a damaged config": (pair(), {"lora_config": "{"}, "lora_config"),
    "no alpha in a config": (pair(), {"peft_config": '{"r": 2}'}, "has no lora_alpha"),
    "NaN in the header": (pair(), {"ss_network_alpha": "nan"}, "not a finite"),
    "a word in the header": (pair(), {"alpha": "much"}, "not a finite"),
    "NaN as alpha": (pair() | {ALPHA: torch.tensor(math.nan)}, None, "not a finite"),
    "several alphas": (pair() | {ALPHA: torch.ones(2)}, None, "2 numbers as alpha"),
    "an alpha too high": (pair() | {ALPHA: torch.tensor(3e38)}, None, "not finite"),
    "infinite weights": ({k: v + math.inf for k, v in pair().items()}, None, "not finite"),
    "an infinite delta": ({f"{NAME}.diff_b": torch.full((DIM,), math.inf)}, None, "not finite"),
    "rank 0": (pair(rank=0), None, "has rank 0"),
    "rank 5,000": (pair(rank=5000), None, "has rank 5000"),
    "another width": (pair(dim=DIM + 1), None, r"block 0: has shapes \(2, 49\)"),
    "two ranks": (
        pair() | {f"{NAME}.lora_B.weight": torch.rand(DIM, 3)}, None, r"block 0: has shapes",
    ),
    "one factor": ({f"{NAME}.lora_A.weight": torch.rand(2, DIM)}, None, "block 0: has no lora_B"),
    "another shape of a delta": (
        {f"{NAME}.diff": torch.rand(DIM, 7)}, None, r"block 0: has shape \(7, 48\)",
    ),
    "a layer too many": (pair(name="blocks.30.self_attn.q"), None, "not of a layer"),
    "a text encoder alone": (pair(name="lora_te_a"), None, "has no layers"),
    "nothing": ({}, None, "has no layers"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_lora_that_would_do_harm_is_refused(tmp_path, name):
    tensors, header, reason = BAD[name]
    with pytest.raises(InputError, match=reason):
        read_lora(save(tmp_path / "x.safetensors", tensors, header), CONFIG.dit)


def test_all_tensors_that_do_not_fit_are_one_list(tmp_path, capsys):
    other = "diffusion_model.blocks.99.self_attn.q"
    bad = {f"{NAME}.lora_A.weight": torch.rand(3, DIM), f"{NAME}.diff": torch.rand(DIM, 7)}
    file = save(tmp_path / "x.safetensors", bad | pair(name=other))
    args = ["lora", file, "--config", "debug", "--out", tmp_path / "out" / "x.safetensors"]
    said = one_line(capsys, 2, *args)
    assert "3 tensors" in said
    assert "blocks.99" in said
    assert not (tmp_path / "out").exists()


def test_settings_next_to_two_files_are_of_pefts_own(tmp_path):
    folder = adapter(tmp_path / "a")
    other = save(folder / "other.safetensors", pair())
    with pytest.raises(InputError, match=r"belongs to adapter_model\.safetensors, not to other"):
        read_lora(other, CONFIG.dit)
    assert read_lora(folder / "adapter_model.safetensors", CONFIG.dit).keys() == {LAYER}


@pytest.mark.parametrize("infix", ["", ".modules_to_save", ".modules_to_save.default"])
def test_modules_to_save_replace_the_weights_of_the_base(tmp_path, infix):
    shape = arrays("dit")["head.linear.bias"].shape
    bias = {f"base_model.model.head.head{infix}.bias": torch.ones(shape)}
    tensors = pair(rank=RANK, name="base_model.model.blocks.0.self_attn.q") | bias
    folder = adapter(tmp_path / "a", tensors, modules_to_save=["head.head"])
    assert isinstance(read_lora(folder, CONFIG.dit)["head.linear.bias"], Value)
    base = ours(tmp_path / "base", "dit")
    args = ["lora", folder, "--config", "debug", "--merge", base, "--out", tmp_path / "out"]
    assert main([str(arg) for arg in args]) == 0
    merged = read_safetensors(tmp_path / "out" / "dit.safetensors")["head.linear.bias"]
    assert (merged.array() == 1).all()
    with pytest.raises(InputError, match=r"head\.head.*not of a layer"):
        read_lora(adapter(tmp_path / "b", tensors), CONFIG.dit)


def test_layers_of_a_text_encoder_are_skipped_with_a_message(tmp_path, capsys):
    both = pair() | pair(name="lora_te_text_model_encoder_layers_0_mlp_fc1")
    changes = read_lora(save(tmp_path / "x.safetensors", both), CONFIG.dit)
    assert changes.keys() == {LAYER}
    assert "skipped 2 tensors of a text encoder" in capsys.readouterr().err


def test_ranks_of_blocks_may_differ(tmp_path):
    second = pair(rank=1, name="diffusion_model.blocks.1.self_attn.q")
    change = read_lora(save(tmp_path / "x.safetensors", pair() | second), CONFIG.dit)[LAYER]
    for block, tensors in enumerate((pair(), second)):
        down, up = tensors.values()
        np.testing.assert_allclose(
            change.down[block] @ change.up[block], (up @ down).numpy().T, atol=1e-5
        )
