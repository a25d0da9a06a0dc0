"""From clips to latents to a fine-tuned model, whole and as a LoRA, by the commands alone."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from egosim_jax import configs
from egosim_jax.cli.__main__ import main as egosim
from egosim_jax.configs.model import Networks
from egosim_jax.convert.__main__ import main as egosim_convert
from egosim_jax.io.mapped import read_metadata, read_safetensors
from egosim_jax.train.__main__ import main as egosim_train
from egosim_jax.train.distributed import free_local_address

DEBUG = configs.get("debug")
HABITS = "--training.steps 4 --training.batch-size 2 --training.log-every 1 --training.save-every 2"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of `debug`, and latents of clips to train on and to validate on."""
    folder = tmp_path_factory.mktemp("tuning")
    networks = Networks.random(DEBUG, seed=0)
    # Behind a head of zeros, as training from nothing begins, a LoRA's gradients would be zero.
    head = networks.dit.head.linear.kernel
    head[...] = 0.1 * jax.random.normal(jax.random.key(1), head[...].shape)
    networks.save(folder / "weights")
    for split, seed, scenes in (("train", 0, 3), ("test", 3, 2)):
        make = f"data make tabletop --scenes {scenes} --seed {seed} --frames 9 --height 64 "
        make += f"--width 96 --fps 16 --workers 1 --out {folder / split}"
        assert egosim(make.split()) == 0
        encode = f"data encode --config debug --weights {folder / 'weights'} --shards "
        encode += f"{folder / split} --out {folder / 'latents' / split} --stride 1"
        assert egosim(encode.split()) == 0
    return folder


def tune(folder: Path, recipe: str, out: str, *more: str) -> int:
    command = f"{recipe} --config debug --weights {folder / 'weights'} --latents "
    command += f"{folder / 'latents' / 'train'} --out {folder / out} {HABITS}"
    return egosim_train([*command.split(), *more])


def losses(run: Path) -> list[float]:
    lines = map(json.loads, (run / "metrics.jsonl").read_text("utf-8").splitlines())
    return [line["loss"] for line in lines if "loss" in line]


def test_all_weights_are_tuned_and_generate_a_clip(folder, capsys):
    validation = ["--validation", str(folder / "latents" / "test"), "--samples", "1"]
    assert tune(folder, "egosim_14b_fewshot", "full", *validation) == 0
    run = folder / "full"
    assert len(losses(run)) == 4
    assert np.isfinite(losses(run)).all()
    sheet = run / "samples" / "step_000004.png"
    assert sheet.stat().st_size > 1000
    assert sheet.with_suffix(".mp4").exists()
    before, after = (
        read_safetensors(path / "dit.safetensors")["head.linear.kernel"].array()
        for path in (folder / "weights", run / "weights")
    )
    assert np.abs(after - before).max() > 0
    assert (run / "weights" / "vae.safetensors").samefile(folder / "weights" / "vae.safetensors")
    command = f"generate --config debug --weights {run / 'weights'} --out {folder / 'clip'}"
    assert egosim(command.split()) == 0

    # It resumes, here at its end, with other arithmetic, but not with another objective.
    assert tune(folder, "egosim_14b_fewshot", "full", "--dtype", "bfloat16") == 0
    assert len(losses(run)) == 4
    written = read_safetensors(run / "weights" / "dit.safetensors")["head.linear.kernel"]
    assert written.dtype == "bfloat16"
    np.testing.assert_allclose(written.array().astype(np.float32), after, rtol=2**-8)
    assert tune(folder, "egosim_14b_fewshot", "full", "--times", "uniform") == 2
    assert "--times: the folder has 'diffsynth', this run has 'uniform'" in capsys.readouterr().err


def test_a_lora_is_tuned_shown_exported_and_merged(folder, capsys):
    more = ("--rank", "2", "--training.grad-accum-steps", "2")
    assert tune(folder, "egosim_14b_lora", "lora", *more) == 0
    lora = folder / "lora" / "lora.safetensors"
    assert capsys.readouterr().out.splitlines()[-1] == str(lora)
    assert tune(folder, "egosim_14b_lora", "further", *more, "--lora", str(lora)) == 0
    further = losses(folder / "further")
    assert len(further) == 4
    assert further[0] != losses(folder / "lora")[0]
    export = f"lora {lora} --config debug --out {folder / 'comfy.safetensors'}"
    assert egosim_convert(export.split()) == 0
    assert all(
        name.startswith("diffusion_model.")
        for name in read_safetensors(folder / "comfy.safetensors")
    )
    bases = [read_metadata(path)["base_sha256"] for path in (lora, folder / "comfy.safetensors")]
    assert bases[0] == bases[1]

    both = [lora, folder / "comfy.safetensors"]
    for number, path in enumerate(both):
        merge = f"lora {path} --config debug --merge {folder / 'weights'} "
        merge += f"--out {folder / f'merged{number}'}"
        assert egosim_convert(merge.split()) == 0
    ours, theirs = (read_safetensors(folder / f"merged{n}" / "dit.safetensors") for n in range(2))
    assert all(np.array_equal(ours[name].array(), theirs[name].array()) for name in ours)
    name = "blocks.self_attn.q.kernel"
    base = read_safetensors(folder / "weights" / "dit.safetensors")[name].array()
    change = ours[name].array() - base
    assert np.abs(change).max() > 0
    assert np.linalg.matrix_rank(change[0], tol=1e-6) == 2
    Networks.load(DEBUG, folder / "merged0")


def test_two_processes_tune_together_and_draw_what_they_share(folder):
    """As the page on training shows it, each a separate program."""
    address = free_local_address()
    out, latents = folder / "two", folder / "latents"
    command = f"egosim_14b_fewshot --config debug --weights {folder / 'weights'} --out {out} "
    command += f"--latents {latents / 'train'} --validation {latents / 'test'} --samples 1 {HABITS}"
    started = [
        subprocess.Popen(
            [sys.executable, "-m", "egosim_jax.train", *command.split()],
            env=os.environ
            | {"JAX_COORDINATOR_ADDRESS": address, "JAX_NUM_PROCESSES": "2"}
            | {"JAX_PROCESS_ID": str(index)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for index in range(2)
    ]
    said = [process.communicate(timeout=600)[1] for process in started]
    assert [process.returncode for process in started] == [0, 0], said
    assert "time spent" in said[0]
    assert "time spent" not in said[1]
    assert len(losses(out)) == 4
    assert (out / "samples" / "step_000004.png").stat().st_size > 1000
    Networks.load(DEBUG, out / "weights")
