"""LoRAs that `egosim-convert` refuses, and LoRA settings that it honors."""

import json
import math
import os

import numpy as np
import pytest
import torch
from flax import nnx
from safetensors.numpy import load_file

from egosim_jax.convert.__main__ import main
from egosim_jax.convert.lora import read_lora
from egosim_jax.io import weights
from egosim_jax.models import lora
from egosim_jax.models.wan.dit import WanDiT
from egosim_jax.types import InputError
from tests.unit.convert.made import CONFIG, DIM, LAYER, NAME, arrays, one_line, ours, pair, save


def product(tensors, scale=1.0):
    down, up = (tensors[f"{NAME}.lora_{end}.weight"].numpy() for end in "AB")
    return scale * (up @ down).T


def summand(changes):
    return changes[LAYER].down[0] @ changes[LAYER].up[0]


BAD = {
    "NaN as alpha": (pair() | {f"{NAME}.alpha": torch.tensor(math.nan)}, None, "not a finite"),
    "an infinite alpha": (pair() | {f"{NAME}.alpha": torch.tensor(math.inf)}, None, "not a finite"),
    "two alphas": (pair() | {f"{NAME}.alpha": torch.ones(2)}, None, "2 numbers as alpha"),
    "NaN in the header": (pair(), {"ss_network_alpha": "nan"}, "not a finite"),
    "a word in the header": (pair(), {"alpha": "much"}, "not a finite"),
    "NaN as weights": ({k: v * math.nan for k, v in pair().items()}, None, "not finite"),
    "infinite weights": ({k: v + math.inf for k, v in pair().items()}, None, "not finite"),
    "an alpha too high": (pair() | {f"{NAME}.alpha": torch.tensor(3e38)}, None, "not finite"),
    "an infinite delta": ({f"{NAME}.diff_b": torch.full((DIM,), math.inf)}, None, "not finite"),
    "rank 0": (pair(rank=0), None, "has rank 0"),
    "rank 5,000": (pair(rank=5000), None, "has rank 5000"),
    "another width": (pair(dim=DIM + 1), None, "expected"),
    "a layer too many": (pair(name="blocks.30.self_attn.q"), None, "not of a layer"),
    "a text encoder alone": (pair(name="lora_te_a"), None, "has no layers"),
    "nothing": ({}, None, "has no layers"),
}


@pytest.mark.parametrize("name", BAD)
def test_a_lora_that_would_do_harm_is_refused(tmp_path, name):
    tensors, about, reason = BAD[name]
    with pytest.raises(InputError, match=reason):
        read_lora(save(tmp_path / "x.safetensors", tensors, about), CONFIG.dit)


def own(layers=CONFIG.dit.layers, dim=DIM, path=LAYER, value=1.0):
    """In our names."""
    down = np.full((layers, dim, 2), value, np.float32)
    return {f"{path}.down": down, f"{path}.up": down.transpose(0, 2, 1).copy()}


@pytest.mark.parametrize(
    "tensors", [own(layers=30), own(dim=DIM + 1), own(path="blocks.nothing"), own(value=np.inf), {}]
)
def test_a_lora_in_our_names_that_does_not_fit_is_refused(tmp_path, capsys, tensors):
    path = tmp_path / "x.safetensors"
    weights.write(path, tensors, metadata=lora.metadata("debug", base="0"))
    out = tmp_path / "out" / "x.safetensors"
    assert main(["lora", str(path), "--config", "debug", "--out", str(out)]) == 2
    assert "error: " in capsys.readouterr().err
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
        read_lora(path, CONFIG.dit)


@pytest.mark.parametrize("scale", ["nan", "inf"])
def test_a_scale_is_a_finite_number(tmp_path, capsys, scale):
    file = save(tmp_path / "x.safetensors", pair())
    args = ["lora", file, "--config", "debug", "--out", tmp_path / "out", "--scale", scale]
    assert "scale must be a finite number" in one_line(capsys, 2, *args)
    with pytest.raises(InputError, match="scale"):
        lora.apply(nnx.Module(), {}, scale=float(scale))


