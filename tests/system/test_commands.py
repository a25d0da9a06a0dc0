"""The commands, from clips to a table, as a user runs them."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from PIL import Image

from egosim_jax.cli.__main__ import main
from egosim_jax.data.clips import write_clips
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, to_triplet

SPEC = VideoSpec(frames=9, height=64, width=96)
BROKEN: dict[Path, Path] = {}
"""The clips that a run in a folder was given."""


@pytest.fixture(scope="module")
def clips(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = [to_triplet(next(make_sequence(seed, spec=SPEC))) for seed in (0, 1)]
    clips = [
        replace(clip, video_id=f"sample_{number}", extra={"split": "train"})
        for number, clip in enumerate(made)
    ]
    return write_clips(tmp_path_factory.mktemp("clips"), clips, fps=SPEC.fps)


@pytest.fixture(scope="module")
def generated(clips: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two clips. One has no mask and fails; the other is made."""
    broken = tmp_path_factory.mktemp("broken")
    shutil.copytree(clips.parent, broken, dirs_exist_ok=True)
    (broken / "sample_1" / "pc_mask_video.mp4").unlink()
    out = tmp_path_factory.mktemp("out") / "run"
    assert main(generate(broken / "metadata.csv", out)) == 3
    BROKEN[out] = broken
    return out


def generate(metadata: Path, out: Path, *more: str) -> list[str]:
    fixed = ["--config", "debug", "--metadata", str(metadata), "--out", str(out)]
    return ["generate", *fixed, *more]


def results(out: Path) -> dict[str, dict]:
    lines = (out / "results.jsonl").read_text("utf-8").splitlines()
    return {line["video_id"]: line for line in map(json.loads, lines)}


def test_the_second_start_compiles_nothing_and_makes_the_same_clip(clips, weights, tmp_path):
    made = {}
    for name in ("first", "second"):
        args = generate(clips, tmp_path / name, "--weights", str(weights), "--limit", "1")
        ran = subprocess.run(
            [sys.executable, "-m", "egosim_jax.cli", *args],
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path), "JAX_LOG_COMPILES": "1"},
            capture_output=True,
            text=True,
            check=True,
        )
        compiled = ran.stderr.count("Finished XLA compilation")
        made[name] = compiled, (tmp_path / name / "sample_0.mp4").read_bytes()
    assert made["first"][0] >= 4
    assert made["second"][0] == 0
    assert made["first"][1] == made["second"][1]


def test_one_bad_clip_is_reported_and_the_others_are_made(generated):
    assert results(generated)["sample_1"]["status"] == "failed"
    assert "pc_mask_video.mp4" in results(generated)["sample_1"]["error"]
    assert results(generated)["sample_0"]["status"] == "done"
    assert not (generated / "sample_1.mp4").exists()


