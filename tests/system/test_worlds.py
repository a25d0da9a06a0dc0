"""The experiments on the true tabletop world, in their smallest size; a rerun computes nothing."""

import json
from dataclasses import replace

import pytest

from egosim_jax import configs
from egosim_jax.cli.__main__ import main
from egosim_jax.io.video import probe_video
from egosim_jax.io.weights import STUDENT
from egosim_jax.worlds.tabletop.policies import POLICIES


def test_looking_away_reports_each_case_and_method_and_resumes(weights, tmp_path, capsys):
    out = tmp_path / "out"
    fixed = ["--config", "debug", "--weights", str(weights), "--out", str(out)]
    command = ["experiment", "look_away", *fixed, "--scenes", "1"]
    assert main(command) == 0
    report = json.loads((out / "report.json").read_text("utf-8"))
    methods = {"update, oracle", "update, classical", "no update", "ground truth, classical"}
    assert report["table"].keys() == {f"{c}: {m}" for c in ("seen", "unseen") for m in methods}
    assert report["table"]["seen: update, oracle"]["state_accuracy"]["mean"] > 80
    assert report["table"]["seen: no update"]["state_accuracy"]["mean"] < 20
    assert report["table"]["unseen: update, oracle"]["state_accuracy"]["mean"] > 80
    assert report["table"]["unseen: no update"]["state_accuracy"]["mean"] < 20
    assert (out / "contact_sheet.png").exists()
    assert "after looking back" in capsys.readouterr().out
    assert report["table"]["seen: update, oracle"]["kept"].keys() == {"mean", "low", "high"}
    videos = json.loads((out / "wrbench" / "videos.json").read_text("utf-8"))
    assert len(videos) == 2 * 4
    clip = configs.get("debug").video.frames
    assert {probe_video(out / "wrbench" / v["path"]).frames for v in videos} == {3 * clip - 2}
    assert {v["model"] for v in videos} == methods
    kept = (out / "report.json").read_bytes()
    clips = {path: path.stat().st_mtime_ns for path in out.glob("*/*/*/clip_*/frames.npz")}
    assert len(clips) == 2 * 3 * 3
    assert main(command) == 0
    assert (out / "report.json").read_bytes() == kept
    assert all(path.stat().st_mtime_ns == made for path, made in clips.items())


def test_policies_are_ranked_and_the_ranking_resumes(weights, tmp_path, capsys):
    out = tmp_path / "out"
    fixed = ["--config", "debug", "--weights", str(weights), "--out", str(out)]
    command = ["experiment", "policies", *fixed, "--scenes", "1"]
    assert main(command) == 0
    report = json.loads((out / "report.json").read_text("utf-8"))
    assert list(report["table"]) == [policy.name for policy in POLICIES]
    assert report["table"]["exact"]["true"]["mean"] == 100
    assert report["table"]["never closes"]["true"]["mean"] == 0
    assert report["agreement"].keys() == {"seen", "frames", "state"}
    assert (out / "ranking.png").exists()
    assert (out / "contact_sheet.png").exists()
    assert "MMRV" in capsys.readouterr().out
    kept = (out / "report.json").read_bytes()
    next((out / "scenes").glob("*.json")).unlink()
    assert main(command) == 0
    assert (out / "report.json").read_bytes() == kept


@pytest.mark.usefixtures("without_lpips")
def test_a_student_is_compared_with_its_teacher_and_the_loop_resumes(tmp_path, capsys, monkeypatch):
    """A stage whose file is the student's own is the student. Small images are generated sooner."""
    shipped = configs.get

    def small(name):
        config = shipped(name)
        return replace(config, video=replace(config.video, height=48, width=80))

    monkeypatch.setattr(configs, "get", small)
    out, file = tmp_path / "out", configs.weights_of("tabletop_student", None) / STUDENT
    command = ["experiment", "students", "--out", str(out), "--stages", f"own={file}"]
    command += ["--scenes", "2", "--batch-size", "2", "--teacher-steps", "2"]
    command += ["--sequences", "1", "--clips", "1"]
    assert main(command) == 0
    report = json.loads((out / "report.json").read_text("utf-8"))
    rows = ["teacher, 2 steps", "teacher's weights, chunk by chunk"]
    rows += [f"{rows[1]}, refreshed", "own", "own, refreshed", "student, steps: 1", "student"]
    assert list(report["table"]) == rows
    assert report["table"]["own"] == report["table"]["student"]
    assert report["table"]["own"] != report["table"]["own, refreshed"]
    assert report["differences"]["own"]["psnr"]["mean"] == 0
    assert report["loop"]["tables"]["teacher"] != report["loop"]["tables"]["student"]
    assert (out / "contact_sheet.png").exists()
    assert "the student's differences" in capsys.readouterr().out
    kept = {path: path.stat().st_mtime_ns for path in out.glob("loop/*/*/scores.json")}
    assert len(kept) == 2
    assert main(command) == 0
    assert json.loads((out / "report.json").read_text("utf-8")) == report
    assert all(path.stat().st_mtime_ns == made for path, made in kept.items())
