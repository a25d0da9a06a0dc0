"""Annotation of videos, from files to metadata.csv."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.annotate import clip as clips
from egosim_jax.annotate import run
from egosim_jax.annotate.clip import ANNOTATION
from egosim_jax.annotate.frames import Sampling
from egosim_jax.annotate.gallery import HIDDEN, hides_scene, summary
from egosim_jax.annotate.prepare import Cutting, Quality
from egosim_jax.annotate.sources import find_sources
from egosim_jax.data.clips import check_clip
from egosim_jax.data.metadata import read_metadata
from egosim_jax.io.bounded import read_json
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.io.video import read_video
from egosim_jax.state import snapshot
from egosim_jax.types import InputError
from tests.unit.annotate.stubs import DEPTH, FOCAL, config, textured_video, write


def annotate(paths, out, settings=None, *, workers=1):
    settings = settings or config()
    run.require_config(out, settings)
    scanned = list(run.scan_sources(find_sources(paths), out, settings, workers=workers))
    jobs = run.choose_jobs(scanned, out, settings)
    list(run.annotate_jobs(jobs, out, settings, workers=workers))
    return run.write_report(scanned, out)


@pytest.fixture
def video(tmp_path):
    return write(tmp_path / "cup.mp4", textured_video(17))


def test_a_video_becomes_a_clip_that_passes_the_strict_checks(video, tmp_path):
    out = tmp_path / "out"
    report = annotate([video], out, config(caption="take the cup"))
    assert report["clips"] == {"done": 1, "refused": 0, "failed": 0}
    (files,) = read_metadata(out / "metadata.csv")
    assert check_clip(files, None) == []
    assert (files.video_id, files.prompt) == ("cup", "take the cup")
    assert files.extra == {"split": "train", "source": "cup.mp4", "rung": "static"}
    assert read_video(files.prior).fps == 16


def test_the_scene_is_in_meters_and_the_prior_shows_it(video, tmp_path):
    out = tmp_path / "out"
    annotate([video], out, config(scale=0.5))
    about = read_json(out / "cup" / ANNOTATION)
    state = snapshot.load(out / "cup/state")
    assert np.allclose(state.points_m[:, 2], DEPTH / 2)
    prior = read_video(out / "cup/ego_prior_video.mp4").frames
    first = read_video(video).frames[0]
    outside = np.ones((48, 80), bool)
    outside[8:, 20:60] = False
    assert np.abs(prior[0].astype(int) - first)[outside].mean() < 6
    assert np.abs(prior[-1].astype(int) - first)[outside].mean() < 6
    assert about["scale"]["source"] == "given"
    names = {"world_from_camera": "float64", "intrinsics_px": "float64", "joints_m": "float64"}
    action = read_arrays(out / "cup/action.npz", names)
    assert action["joints_m"].shape == (17, 2, 21, 3)
    assert np.isfinite(action["joints_m"][:, 1]).all()


def test_an_annotation_says_what_was_chosen(video, tmp_path):
    out = tmp_path / "out"
    annotate([video], out)
    about = read_json(out / "cup" / ANNOTATION)
    assert about["status"] == "done"
    assert about["cameras"]["rung"] == "static"
    assert about["cameras"]["figures"] == {"still": 1.0}
    assert about["caption"]["source"] == "rule"
    assert about["row"]["prompt"] == "The wearer's right hand moves in view of a camera."
    assert about["hands"]["frames"] == {"left": 0, "right": 17}
    assert set(about["seconds"]) >= {"hands", "cameras", "depth", "scale", "plate", "write"}
    page = (out / "index.html").read_text()
    assert "data:image/jpeg" in page
    assert "<script" not in page
    assert not (out / "work/cup").exists()


def test_the_page_says_what_became_of_videos_and_of_the_scene_behind_hands(video, tmp_path):
    out, broken = tmp_path / "out", tmp_path / "broken.mp4"
    broken.write_bytes(b"no video")
    report = annotate([video, broken], out)
    line = "1 clip done, 0 refused, 0 failed; of 2 videos, 1 without a clip"
    assert summary(report) == line
    page = (out / "index.html").read_text()
    assert f"<h1>{line}</h1>" in page
    (about,) = report["annotations"]
    assert 0 < about["plate"]["hidden"] < 1
    assert hides_scene(about) == (HIDDEN in page)
    for hidden, named in ((0.0, False), (0.2, True)):
        assert hides_scene({**about, "plate": {"hidden": hidden}}) == named


@pytest.mark.parametrize(
    ("settings", "rule"),
    [
        ({"hands_until": 0.2}, "hands"),
        ({"hands_until": 0.0}, "hands"),
        ({"refuse": True}, "cameras"),
    ],
)
def test_a_refused_clip_is_reported_and_not_listed(video, tmp_path, settings, rule):
    out = tmp_path / "out"
    report = annotate([video], out, config(**settings))
    assert report["clips"] == {"done": 0, "refused": 1, "failed": 0}
    assert report["annotations"][0]["rule"] == rule
    assert not (out / "metadata.csv").exists()
    assert "data:image/jpeg" in (out / "index.html").read_text()


def test_segmented_objects_are_instances_of_the_scene(video, tmp_path):
    out, log = tmp_path / "out", tmp_path / "calls"
    annotate([video], out, config(segment=True, phrases=("cup",), log=log))
    assert log.read_text().split()[1] == "cup+hand+arm"
    state = snapshot.load(out / "cup/state")
    assert state.names == {5: "cup"}
    assert sorted(set(state.object_ids.tolist())) == [0, 5]
    about = read_json(out / "cup" / ANNOTATION)
    assert about["row"]["prompt"].endswith("camera near cup.")
    assert about["plate"]["hand_px"] == 100


def test_hands_that_come_late_can_be_accepted(video, tmp_path):
    few = Cutting(quality=Quality(min_hands=0.0))
    report = annotate([video], tmp_path / "out", config(hands_until=0.2, cutting=few))
    assert report["clips"]["done"] == 1
    none = annotate([video], tmp_path / "none", config(hands_until=0.0, cutting=few))
    assert none["annotations"][0]["scale"]["source"] == "median depth"


def test_one_bad_video_does_not_stop_the_others(video, tmp_path):
    (tmp_path / "bad.mp4").write_bytes(b"not a video")
    write(tmp_path / "short.mp4", textured_video(5))
    report = annotate([tmp_path / n for n in ("bad.mp4", "short.mp4", "cup.mp4")], tmp_path / "out")
    assert report["clips"]["done"] == 1
    assert "not a readable video" in report["videos"]["bad"]["problem"]
    assert "a clip needs 9" in report["videos"]["short"]["problem"]
    assert "not a readable video" in (tmp_path / "out/index.html").read_text()


def test_a_bad_video_that_was_replaced_is_annotated(tmp_path):
    bad, out = tmp_path / "cup.mp4", tmp_path / "out"
    bad.write_bytes(b"not a video")
    assert "problem" in annotate([bad], out)["videos"]["cup"]
    write(bad, textured_video(17))
    report = annotate([bad], out)
    assert report["clips"]["done"] == 1
    assert "problem" not in report["videos"]["cup"]


def test_a_second_video_is_added_to_the_first(video, tmp_path):
    out = tmp_path / "out"
    annotate([video], out)
    (tmp_path / "bad.mp4").write_bytes(b"no video")
    annotate([tmp_path / "bad.mp4"], out)
    report = annotate([write(tmp_path / "jug.mp4", textured_video(17))], out)
    assert report["clips"]["done"] == 2
    assert list(report["videos"]) == ["jug", "bad", "cup"]
    assert [files.video_id for files in read_metadata(out / "metadata.csv")] == ["cup", "jug"]
    assert read_json(out / "report.json") == report


def test_the_rest_of_a_longer_video_is_named(video, tmp_path):
    settings = config(sampling=Sampling(num_frames=9))
    note = annotate([video], tmp_path / "out", settings)["videos"]["cup"]["note"]
    assert "of 17 frames at 16 fps, the first 9 are one clip" in note
    assert note == annotate([video], tmp_path / "out", settings)["videos"]["cup"]["note"]
    assert "note" not in annotate([video], tmp_path / "all")["videos"]["cup"]


def test_another_configuration_in_the_same_folder_is_refused(video, tmp_path):
    annotate([video], tmp_path / "out")
    with pytest.raises(InputError, match=r"scale: the folder has 'None', this run has '0\.5'"):
        annotate([video], tmp_path / "out", config(scale=0.5))


def test_a_replaced_video_is_refused(video, tmp_path):
    annotate([video], tmp_path / "out")
    write(video, textured_video(33))
    with pytest.raises(InputError, match="is not the file that"):
        annotate([video], tmp_path / "out")


def test_finished_stages_and_clips_are_not_repeated(video, tmp_path, monkeypatch):
    out, log = tmp_path / "out", tmp_path / "calls"
    settings = config(log=log)

    def interrupted(*args):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(clips, "to_triplet", interrupted)
        with pytest.raises(KeyboardInterrupt):
            annotate([video], out, settings)
    assert log.read_text().split() == ["hands", "cameras", "depth"]
    assert annotate([video], out, settings)["clips"]["done"] == 1
    assert log.read_text().split() == ["hands", "cameras", "depth"]
    before = (out / "report.json").read_bytes()
    annotate([video], out, settings)
    assert (out / "report.json").read_bytes() == before


def test_an_interrupted_run_continues_after_its_folder_was_moved(video, tmp_path, monkeypatch):
    log = tmp_path / "calls"
    settings = config(log=log)
    with monkeypatch.context() as patch:
        patch.setattr(run, "annotate_jobs", lambda *_, **__: [][1])
        with pytest.raises(IndexError):
            annotate([video], tmp_path / "out", settings)
    (tmp_path / "out").rename(tmp_path / "moved")
    assert annotate([video], tmp_path / "moved", settings)["clips"]["done"] == 1
    assert not (tmp_path / "out").exists()


def test_pipes_are_named_and_hidden_folders_skipped(video, tmp_path):
    (tmp_path / "set/.fold.0123456789abcdef.tmp").mkdir(parents=True)
    video.rename(tmp_path / "set/.fold.0123456789abcdef.tmp/video.mp4")
    with pytest.raises(InputError, match="holds no video"):
        find_sources([tmp_path / "set"])
    os.mkfifo(tmp_path / "set/pipe.mp4")
    (tmp_path / "set/link.mp4").symlink_to(tmp_path / "missing")
    videos = annotate([tmp_path / "set"], tmp_path / "out")["videos"]
    assert "not a regular file" in videos["pipe"]["problem"]
    assert "No such file" in videos["missing"]["problem"]


@pytest.mark.parametrize("member", ["a video", "a link", "a folder above"])
def test_a_name_that_is_not_utf8_is_reported_and_the_others_are_annotated(video, tmp_path, member):
    name, place = os.fsdecode(b"caf\xe9"), tmp_path / "set"
    place.mkdir()
    video.rename(place / "cup.mp4")
    odd = write(tmp_path / "odd.mp4", textured_video(17, seed=3))
    if member == "a folder above":
        (place / name).mkdir()
        odd.rename(place / name / "odd.mp4")
    elif member == "a link":
        odd.rename(tmp_path / f"{name}.mp4")
        (place / "odd.mp4").symlink_to(tmp_path / f"{name}.mp4")
    else:
        odd.rename(place / f"{name}.mp4")
    for _ in range(2):
        report = annotate([place], tmp_path / "out")
        assert report["clips"]["done"] == 1
        (problem,) = [about["problem"] for about in report["videos"].values() if "problem" in about]
        assert "caf\\udce9" in problem
        assert "convmv" in problem
    assert read_json(tmp_path / "out/report.json") == report


def test_a_defect_is_reported_for_its_clip_alone_and_tried_again(video, tmp_path, monkeypatch):
    out = tmp_path / "out"
    write(tmp_path / "dish.mp4", textured_video(17, seed=3))
    real = clips.to_triplet

    def broken(record, settings):
        if record.video_id == "dish":
            raise ZeroDivisionError("a defect")
        return real(record, settings)

    with monkeypatch.context() as patch:
        patch.setattr(clips, "to_triplet", broken)
        report = annotate([video, tmp_path / "dish.mp4"], out)
    assert report["clips"] == {"done": 1, "refused": 0, "failed": 1}
    assert "ZeroDivisionError: a defect" in report["annotations"][1]["reason"]
    assert "to_triplet" in (out / "work/dish/traceback.txt").read_text()
    assert annotate([video, tmp_path / "dish.mp4"], out)["clips"]["done"] == 2


def test_a_clip_without_cameras_is_tried_with_the_focal_length_of_its_video(tmp_path):
    out, settings = (
        tmp_path / "out",
        config(sampling=Sampling(num_frames=9), cutting=Cutting(clips=True), refuse_dark=True),
    )
    frames = np.concatenate([textured_video(9), textured_video(9, seed=1) // 2])
    path = write(tmp_path / "long.mp4", frames)
    report = annotate([path], out, settings)
    assert [about["status"] for about in report["annotations"]] == ["done", "refused"]
    scanned = list(run.scan_sources(find_sources([path]), out, settings, workers=1))
    (retry,) = run.choose_retries(scanned, out)
    assert (retry.video_id, retry.focal_px) == ("long_9_17", FOCAL)
    assert list(run.annotate_jobs([retry], out, settings, workers=1)) == ["done"]
    assert run.choose_retries(scanned, out) == []


def test_killed_runs_continue(video, tmp_path):
    """After a process is killed, the same command gives the result of one run."""
    write(tmp_path / "dish.mp4", textured_video(17, seed=3))
    program = f"""
import os, sys
sys.path.insert(0, {str(Path.cwd())!r})
from pathlib import Path
from egosim_jax.annotate import clip
from tests.unit.annotate.stubs import config
from tests.unit.annotate.test_run import annotate
finish = clip.finish
def killed(job, *rest):
    if job.video_id == "cup":
        os.kill(os.getpid(), 9)
    finish(job, *rest)
clip.finish = killed
here = Path({str(tmp_path)!r})
annotate([here / "cup.mp4", here / "dish.mp4"], here / "out")
"""
    ended = subprocess.run([sys.executable, "-c", program], check=False)
    assert ended.returncode == -signal.SIGKILL
    assert not (tmp_path / "out/cup" / ANNOTATION).exists()
    videos = [video, tmp_path / "dish.mp4"]
    resumed = annotate(videos, tmp_path / "out")
    straight = annotate(videos, tmp_path / "straight")
    for report in (resumed, straight):
        for about in report["annotations"]:
            del about["seconds"]
    assert json.dumps(resumed) == json.dumps(straight)
    for name in ("cup/ego_prior_video.mp4", "dish/action.npz", "metadata.csv"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "straight" / name).read_bytes()
