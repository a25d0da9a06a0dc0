"""From clips to trained weights to a generated clip, by the commands alone."""

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from egosim_jax.cli.__main__ import main as egosim
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.weights import hashes
from egosim_jax.train.__main__ import main as egosim_train

STEPS = ["--vae.steps", "2", "--denoiser.steps", "2"]


@pytest.fixture(scope="module")
def run(without_lpips: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("train") / "run"
    assert egosim(["experiment", "debug", "--out", str(out), "--steps", "2"]) == 0
    return out


def test_a_recipe_writes_weights_of_every_network(run):
    assert sorted(path.name for path in (run / "weights").iterdir()) == [
        "dit.safetensors",
        "image.safetensors",
        "text.safetensors",
        "vae.safetensors",
    ]


def test_an_experiment_reports_each_method_with_and_without_the_right_conditions(run):
    report = json.loads((run / "report.json").read_text("utf-8"))
    for name in ("generated", "swapped"):
        assert set(report[name]["splits"]) == {"train", "test"}
        for split in report[name]["splits"].values():
            assert all(0 < method["psnr"]["mean"] < 60 for method in split.values())
    methods = set(report["generated"]["splits"]["test"])
    assert {"generated", "prior", "prior_fit", "still", "vae"} <= methods


def test_an_experiment_gives_each_clip_the_conditions_of_another(run):
    lines = [json.loads(line) for line in (run / "swapped.jsonl").read_text("utf-8").splitlines()]
    assert len(lines) == 8
    for line in lines:
        assert line["video_id"] in line["first_frame"]
        assert line["video_id"] not in line["ego_prior_video"]
        assert Path(line["ego_prior_video"]).parent == Path(line["hand_keypoint_video"]).parent


def test_the_recipe_finds_everything_done(run):
    before = (run / "weights" / "dit.safetensors").read_bytes()
    assert egosim_train(["debug", "--out", str(run), *STEPS]) == 0
    assert (run / "weights" / "dit.safetensors").read_bytes() == before


def test_a_recipe_starts_from_weights(run, tmp_path, capsys):
    weights, out = run / "weights", tmp_path / "on"
    few = ["--clips", "4", "--clip-frames", "9"]
    assert egosim_train(["debug", "--weights", str(weights), "--out", str(out), *few, *STEPS]) == 0
    digest = hashes(weights)["dit"]
    assert f"denoiser: from dit sha256 {digest[:16]}" in capsys.readouterr().err
    first, on = (load_file(folder / "weights" / "vae.safetensors") for folder in (run, out))
    assert all(np.array_equal(first[name], on[name]) for name in first)
    trained = load_file(out / "weights" / "dit.safetensors")["patch.kernel"]
    given = load_file(weights / "dit.safetensors")["patch.kernel"]
    assert 0 < np.abs(trained - given).max() < 0.1 * np.abs(given).max()


def test_encode_makes_the_latents_of_the_recipe_again(run, tmp_path):
    options = {
        "config": "debug",
        "weights": run / "weights",
        "shards": run / "frames" / "test",
        "out": tmp_path / "latents",
        "stride": 16,
        "batch-size": 8,
    }
    flags = [str(x) for name, value in options.items() for x in (f"--{name}", value)]
    assert egosim(["data", "encode", *flags]) == 0
    again, recipe = ShardReader(tmp_path / "latents"), ShardReader(run / "latents" / "test")
    assert len(again) == len(recipe)
    for ours, theirs in zip(again, recipe, strict=True):
        assert all((ours.arrays[name] == theirs.arrays[name]).all() for name in theirs.arrays)


def test_trained_weights_generate(run, tmp_path):
    options = {
        "config": "debug",
        "weights": run / "weights",
        "metadata": run / "clips" / "metadata.csv",
        "where": "split=test",
        "out": tmp_path / "out",
    }
    flags = [str(x) for name, value in options.items() for x in (f"--{name}", value)]
    assert egosim(["generate", *flags]) == 0
    assert (tmp_path / "out" / "tabletop_human_3_0.mp4").is_file()


def test_the_tabletop_recipe_makes_its_own_clips_and_half_wide_weights(tmp_path):
    out = tmp_path / "run"
    tiny = ["--config", "debug", "--scenes", "2", "--held-out", "2", *STEPS]
    batches = ["--vae.batch-size", "2", "--denoiser.batch-size", "2"]
    assert egosim_train(["tabletop", "--out", str(out), *tiny, *batches]) == 0
    assert len(ShardReader(out / "frames" / "train")) == 4
    for path in (out / "weights").iterdir():
        assert {tensor.dtype for tensor in load_file(path).values()} == {np.dtype("float16")}
