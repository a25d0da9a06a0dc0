"""Recordings: validation, and equality after saving and loading."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from egosim_jax.data.recorded_files import DepthFiles
from egosim_jax.data.recording import Recording
from egosim_jax.data.scene_points import ScenePoints
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.images import read_depth_image
from egosim_jax.io.writing import write_video
from egosim_jax.types import InputError

FRAMES, HEIGHT, WIDTH = 6, 24, 32
INTRINSICS = np.array([[30.0, 0, 16], [0, 30, 12], [0, 0, 1]])


def make_hand(distance=0.5):
    rng = np.random.default_rng(0)
    return np.array([0, 0, distance]) + rng.uniform(-0.05, 0.05, (21, 3))


def make_recording(tmp_path, **changes):
    frames = np.zeros((10, HEIGHT, WIDTH, 3), np.uint8)
    frames += (20 * np.arange(10, dtype=np.uint8))[:, None, None, None]
    write_video(tmp_path / "video.mp4", frames, 10)
    joints = np.full((FRAMES, 2, 21, 3), np.nan)
    joints[1:, 1] = make_hand()
    np.save(tmp_path / "depth.npy", np.full((HEIGHT // 2, WIDTH // 2), 700, np.uint16))
    fields = {
        "recording_id": "fold_12",
        "video": tmp_path / "video.mp4",
        "start": 3,
        "frames": FRAMES,
        "fps": Fraction(30000, 1001),
        "height": HEIGHT,
        "width": WIDTH,
        "world_from_camera": np.tile(np.eye(4), (FRAMES, 1, 1)),
        "intrinsics_px": INTRINSICS,
        "metric": True,
        "joints_m": joints,
        "depth": DepthFiles(paths=(None, *5 * [tmp_path / "depth.npy"]), unit_m=1e-3),
        "points": ScenePoints(
            points_m=np.ones((4, 3), np.float32),
            colors=np.full((4, 3), 9, np.uint8),
            error_px=np.full(4, 0.5, np.float32),
            frames=np.array([0, 5], np.int32),
            indices=np.array([1, 3], np.int32),
            pixels_px=np.ones((2, 2), np.float32),
        ),
        "caption": "Fold the towel.",
        "names": ("towel",),
        "provenance": {"dataset": "test"},
    }
    return Recording(**{**fields, **changes})


def assert_same(one, other):
    assert type(one) is type(other)
    for name in one.__dataclass_fields__:
        have, want = getattr(one, name), getattr(other, name)
        if hasattr(want, "__dataclass_fields__"):
            assert_same(have, want)
        elif isinstance(want, np.ndarray):
            np.testing.assert_array_equal(have, want)
        else:
            assert have == want


def test_a_saved_recording_is_loaded_unchanged(tmp_path):
    recording = make_recording(tmp_path)
    recording.save(tmp_path / "out")
    assert_same(Recording.load(tmp_path / "out"), recording)


def test_unknown_parts_stay_none(tmp_path):
    unknown = dict.fromkeys(
        ("world_from_camera", "intrinsics_px", "joints_m", "depth", "points", "caption")
    )
    recording = make_recording(tmp_path, **unknown, metric=False, names=())
    recording.save(tmp_path / "out")
    assert_same(Recording.load(tmp_path / "out"), recording)


def test_a_folder_with_its_video_can_be_moved(tmp_path):
    make_recording(tmp_path).save(tmp_path)
    moved = tmp_path.rename(tmp_path.with_name(f"{tmp_path.name}_moved"))
    assert len(Recording.load(moved).read_frames().frames) == FRAMES


def test_frames_are_counted_from_the_start_of_the_recording(tmp_path):
    video = make_recording(tmp_path).read_frames(1, 3)
    assert video.frames.mean(axis=(1, 2, 3)) == pytest.approx([80, 100], abs=2)
    assert video.fps == Fraction(30000, 1001)


def test_frames_of_another_size_than_recorded_are_refused(tmp_path):
    recording = make_recording(tmp_path, height=26, depth=None)
    with pytest.raises(InputError, match="32x24: the recording says 32x26"):
        recording.read_frames()


def test_depth_is_enlarged_and_unknown_depth_is_infinite(tmp_path):
    values = np.array([[1000, 0], [2000, 3000]], np.uint16)
    path = tmp_path / "depth.npy"
    recording = make_recording(tmp_path)
    np.save(path, values)
    depth = recording.read_depth(1)
    assert depth.shape == (HEIGHT, WIDTH)
    assert depth[0, 0] == depth[11, 15] == 1
    assert depth[12, 0] == 2
    assert depth[-1, -1] == pytest.approx(3)
    assert np.isinf(depth[0, 16])
    assert recording.read_depth(0) is None


def test_a_clip_keeps_what_belongs_to_its_frames(tmp_path):
    clip = make_recording(tmp_path).clip(1, 6)
    assert (clip.start, clip.frames, len(clip.depth.paths)) == (4, 5, 5)
    assert np.isfinite(clip.joints_m[:, 1]).all()
    assert clip.points.frames.tolist() == [4]
    assert clip.points.indices.tolist() == [3]


def test_a_clip_has_no_hand_that_comes_into_view_only_later(tmp_path):
    joints = make_recording(tmp_path).joints_m.copy()
    joints[:4, 0] = make_hand() + [9, 0, 0]
    joints[4:, 0] = make_hand()
    recording = make_recording(tmp_path, joints_m=joints)
    clip = recording.clip(0, 3)
    assert np.isnan(clip.joints_m[:, 0]).all()
    assert np.isfinite(clip.joints_m[1:, 1]).all()
    assert np.isfinite(recording.joints_m[:, 0]).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"recording_id": "../12"}, "not a valid file name"),
        ({"frames": 0}, "at least 1"),
        ({"start": 1 << 20}, "must be below"),
        ({"fps": Fraction(0)}, "above 0"),
        ({"world_from_camera": np.tile(np.eye(4), (5, 1, 1))}, "one pose per frame"),
        ({"world_from_camera": np.full((FRAMES, 4, 4), np.nan)}, "frame 0 is not a rigid"),
        ({"intrinsics_px": INTRINSICS.T}, "implausible"),
        ({"joints_m": np.full((FRAMES, 2, 25, 3), np.nan)}, "21, 3"),
        ({"metric": False}, "in meters"),
        ({"intrinsics_px": None, "joints_m": np.ones((FRAMES, 2, 21, 3))}, "m large"),
        ({"depth": DepthFiles(paths=(None,), unit_m=1.0)}, "one path or None"),
        ({"caption": "x" * 20_000}, "at most 10,000 characters"),
    ],
)
def test_an_invalid_part_is_refused(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        make_recording(tmp_path, **changes)


def test_hands_that_never_come_near_the_view_are_refused(tmp_path):
    joints = np.broadcast_to(make_hand(-0.5), (FRAMES, 1, 21, 3)).copy()
    with pytest.raises(InputError, match="comes near the view"):
        make_recording(tmp_path, joints_m=joints)


@pytest.mark.parametrize(
    "changes",
    [
        {"points_m": np.full((4, 3), np.inf, np.float32)},
        {"points_m": np.ones((4, 3))},
        {"points_m": np.float32(1)},
        {"indices": np.array([1, 4], np.int32)},
        {"pixels_px": None},
    ],
)
def test_invalid_points_are_refused(tmp_path, changes):
    points = make_recording(tmp_path).points
    with pytest.raises(InputError):
        replace(points, **changes)


def test_a_changed_or_hostile_description_is_refused(tmp_path):
    recording = make_recording(tmp_path)
    for old, new, message in (
        ('"version": 1', '"version": 2', "version 2"),
        ('"video": "video.mp4"', '"video": "../../etc/video.mp4"', r"'\.\.'"),
        ('"frames": 6', '"frames": 1e9', "expected int"),
        ('"fps": "30000/1001"', '"fps": "1/0"', "fps"),
        ('"fps": "30000/1001"', '"fps": "1e999999999"', "fps"),
        ('"unit_m": 0.001', '"unit_m": null', "depth"),
    ):
        recording.save(tmp_path)
        path = tmp_path / "recording.json"
        text = path.read_text()
        assert old in text
        with atomic_write(path) as temporary:
            temporary.write_text(text.replace(old, new))
        with pytest.raises(InputError, match=message):
            Recording.load(tmp_path)
    recording.save(tmp_path)
    (tmp_path / "arrays.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="SHA-256"):
        Recording.load(tmp_path)


@pytest.mark.parametrize(
    "data",
    [
        b"\x93NUMPY\x01\x00\x76\x00{'descr': '<f8', 'fortran_order': False, 'shape': (9, 9), }",
        b"\x89PNG\r\n\x1a\nnothing",
        b"",
    ],
)
def test_a_damaged_depth_map_is_refused(tmp_path, data):
    for suffix in (".npy", ".png"):
        (tmp_path / f"0{suffix}").write_bytes(data)
        with pytest.raises(InputError, match="not a depth map"):
            read_depth_image(tmp_path / f"0{suffix}")
