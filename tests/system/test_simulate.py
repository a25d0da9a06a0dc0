"""The closed loop by its commands: simulate, look, and compare with a world that forgets."""

import contextlib
import json
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from egosim_jax.cli.__main__ import main
from egosim_jax.experiments import update
from egosim_jax.io.video import probe_video
from egosim_jax.state.snapshot import load, read_ply
from egosim_jax.types import VideoSpec


def simulate(weights: Path, out: Path, *more: str) -> int:
    fixed = ["--config", "debug", "--weights", str(weights), "--out", str(out), "--clips", "2"]
    perception = [] if "--update" in more else ["--perception", "oracle"]
    return main(["simulate", *fixed, *perception, *more])


@pytest.fixture(scope="module")
def simulated(weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "demo"
    assert simulate(weights, out) == 0
    return out


def test_each_clip_has_videos_numbers_and_a_state(simulated):
    report = json.loads((simulated / "report.json").read_text("utf-8"))
    assert [line["clip"] for line in report["clips"]] == [1, 2]
    for line in report["clips"]:
        assert {"psnr", "ssim", "region_psnr", "depth_error", "camera_error"} <= line.keys()
    for number in (1, 2):
        assert probe_video(simulated / f"clip_{number}.mp4").frames == 9
        assert probe_video(simulated / f"clip_{number}_cmp.mp4").width == 4 * 96
    for number in range(3):
        assert (simulated / f"state_{number}.ply").exists()
        assert (simulated / f"state_{number}.png").exists()
    assert (simulated / "contact_sheet.png").exists()


def test_the_world_has_changed_from_clip_to_clip(simulated):
    states = [read_ply(simulated / f"state_{number}.ply") for number in range(3)]
    moved = [not np.array_equal(a.points_m, b.points_m) for a, b in pairwise(states)]
    assert all(moved)


def test_the_recording_has_the_scene_the_hands_and_the_images(simulated):
    command = [sys.executable, "-m", "rerun", "rrd", "print", "-v"]
    printed = subprocess.run(
        [*command, str(simulated / "simulation.rrd")], capture_output=True, text=True, check=True
    ).stdout
    for entity in ("/world/state", "/world/hands/0", "/world/camera", "/view", "/ground_truth"):
        assert entity in printed


def test_the_same_command_again_makes_nothing_new(simulated, weights):
    journal = (simulated / "journal.jsonl").read_bytes()
    report = (simulated / "report.json").read_bytes()
    assert simulate(weights, simulated) == 0
    assert (simulated / "journal.jsonl").read_bytes() == journal
    assert (simulated / "report.json").read_bytes() == report


def test_a_folder_of_another_run_is_refused(simulated, weights, capsys):
    for option, named in (
        ("--seed", "seed"),
        ("--steps", "--steps: the folder has 4, this run has 7"),
    ):
        assert simulate(weights, simulated, option, "7") == 2
        assert named in capsys.readouterr().err


@pytest.mark.parametrize(
    ("bad", "message"),
    [("clasical", "Did you mean 'classical'"), ("classical --hands.discs 0", "discs must be")],
)
def test_a_perception_that_cannot_be_is_refused_before_the_folder_is_made(
    weights, tmp_path, capsys, bad, message
):
    with contextlib.suppress(SystemExit):
        assert simulate(weights, tmp_path / "run", "--perception", bad) == 2
    assert message in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "run").exists()


def test_a_state_and_a_point_cloud_are_drawn_from_three_sides(simulated, tmp_path, capsys):
    for number, path in enumerate((simulated / "clip_1" / "state", simulated / "state_1.ply")):
        out = tmp_path / f"{number}.png"
        assert main(["view", str(path), "--out", str(out), "--up", "z"]) == 0
        with Image.open(out) as image:
            assert image.size == (3 * 640, 480)
    count = len(load(simulated / "clip_1" / "state").points_m)
    assert f"{count} points" in capsys.readouterr().out
    assert (tmp_path / "0.png").read_bytes() == (tmp_path / "1.png").read_bytes()


def test_the_experiment_compares_worlds_that_remember_with_one_that_does_not(
    weights, tmp_path, capsys
):
    out = tmp_path / "out"
    fixed = ["--config", "debug", "--weights", str(weights), "--out", str(out)]
    command = ["experiment", "continuous", *fixed, "--sequences", "1", "--clips", "2"]
    assert main(command) == 0
    report = json.loads((out / "report.json").read_text("utf-8"))
    tables = report["tables"]
    assert tables.keys() == {"update, oracle", "update, classical", "no update"}
    second, differences = tables["no update"][1]["psnr"]["mean"], report["differences"]
    for method in ("update, oracle", "update, classical"):
        gain = tables[method][1]["psnr"]["mean"] - second
        assert differences[method][1]["psnr"]["mean"] == pytest.approx(gain)
        assert differences[method][0]["psnr"]["mean"] == 0
    first = [table[0]["psnr"]["mean"] for table in tables.values()]
    assert first[0] == first[1] == first[2]  # before the first clip there is nothing to remember
    assert tables["update, oracle"][1]["prior_psnr"] != tables["no update"][1]["prior_psnr"]
    assert (out / "curves.png").exists()
    assert "no update" in capsys.readouterr().out
    kept = (out / "report.json").read_bytes()
    (out / "no_update" / "600" / "scores.json").unlink()
    assert main(command) == 0
    assert (out / "report.json").read_bytes() == kept


def test_the_state_after_an_object_was_carried_is_compared_with_the_ground_truth(
    weights, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(update, "LARGE", VideoSpec(frames=9, height=96, width=160))
    out = tmp_path / "out"
    fixed = ["--config", "debug", "--weights", str(weights), "--out", str(out)]
    assert main(["experiment", "update", *fixed, "--scenes", "1"]) == 0
    table = json.loads((out / "report.json").read_text("utf-8"))["table"]
    assert table.keys() == {
        "oracle, 160 x 96",
        "oracle, 96 x 64",
        "classical, ground-truth frames",
        "classical, generated frames",
        "classical, gray frames",
    }
    scores = {name: value["mean"] for name, value in table["oracle, 160 x 96"].items()}
    assert scores["accuracy"] >= 95
    assert scores["completeness"] >= 80
    assert scores["ghost"] < 2
    assert table["classical, gray frames"]["ghost"]["mean"] < 2  # the grip decides
    assert "ghost points" in capsys.readouterr().out