def test_existing_clips_are_skipped_and_the_missing_one_is_made(generated, clips, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(generated, out)
    before = (out / "sample_0.mp4").stat().st_mtime_ns
    assert main(generate(clips, out, "--skip-existing")) == 0
    assert (out / "sample_0.mp4").stat().st_mtime_ns == before
    assert results(out)["sample_1"]["status"] == "done"


def test_a_clip_named_like_the_temporary_file_of_another_is_not_lost(clips, tmp_path):
    rows = clips.read_text("utf-8").replace("sample_1,", "sample_0.tmp,")
    folder = tmp_path / "clips"
    shutil.copytree(clips.parent, folder)
    (folder / "metadata.csv").write_text(rows, "utf-8")
    assert main(generate(folder / "metadata.csv", tmp_path / "out")) == 0
    names = {path.name for path in (tmp_path / "out").glob("sample_0*.mp4")}
    assert names == {f"sample_0{name}.mp4" for name in ("", "_cmp", ".tmp", ".tmp_cmp")}


def test_a_clip_whose_line_a_kill_prevented_is_made_again(generated, clips, tmp_path):
    out = tmp_path / "run"
    shutil.copytree(generated, out)
    (out / "results.jsonl").unlink()
    assert main(generate(clips, out, "--skip-existing", "--limit", "1")) == 0
    assert results(out)["sample_0"]["status"] == "done"


def test_evaluate_reports_the_generated_clips_along_with_the_baselines(generated, clips, capsys):
    args = ["evaluate", "--generated", str(generated), "--metadata", str(clips)]
    assert main(args) == 3  # one of the two clips was never generated
    report = json.loads((generated / "report.json").read_text("utf-8"))
    assert report["splits"]["train"].keys() >= {"generated", "prior", "prior_fit", "still"}
    assert "PSNR" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["--config", "debg"], "Nearest: debug"),
        (["--config", "real_tiny"], "--weights"),
        (["--metadata", "nowhere.csv"], "nowhere.csv"),
        (["--where", "split=nowhere"], "split is one of: train"),
        (["--video-id", "sample_7"], "No clip has the id sample_7"),
        (["--weights", "nowhere"], "--weights"),
        (["--steps", "0"], "--steps must be at least 1"),
        (["--limit", "0"], "--limit must be at least 1"),
        (["--batch-size", "0"], "--batch-size must be at least 1"),
        (["--mesh.data", "1000"], "A mesh of data 1000 x fsdp 1 x context 1 does not fit"),
        (["--start", "4"], "fewer than the 13"),
    ],
)
def test_bad_usage_is_one_message_before_anything_is_compiled(
    clips, tmp_path, capsys, monkeypatch, change, message
):
    monkeypatch.setattr(
        "egosim_jax.generation.generator.Generator.compile", lambda *_: pytest.fail("it compiled")
    )
    assert main(generate(clips, tmp_path / "out", *change)) == 2
    assert message in capsys.readouterr().err


def test_without_metadata_a_scene_is_drawn_by_seed(tmp_path):
    out = tmp_path / "run"
    args = ["generate", "--config", "debug", "--seed", "5", "--limit", "2", "--out", str(out)]
    assert main([*args, "--robot"]) == 0
    assert results(out).keys() == {"tabletop_robot_5_0", "tabletop_robot_6_0"}
    assert "gripper" in results(out)["tabletop_robot_5_0"]["prompt"]
    assert (out / "scenes" / "tabletop_robot_5_0" / "video.mp4").exists()
    with Image.open(out / "contact_sheet.png") as sheet:
        assert sheet.size == (6 * 240, 2 * (16 + 4 * 160))


def test_the_ablation_has_a_row_for_each_method_and_a_sheet_for_each_kind(
    weights, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(lpips, "load_if_installed", lambda name: None)  # slow in the tests' code
    out = tmp_path / "out"
    fixed = ["--steps", "2", "--config", "debug", "--weights", str(weights), "--out", str(out)]
    counts = ["--scenes", "2", "--seeds", "2", "--batch-size", "2"]
    assert main(["experiment", "tabletop", *fixed, *counts]) == 0
    assert json.loads((out / "config.json").read_text("utf-8"))["model"]["steps"] == 2
    report = json.loads((out / "report.json").read_text("utf-8"))
    tables = report["tables"]
    assert tables.keys() == {"human", "robot"}
    human, differences = tables["human"], report["differences"]["human"]
    assert differences.keys() == {"without prior", "without mask", "without hands"}
    dropped = differences["without prior"]["psnr"]
    want = human["without prior"]["psnr"]["mean"] - human["full"]["psnr"]["mean"]
    assert dropped["mean"] == pytest.approx(want)
    assert dropped["low"] <= dropped["mean"] <= dropped["high"]  # an untrained head ignores all
    assert human.keys() >= {"full", "without prior", "without mask", "without hands"}
    assert human["ground truth"]["psnr"]["mean"] == 100
    assert human["ground truth"]["hand_iou"]["mean"] > 0.7
    assert human["full"]["psnr"]["spread_over_seeds"] > 0
    assert human["prior copied"]["region_psnr"]["mean"] < 30
    assert (out / "contact_sheet_human.png").exists()
    assert (out / "contact_sheet_robot.png").exists()
    assert "without" in capsys.readouterr().out  # narrow terminals fold the names of rows
