"""Inputs that `egosim-convert` refuses, and the outputs that other projects load."""

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
from egosim_jax.convert.__main__ import main
from egosim_jax.io import weights
from egosim_jax.io.mapped import read_metadata
from egosim_jax.types import InputError
from tests.unit.convert.made import CONFIG, one_line, ours, pair, save, theirs


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


def link_folder(folder):
    folder.symlink_to(folder.rename(folder.parents[2] / "elsewhere"))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda folder: (folder / "tokenizer_config.json").symlink_to("/etc/passwd"), "a symlink"),
        (lambda folder: (folder / "tokenizer_config.json").symlink_to("nowhere"), "a symlink"),
        (link_folder, "a symlink"),
        (lambda folder: os.truncate(folder / "tokenizer.json", 1 << 32), "more than 67,108,864"),
    ],
)
def test_a_tokenizer_of_links_or_large_files_is_refused_before_anything_is_written(
    tokenized, tmp_path, capsys, change, reason
):
    source, folder = tokenized
    change(folder)
    assert reason in one_line(capsys, 2, *convert(source, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


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


@pytest.mark.parametrize("name", ["lora", "to-torch"])
def test_a_second_process_is_one_line(tmp_path, capsys, name):
    source = save(tmp_path / "x.safetensors", pair())
    if name == "to-torch":
        source = ours(tmp_path / "base", *CONFIG.networks)
    code = (
        "import sys, pathlib; from egosim_jax.io.atomic import hold_folder;"
        "hold_folder(pathlib.Path(sys.argv[1])); print(flush=True); input()"
    )
    held, pipe = tmp_path / "held", subprocess.PIPE
    out = held / "out" if name == "lora" else held
    with subprocess.Popen([sys.executable, "-c", code, held], stdin=pipe, stdout=pipe) as other:
        other.stdout.readline()
        args = [name, source, "--config", "debug", "--out", out]
        assert "another process" in one_line(capsys, 2, *args)
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