def test_a_lora_of_another_base_is_refused(tmp_path, capsys):
    base, out = ours(tmp_path / "base", "dit"), tmp_path / "out"
    file = save(tmp_path / "x.safetensors", pair(), {"base_sha256": 64 * "a"})
    args = ["lora", file, "--config", "debug", "--out", out]
    assert "trained on other weights" in one_line(capsys, 2, *args, "--merge", base)
    assert "trained on other weights" in one_line(capsys, 2, *args, "--base", base)
    right = {"base_sha256": weights.hashes(base)["dit"]}
    save(tmp_path / "x.safetensors", pair(), right)
    assert main([str(arg) for arg in [*args, "--merge", base]]) == 0
    assert "no dit.safetensors" in one_line(capsys, 2, *args, "--base", tmp_path)


@pytest.mark.parametrize("root", [False, True])
def test_pefts_settings_are_honored(tmp_path, root):
    save(tmp_path / "adapter_model.safetensors", pair(rank=4))
    settings = {"lora_alpha": 6, "use_rslora": root}
    (tmp_path / "adapter_config.json").write_text(json.dumps(settings), encoding="utf-8")
    expected = product(pair(rank=4), 6 / (2 if root else 4))
    np.testing.assert_allclose(summand(read_lora(tmp_path, CONFIG.dit)), expected, rtol=1e-4)


def test_diffusers_settings_in_the_header_are_honored(tmp_path):
    said = {"lora_adapter_metadata": json.dumps({"transformer.lora_alpha": 6, "transformer.r": 2})}
    file = save(tmp_path / "x.safetensors", pair(), said)
    np.testing.assert_allclose(summand(read_lora(file, CONFIG.dit)), product(pair(), 3), rtol=1e-4)


@pytest.mark.parametrize("text", ["{}", "[]", "{", '{"lora_alpha": "a"}', '{"lora_alpha": NaN}',
                                  '{"lora_alpha": 1, "alpha_pattern": {"q": 2}}'])  # fmt: skip
def test_bad_settings_of_peft_are_refused(tmp_path, text):
    save(tmp_path / "adapter_model.safetensors", pair())
    (tmp_path / "adapter_config.json").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="adapter_config"):
        read_lora(tmp_path, CONFIG.dit)


def test_alpha_none_in_the_header_is_the_rank(tmp_path):
    file = save(tmp_path / "x.safetensors", pair(), {"ss_network_alpha": "None"})
    np.testing.assert_allclose(summand(read_lora(file, CONFIG.dit)), product(pair()), rtol=1e-4)


def test_layers_of_a_text_encoder_are_skipped_with_a_message(tmp_path, capsys):
    both = pair() | pair(name="lora_te_text_model_encoder_layers_0_mlp_fc1")
    changes = read_lora(save(tmp_path / "x.safetensors", both), CONFIG.dit)
    assert changes.keys() == {LAYER}
    assert "skipped 2 tensors of a text encoder" in capsys.readouterr().err


def test_whole_deltas_are_merged_applied_and_written_alike(tmp_path):
    torch.manual_seed(0)
    base = "diffusion_model.blocks.1"
    tensors = pair() | {
        f"{NAME}.diff_b": torch.randn(DIM),
        f"{base}.cross_attn.norm_k.diff": torch.randn(DIM),
        f"{base}.self_attn.q.diff": torch.randn(DIM, DIM),
        f"{base}.diff_m": torch.randn(1, 6, DIM),
        "diffusion_model.head.head.diff_b": torch.randn(*arrays("dit")["head.linear.bias"].shape),
    }
    file = save(tmp_path / "x.safetensors", tensors)
    folder = ours(tmp_path / "base", "dit")
    args = ["lora", str(file), "--config", "debug"]
    merge = ["--merge", str(folder), "--scale", "0.5", "--out", str(tmp_path / "out")]
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
    network = nnx.eval_shape(lambda: WanDiT(CONFIG.dit, rngs=nnx.Rngs(0)))
    weights.load(folder / "dit.safetensors", network)
    lora.apply(network, read_lora(file, CONFIG.dit), scale=0.5)
    np.testing.assert_allclose(network.head.linear.bias[...], have["head.linear.bias"], atol=1e-6)
    assert main([*args, "--out", str(tmp_path / "again" / "x.safetensors")]) == 0
    again = read_lora(tmp_path / "again" / "x.safetensors", CONFIG.dit)
    first = read_lora(file, CONFIG.dit)
    assert again.keys() == first.keys()
    np.testing.assert_array_equal(again["blocks.modulation"], first["blocks.modulation"])
