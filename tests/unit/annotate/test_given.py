"""Recorded cameras, hands and depth are used instead of estimates."""

from dataclasses import replace
from fractions import Fraction

import cv2
import numpy as np
import pytest

from egosim_jax.annotate.clip import ANNOTATION
from egosim_jax.annotate.frames import Sampling
from egosim_jax.annotate.sources import Source, open_source
from egosim_jax.data.recorded_files import DepthFiles
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import read_json
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.state import snapshot
from egosim_jax.types import InputError
from tests.unit.annotate.stubs import DEPTH, config, mean_hand, textured_video, write
from tests.unit.annotate.test_run import annotate

ARRAYS = {"world_from_camera": "float64", "intrinsics_px": "float64", "joints_m": "float64"}


@pytest.fixture
def recording(tmp_path):
    """A recording of 17 frames; the camera moves to the right by 1 cm per frame."""
    path = write(tmp_path / "source.mp4", textured_video(17))
    poses = np.tile(np.eye(4), (17, 1, 1))
    poses[:, 0, 3] = 0.01 * np.arange(17)
    joints = np.full((17, 2, 21, 3), np.nan)
    joints[:, 1] = mean_hand() + [0.08, 0.1, 0.6]
    return Recording(
        recording_id="take",
        video=path,
        frames=17,
        fps=Fraction(16),
        height=48,
        width=80,
        world_from_camera=poses,
        intrinsics_px=np.array([[60.0, 0, 39.5], [0, 60, 23.5], [0, 0, 1]]),
        metric=True,
        joints_m=joints,
        caption="put the cup down",
        names=("cup",),
    )


def test_cameras_hands_and_caption_are_those_of_the_recording(recording, tmp_path):
    recording.save(tmp_path / "imported/take")
    out, log = tmp_path / "out", tmp_path / "calls"
    annotate([tmp_path / "imported"], out, config(log=log))
    assert log.read_text().split() == ["depth"]
    about = read_json(out / "take" / ANNOTATION)
    assert about["cameras"]["rung"] == "given"
    assert about["hands"]["source"] == "recording"
    assert about["scale"]["source"] == "cameras"
    assert about["caption"] == {"source": "recording", "names": ["cup"]}
    assert about["row"]["prompt"] == "put the cup down"
    action = read_arrays(out / "take/action.npz", ARRAYS)
    assert np.allclose(action["world_from_camera"], recording.world_from_camera)
    assert np.array_equal(action["joints_m"], recording.joints_m, equal_nan=True)


def test_another_rate_takes_the_poses_of_its_frames(recording, tmp_path):
    recording.save(tmp_path / "imported/take")
    settings = config(sampling=Sampling(fps=8.0, num_frames=9))
    annotate([tmp_path / "imported"], tmp_path / "out", settings)
    action = read_arrays(tmp_path / "out/take/action.npz", ARRAYS)
    assert np.allclose(action["world_from_camera"][:, 0, 3], 0.02 * np.arange(9))


def test_measured_depth_gives_the_scene_and_the_scale(recording, tmp_path):
    files = []
    for frame in range(17):
        files.append(tmp_path / f"{frame}.npy")
        np.save(files[-1], np.full((24, 40), 700.0, np.float32))
    known = replace(
        recording,
        world_from_camera=None,
        joints_m=None,
        metric=False,
        depth=DepthFiles(paths=tuple(files), unit_m=0.001),
    )
    known.save(tmp_path / "imported/take")
    out, log = tmp_path / "out", tmp_path / "calls"
    annotate([tmp_path / "imported"], out, config(log=log))
    assert log.read_text().split() == ["hands", "cameras"]
    about = read_json(out / "take" / ANNOTATION)
    assert about["depth"]["source"] == "recording"
    assert about["cameras"]["focal_source"] == "recording"
    assert about["cameras"]["focal_px"] == 60
    assert np.allclose(snapshot.load(out / "take/state").points_m[:, 2], 0.7)


