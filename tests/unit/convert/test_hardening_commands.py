"""Inputs that `egosim-convert` refuses, and the outputs that other projects load."""

import errno
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from diffusers import AutoencoderKLWan, DiffusionPipeline, WanTransformer3DModel
from flax import nnx
from safetensors.numpy import load_file
from transformers import CLIPVisionModel, UMT5EncoderModel

from egosim_jax import configs
from egosim_jax.convert import writer
from egosim_jax.convert.__main__ import main
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_metadata
from egosim_jax.types import InputError
from tests.unit.convert.made import (
    CONFIG,
    one_line,
    ours,
    pair,
    save,
    theirs,
)


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
    return ["weights", source, "--config", "debug", "--only", "text", "--out", out]


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
        "weights": ["weights", source, "--config", "debug", "--only", "text"],
        "lora": ["lora", file, "--config", "debug"],
        "merge": ["lora", file, "--config", "debug", "--merge", base],
        "to-torch": ["to-torch", base, "--config", "debug", "--only", "text"],
    }


@pytest.mark.parametrize("name", ["weights", "merge"])
def test_a_full_disk_is_one_line(tmp_path, capsys, monkeypatch, name):
    args = commands(tmp_path)[name]

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(writer.os, "fsync", full)
        out = tmp_path / "out" / "x.safetensors"
        assert "No space left" in one_line(capsys, 1, *args, "--out", out)
    assert not [path for path in tmp_path.glob("out/**/*.safetensors") if path.is_file()]
    assert main([str(arg) for arg in [*args, "--out", out]]) == 0


@pytest.mark.parametrize("name", ["lora", "to-torch"])
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


def test_a_damaged_file_of_ours_is_refused_when_it_is_used(tmp_path, capsys):
    base = ours(tmp_path / "base", "text")
    file = base / "text.safetensors"
    data = bytearray(file.read_bytes())
    data[-1] ^= 1
    file.write_bytes(data)
    args = ["to-torch", base, "--config", "debug", "--only", "text", "--out", tmp_path / "out"]
    assert "is damaged" in one_line(capsys, 2, *args)
    assert not list((tmp_path / "out").glob("[!.]*"))

    network = nnx.eval_shape(lambda: CONFIG.text.build(rngs=nnx.Rngs(0)))
    with pytest.raises(InputError, match="is damaged"):
        weights.load(file, network)


def test_what_is_converted_has_checksums_and_no_more_metadata_for_others(tmp_path):
    source = theirs(tmp_path)
    assert main([str(arg) for arg in convert(source, tmp_path / "out")]) == 0
    about = read_metadata(tmp_path / "out" / "text.safetensors")
    assert {"sha256", "checksums", "plan"} <= about.keys()
    (file,) = source.glob("*.safetensors")
    assert read_metadata(file) == {"format": "pt"}
