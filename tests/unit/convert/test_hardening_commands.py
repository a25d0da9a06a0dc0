"""Inputs that `egosim-convert` refuses, and the outputs that other projects load."""

import errno
import json
import math
import os
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from diffusers import AutoencoderKLWan, DiffusionPipeline, WanTransformer3DModel
from flax import nnx
from safetensors.numpy import load_file
from safetensors.torch import save_file
from transformers import CLIPVisionModel, UMT5EncoderModel

from egosim_jax import configs
from egosim_jax.convert import stream
from egosim_jax.convert.__main__ import main
from egosim_jax.convert.lora import read_lora
from egosim_jax.convert.tables import weight_shapes
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_metadata
from egosim_jax.models import lora
from egosim_jax.models.wan.dit import WanDiT
from egosim_jax.types import InputError

CONFIG = configs.get("debug")
DIM = CONFIG.dit.dim
NAME = "diffusion_model.blocks.0.self_attn.q"
LAYER = "blocks.self_attn.q"


def one_line(capsys, code, *args):
    assert main([str(arg) for arg in args]) == code
    said = capsys.readouterr().err.strip().splitlines()
    errors = [line for line in said if line.startswith("error: ")]
    assert len(errors) == 1
    assert "Traceback" not in "".join(said)
    return errors[0]


@cache
def arrays(network):
    rng = np.random.default_rng(0)
    found = weight_shapes(CONFIG.networks[network])
    return {path: 0.2 * rng.normal(size=s).astype(np.float32) for path, s in found.items()}


def ours(folder, *networks):
    for network in networks:
        weights.write(
            folder / f"{network}.safetensors", arrays(network), metadata={"config": "debug"}
        )
    return folder


def theirs(tmp_path, network="text"):
    """A checkpoint of one network in its folder."""
    ours(tmp_path / "made", network)
    args = ["to-torch", tmp_path / "made", "--config", "debug", "--only", network]
    assert main([str(a) for a in [*args, "--out", tmp_path / "theirs"]]) == 0
    return tmp_path / "theirs"


# The tokenizer.


@pytest.fixture
def tokenized(tmp_path, monkeypatch):
    """A checkpoint with a tokenizer, for a model that takes one."""
    source = theirs(tmp_path)
    (folder := source / "google" / "umt5").mkdir(parents=True)
    (folder / "tokenizer.json").write_text("{}", encoding="utf-8")
    (folder / "surprise.py").write_text("", encoding="utf-8")
    taken = replace(CONFIG, tokenizer=replace(CONFIG.tokenizer, kind=Path("umt5-xxl")))
    monkeypatch.setattr(configs, "get", lambda name: taken)
    return source, folder


def convert(source, out):
    return ["weights", source, "--config", "debug", "--out", out]


def test_a_tokenizer_is_copied_without_what_is_not_of_it(tokenized, tmp_path):
    source, folder = tokenized
    (folder / "loop").symlink_to(".")
    (folder / "dangling").symlink_to("nowhere")
    assert main([str(arg) for arg in convert(source, tmp_path / "out")]) == 0
    files = {str(p.relative_to(tmp_path / "out")) for p in (tmp_path / "out").rglob("[!.]*")}
    assert files == {"text.safetensors", "umt5-xxl", "umt5-xxl/tokenizer.json"}


