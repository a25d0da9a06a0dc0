"""`egosim evaluate`: the compared videos, frames and sizes."""

import csv
import dataclasses
import json
import sys

import numpy as np
import pytest
from flax import nnx

from egosim_jax.cli.evaluate import Evaluate
from egosim_jax.evaluation.files import cell
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.evaluation.metrics.image import psnr, ssim
from egosim_jax.io.video import read_video
from egosim_jax.io.writing import write_video
from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError


@pytest.fixture
def run(clips, tmp_path):
    """A folder of generated clips: the ground truth, a little darker."""
    folder = tmp_path / "run"
    for name in ("clip0", "clip1"):
        write_video(folder / f"{name}.mp4", target_of(clips, name) // 2 + 50, 16)
    return folder


@pytest.fixture(scope="module")
def network():
    """Return a small LPIPS network, because test programs are compiled without optimization."""
    stage = (lpips.Convolution(features=4),)
    alex = dataclasses.replace(lpips.CONFIGS["alex"], stages=(stage,) * 5)
    return lpips.Lpips(alex, rngs=nnx.Rngs(0))


@pytest.fixture(autouse=True)
def installed(network, monkeypatch):
    """Let commands find the network."""
    monkeypatch.setattr(lpips, "load_if_installed", lambda name: network)


def target_of(clips, name):
    return read_video(clips.parent / name / "video.mp4").frames


def metrics(folder):
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return {line["video_id"]: line for line in map(json.loads, lines)}


def test_a_clip_is_compared_with_its_ground_truth_from_frame_1_on(clips, run):
    assert Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run() == ExitCode.DONE
    generated, reference = read_video(run / "clip1.mp4").frames, target_of(clips, "clip1")
    scores = metrics(run)["clip1"]
    assert scores["generated"]["psnr"] == pytest.approx(psnr(generated, reference)[1:].mean())
    assert scores["generated"]["ssim"] == pytest.approx(ssim(generated, reference)[1:].mean())
    assert scores["split"] == "test"


def test_lpips_is_a_column_with_its_protocol(clips, run, network, capsys):
    Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run()
    generated, reference = read_video(run / "clip1.mp4").frames, target_of(clips, "clip1")
    expected = lpips.frame_distances(network, generated, reference)[1:].mean()
    assert metrics(run)["clip1"]["generated"]["lpips_alex"] == pytest.approx(expected, abs=1e-6)
    protocol = json.loads((run / "report.json").read_text())["protocol"]["lpips_alex"]
    assert protocol == lpips.DEFINITION
    printed = capsys.readouterr().out
    assert "LPIPS-Alex" in printed
    assert lpips.DEFINITION in printed


def test_without_the_extra_there_is_no_page_and_the_report_says_so(clips, run, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    assert Evaluate(generated=(str(run),), metadata=clips).run() == ExitCode.DONE
    said = capsys.readouterr().out
    assert "index.html: the page cannot be written" in said.replace("\n", " ")
    assert said.endswith(f"{run / 'report.json'}\n")
    assert (run / "scores.png").exists()
    assert not (run / "index.html").exists()


def test_the_baselines_are_prior_fitted_prior_and_first_frame(clips, run):
    Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run()
    scores, reference = metrics(run)["clip0"], target_of(clips, "clip0")
    prior = read_video(clips.parent / "clip0" / "ego_prior_video.mp4").frames
    still = np.broadcast_to(reference[:1], reference.shape)
    assert scores["prior"]["psnr"] == pytest.approx(psnr(prior, reference)[1:].mean())
    assert scores["still"]["psnr"] == pytest.approx(psnr(still, reference)[1:].mean())
    assert scores["prior_fit"]["psnr"] > scores["prior"]["psnr"]
    assert "vae" not in scores


def test_a_reconstruction_is_compared_as_the_upper_bound(clips, run):
    write_video(run / "clip0_vae.mp4", target_of(clips, "clip0"), 16)
    Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run()
    copy, reference = read_video(run / "clip0_vae.mp4").frames, target_of(clips, "clip0")
    assert metrics(run)["clip0"]["vae"]["psnr"] == pytest.approx(psnr(copy, reference)[1:].mean())
    assert "vae" not in metrics(run)["clip1"]


def test_results_name_the_windows(clips, run):
    write_video(run / "clip0_3.mp4", target_of(clips, "clip0")[3:8], 16)
    line = {"video_id": "clip0_3", "source_id": "clip0", "start": 3, "status": "done"}
    (run / "results.jsonl").write_text(json.dumps(line) + "\n")
    assert Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run() == ExitCode.DONE
    assert list(metrics(run)) == ["clip0_3"]
    generated, reference = read_video(run / "clip0_3.mp4").frames, target_of(clips, "clip0")[3:8]
    expected = psnr(generated, reference)[1:].mean()
    assert metrics(run)["clip0_3"]["generated"]["psnr"] == pytest.approx(expected)


def test_a_clip_that_failed_is_skipped_and_named(clips, run, capsys):
    lines = [
        {"video_id": name, "source_id": name, "start": 0, "status": status}
        for name, status in (("clip0", "failed"), ("clip1", "done"))
    ]
    (run / "results.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    assert Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run() == ExitCode.PARTIAL
    assert "skipped: clip0: its generation failed" in capsys.readouterr().err
    assert list(metrics(run)) == ["clip1"]


def test_a_missing_clip_is_skipped_and_named(clips, run, capsys):
    (run / "clip0.mp4").unlink()
    assert Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run() == ExitCode.PARTIAL
    assert f"skipped: clip0: {run / 'clip0.mp4'} cannot be read: No such" in capsys.readouterr().err


def test_a_ground_truth_that_ends_before_the_clip_is_named(clips, run, capsys):
    for name in ("clip0", "clip1"):
        write_video(run / f"{name}.mp4", np.zeros((13, 32, 48, 3), np.uint8), 16)
    with pytest.raises(InputError, match="could be compared"):
        Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run()
    assert "13 are needed" in capsys.readouterr().err


def test_a_clip_of_fewer_frames_is_skipped_and_named(clips, run, capsys):
    write_video(run / "clip0.mp4", target_of(clips, "clip0")[:5], 16)
    assert Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run() == ExitCode.PARTIAL
    assert "skipped: clip0: it has 5 frames, most clips 9." in capsys.readouterr().err
    assert list(metrics(run)) == ["clip1"]


def test_methods_of_different_size_compare_at_the_size_of_the_target_of(clips, run, tmp_path):
    small = tmp_path / "small"
    for name in ("clip0", "clip1"):
        write_video(small / f"{name}.mp4", read_video(run / f"{name}.mp4").frames[:, ::2, ::3], 16)
    for folder in (run, small):
        Evaluate(generated=(str(folder),), page_clips=0, metadata=clips, size="target").run()
    assert json.loads((small / "report.json").read_text())["protocol"]["pixels"] == ["48x32"]
    for method in ("prior", "still"):  # neither depends on the generated clips
        assert metrics(small)["clip0"][method] == metrics(run)["clip0"][method]
    Evaluate(generated=(str(small),), page_clips=0, metadata=clips).run()
    assert metrics(small)["clip0"]["prior"] != metrics(run)["clip0"]["prior"]


DONE = {"video_id": "a", "source_id": "a", "start": 0, "status": "done"}


@pytest.mark.parametrize("changed", [None, {"video_id": "../x"}, {"start": None}])
def test_invalid_results_are_refused(clips, run, changed):
    line = "{" if changed is None else json.dumps({**DONE, **changed})
    (run / "results.jsonl").write_text(line + "\n")
    with pytest.raises(InputError, match=r"results\.jsonl, line 1"):
        Evaluate(generated=(str(run),), page_clips=0, metadata=clips).run()


HOSTILE = {
    "mathtext": r"$\foo$",
    "formula": "=cmd|' /C calc'!A0",
    "escape": "\x1b[31mred",
    "markup": "[/red]<script>",
    "LaTeX": r"\input{/etc/passwd}%",
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_group_may_have_any_name(clips, run, kind, capsys):
    with clips.open(newline="") as file:
        rows = [row | {"split": HOSTILE[kind]} for row in csv.DictReader(file)]
    with clips.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    assert Evaluate(generated=(str(run),), page_clips=1, metadata=clips).run() == ExitCode.DONE
    said = capsys.readouterr()
    assert all(line.isprintable() for line in (said.out + said.err).splitlines())
    with (run / "scores.csv").open(newline="") as file:
        scores = list(csv.DictReader(file))
    assert not any(
        cell.lstrip()[:1] in tuple("=+@\uff1d") for row in scores for cell in row.values()
    )
    assert all(float(row["psnr"]) > 0 for row in scores)
    assert "<script" not in (run / "index.html").read_text()
    assert "\\input" not in (run / "table.tex").read_text()


@pytest.mark.parametrize("text", ["-1.5", "+3", "1e-5", "clip 1", "", "a=b", "-"])
def test_numbers_and_names_of_a_csv_stay_as_they_are(text):
    assert cell(text) == (f"'{text}" if text == "-" else text)