def with_depth(recording, folder, at_m, unit_m, numbers=range(17)):
    for number in numbers:
        path = folder / f"{number:06d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((24, 40), round(at_m / unit_m), np.uint16))
    paths = tuple(folder / f"{n:06d}.png" for n in range(17))
    return replace(recording, depth=DepthFiles(paths=paths, unit_m=0.001))


@pytest.mark.parametrize("unit_m", [0.001, 0.0001, 0.00025, 0.01])
def test_depth_of_another_unit_contradicts_the_hands(recording, tmp_path, unit_m):
    """The hand is at .6 m, and the depth at its pixels is .62 m."""
    known = with_depth(recording, tmp_path / "depth", 0.62, unit_m)
    known.save(tmp_path / "imported/take")
    for given in (None, unit_m):
        out = tmp_path / f"out_{given}"
        report = annotate([tmp_path / "imported"], out, config(depth_unit_m=given))
        (about,) = report["annotations"]
        if given or unit_m == 0.001:
            assert about["status"] == "done"
            assert np.allclose(snapshot.load(out / "take/state").points_m[:, 2], 0.62, atol=0.01)
        else:
            assert (about["status"], about["rule"]) == ("refused", "depth")
            assert "(--depth-unit)" in about["reason"]


@pytest.mark.parametrize(
    ("numbers", "first"),
    [(range(17), 0), (range(1, 18), 1), (range(100, 117), 100), ([*range(16)], 0), ([0, 8, 16], 0)],
)
def test_depth_files_are_shifted_to_the_first_frame(recording, tmp_path, caplog, numbers, first):
    with_depth(recording, tmp_path / "depth/take", 0.62, 0.001, numbers)
    replace(recording, joints_m=None).save(tmp_path / "imported")
    opened = open_source(Source(name="take", path=tmp_path / "imported"), tmp_path / "depth")
    found = {n + first for n, path in enumerate(opened.depth.paths) if path is not None}
    assert found == set(numbers)
    assert ("is used for frame 0" in caplog.text) == (first > 0)


@pytest.mark.parametrize("numbers", [range(1, 17), range(14), range(20), range(5, 25), [0, 9, 18]])
def test_depth_files_of_other_numbers_are_refused(recording, tmp_path, numbers):
    with_depth(recording, tmp_path / "depth/take", 0.62, 0.001, numbers)
    recording.save(tmp_path / "imported")
    with pytest.raises(InputError, match="17 frames"):
        open_source(Source(name="take", path=tmp_path / "imported"), tmp_path / "depth")


def test_given_depth_is_numbered_by_the_frames_of_the_video(recording, tmp_path):
    for number in range(17):
        path = tmp_path / f"depth/take/{number:06d}.npy"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, np.full((24, 40), 1 + number, np.float32))
    cut = replace(recording.clip(3, 17), depth=None)
    timed = replace(recording, times_s=np.arange(17) / 20 + 0.01, fps=Fraction(20), joints_m=None)
    for name, numbers in ((cut, range(3, 17)), (timed, np.rint(np.arange(17) * 0.8 + 0.16))):
        name.save(tmp_path / "imported")
        opened = open_source(Source(name="take", path=tmp_path / "imported"), tmp_path / "depth")
        found = [opened.read_depth(frame)[0, 0] for frame in range(opened.frames)]
        np.testing.assert_array_equal(found, 1 + np.array(numbers))


def test_a_fused_scene_has_what_later_frames_show(recording, tmp_path):
    recording.save(tmp_path / "imported/take")
    points = {}
    for state in ("first", "fused"):
        annotate([tmp_path / "imported"], tmp_path / state, config(state=state))
        points[state] = snapshot.load(tmp_path / state / "take/state").points_m
    first, fused = points["first"], points["fused"]
    assert np.array_equal(fused[: len(first)], first)
    assert len(fused) > len(first)
    assert fused[len(first) :, 0].min() > first[:, 0].max() - 0.05
    assert np.allclose(fused[:, 2], DEPTH)