@pytest.mark.parametrize("to", ["/etc/passwd", "nowhere", "tokenizer_config.json"])
def test_a_link_in_a_tokenizer_is_refused_before_anything_is_written(
    tokenized, tmp_path, capsys, to
):
    source, folder = tokenized
    (folder / "tokenizer_config.json").symlink_to(to)
    assert "is a symlink" in one_line(capsys, 2, *convert(source, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_linked_tokenizer_folder_is_refused(tokenized, tmp_path, capsys):
    source, folder = tokenized
    folder.rename(tmp_path / "elsewhere")
    folder.symlink_to(tmp_path / "elsewhere")
    assert "is a symlink" in one_line(capsys, 2, *convert(source, tmp_path / "out"))


def test_a_huge_tokenizer_is_refused(tokenized, tmp_path, capsys):
    source, folder = tokenized
    os.truncate(folder / "tokenizer.json", 1 << 32)
    assert "more than 67,108,864 bytes" in one_line(capsys, 2, *convert(source, tmp_path / "out"))


def test_what_is_written_is_apart_from_what_is_read(tmp_path, capsys):
    source = theirs(tmp_path)
    base = ours(tmp_path / "base", "dit")
    file = save(tmp_path / "lora.safetensors", pair())
    (tmp_path / "link").symlink_to(base)
    args = ["lora", file, "--config", "debug", "--merge", base, "--out"]
    for command in (
        convert(source, source / "google" / "out"),
        [*args, base], [*args, base / "inner"], [*args, tmp_path / "link"],
        ["lora", file, "--config", "debug", "--out", file],
        ["to-torch", base, "--config", "debug", "--out", base],
    ):  # fmt: skip
        assert "choose a separate output path" in one_line(capsys, 2, *command)
    assert [path.name for path in base.iterdir()] == ["dit.safetensors"]


# LoRAs.


def pair(rank=2, dim=DIM, name=NAME):
    torch.manual_seed(0)
    return {
        f"{name}.lora_A.weight": torch.randn(rank, dim),
        f"{name}.lora_B.weight": torch.randn(dim, rank),
    }


def save(path, tensors, about=None):
    save_file(tensors, path, about)
    return path


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


# What is written for others.


def test_diffusers_and_transformers_load_what_is_written_for_them(tmp_path, monkeypatch):
    # What diffusers keeps in float32 it loads by accelerate alone; here everything is float32.
    monkeypatch.setattr(WanTransformer3DModel, "_keep_in_fp32_modules", None)
    folder = ours(tmp_path / "ours", "dit", "vae", "text", "image")
    out = tmp_path / "out"
    args = ["to-torch", str(folder), "--config", "debug", "--layout", "diffusers"]
    assert main([*args, "--out", str(out)]) == 0
    for kind, part in (
        (WanTransformer3DModel, "transformer"), (AutoencoderKLWan, "vae"),
        (UMT5EncoderModel, "text_encoder"), (CLIPVisionModel, "image_encoder"),
    ):  # fmt: skip
        state = kind.from_pretrained(out / part).state_dict()
        (file,) = (out / part).glob("*.safetensors")
        for name, expected in load_file(file).items():
            found = state[name if name in state else f"vision_model.{name}"]
            np.testing.assert_array_equal(found.numpy(), expected)
    pipeline = DiffusionPipeline.from_pretrained(out, tokenizer=None)
    assert pipeline.vae.config.z_dim == CONFIG.vae.z_dim
    assert pipeline.scheduler.config.shift == CONFIG.process.shift


# What the system refuses.


def commands(tmp_path):
    source, base = theirs(tmp_path), ours(tmp_path / "base", "text", "dit")
    file = save(tmp_path / "x.safetensors", pair())
    return {
        "weights": ["weights", source, "--config", "debug"],
        "lora": ["lora", file, "--config", "debug"],
        "merge": ["lora", file, "--config", "debug", "--merge", base],
        "to-torch": ["to-torch", base, "--config", "debug", "--only", "text"],
    }


COMMANDS = ("weights", "lora", "merge", "to-torch")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk_is_one_line(tmp_path, capsys, monkeypatch, name):
    args = commands(tmp_path)[name]

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(stream.os, "pwrite", full)
        out = tmp_path / "out" / "x.safetensors"
        assert "No space left" in one_line(capsys, 1, *args, "--out", out)
    assert not [path for path in tmp_path.glob("out/**/*.safetensors") if path.is_file()]
    assert main([str(arg) for arg in [*args, "--out", out]]) == 0


@pytest.mark.parametrize("name", COMMANDS)
def test_a_folder_that_cannot_be_written_to_is_one_line(tmp_path, capsys, name):
    (tmp_path / "file").write_text("", encoding="utf-8")
    args = commands(tmp_path)[name]
    assert "file" in one_line(capsys, 1, *args, "--out", tmp_path / "file" / "out" / "x")
    assert "/proc" in one_line(capsys, 1, *args, "--out", "/proc/none/x")


@pytest.mark.parametrize("name", COMMANDS)
def test_a_second_process_is_one_line(tmp_path, capsys, name):
    args, out = commands(tmp_path)[name], tmp_path / "out"
    held = out if name != "lora" else tmp_path
    code = (
        "import sys, pathlib; from egosim_jax.io.atomic import hold_folder;"
        "hold_folder(pathlib.Path(sys.argv[1])); print(flush=True); input()"
    )
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", code, str(held)], stdin=pipe, stdout=pipe
    ) as other:
        other.stdout.readline()
        assert "another process" in one_line(capsys, 2, *args, "--out", out)
        other.communicate(b"\n")


def test_a_missing_file_is_one_line(tmp_path, capsys):
    none, rest = tmp_path / "none", ["--config", "debug"]
    there = ours(tmp_path / "there", "dit")
    file = save(tmp_path / "x.safetensors", pair())
    for args in (
        ["inspect", none], ["weights", none, *rest, "--out", tmp_path / "out"],
        ["lora", none, *rest, "--out", tmp_path / "out"],
        ["lora", file, *rest, "--merge", none, "--out", tmp_path / "out"],
        ["to-torch", none, *rest, "--out", tmp_path / "out"],
        ["to-torch", there, *rest, "--out", tmp_path / "out"],
        ["verify", none, there, *rest], ["verify", theirs(tmp_path), none, *rest],
    ):  # fmt: skip
        one_line(capsys, 2, *args)
    assert not (tmp_path / "out").exists()


def test_names_are_not_markup(tmp_path, capsys):
    name = "[/b].visual.cls_embedding"
    save_file({name: torch.rand(1)}, tmp_path / "x.safetensors")
    assert main(["inspect", str(tmp_path), "--tensors"]) == 0
    assert "[/b]." in capsys.readouterr().out


def test_a_damaged_file_of_ours_is_refused_when_it_is_used(tmp_path, capsys):
    base = ours(tmp_path / "base", "text")
    file = base / "text.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    args = ["to-torch", base, "--config", "debug", "--only", "text", "--out", tmp_path / "out"]
    assert "is damaged" in one_line(capsys, 2, *args)
    assert not list((tmp_path / "out").glob("[!.]*"))
    from egosim_jax.models.wan.umt5 import UMT5

    network = nnx.eval_shape(lambda: UMT5(CONFIG.text, rngs=nnx.Rngs(0)))
    with pytest.raises(InputError, match="is damaged"):
        weights.load(file, network)


def test_what_is_converted_has_checksums_and_no_more_metadata_for_others(tmp_path):
    source = theirs(tmp_path)
    assert main([str(arg) for arg in convert(source, tmp_path / "out")]) == 0
    about = read_metadata(tmp_path / "out" / "text.safetensors")
    assert {"sha256", "checksums", "seal"} <= about.keys()
    (file,) = source.glob("*.safetensors")
    assert read_metadata(file) == {"format": "pt"}
