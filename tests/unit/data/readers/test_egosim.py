"""Clips of EgoSim's data preparation."""

import json

import numpy as np
import pytest

from egosim_jax.data.readers.egosim import EgoSimClips
from egosim_jax.data.readers.hamer import place_hand
from egosim_jax.geometry import invert, transform
from egosim_jax.types import Cameras


def write_clip(folder, world, *, poses="poses_da3"):
    world.write_video(folder / "video_16fps.mp4", fps=16)
    target = folder / "_proc" / poses / folder.name
    target.mkdir(parents=True)
    for frame, matrix in enumerate(invert(world.poses)):
        np.save(target / f"extrinsics_{frame:06d}.npy", matrix.astype(np.float32))
        np.save(target / f"intrinsics_{frame:06d}.npy", world.intrinsics.astype(np.float32))
    np.save(target / "depth_000000.npy", np.full((world.height, world.width), 0.7, np.float32))
    (folder / "caption.txt").write_text("A person folds a towel.\n")
    return target


def test_smoothed_poses_are_preferred(world, tmp_path, imported):
    write_clip(tmp_path / "fold_1", world)
    raw = world.poses.copy()
    world.poses[:, 0, 3] += 0.01
    write_clip(tmp_path / "fold_1", world, poses="poses_da3_smoothed")
    recording = imported(EgoSimClips(source=tmp_path / "fold_1"))[0]["fold_1"]
    np.testing.assert_allclose(recording.world_from_camera, raw + world.poses - raw, atol=1e-6)
    assert "smoothed" in recording.provenance["poses"]


@pytest.mark.parametrize(("absent", "frames"), [(11, 11), (4, 4)])
def test_frames_are_read_until_the_first_one_without_a_pose(
    world, tmp_path, imported, caplog, absent, frames
):
    target = write_clip(tmp_path / "fold_1", world)
    (target / f"extrinsics_{absent:06d}.npy").unlink()
    recording = imported(EgoSimClips(source=tmp_path / "fold_1"))[0]["fold_1"]
    assert recording.frames == frames
    np.testing.assert_allclose(recording.world_from_camera, world.poses[:frames], atol=1e-6)
    assert "12 frames and 11 extrinsics" in caplog.text


@pytest.mark.parametrize("kept", [0, 3])
def test_frames_without_intrinsics_have_the_ones_of_the_others(world, tmp_path, imported, kept):
    target = write_clip(tmp_path / "fold_1", world)
    write_hands(tmp_path / "fold_1", world)
    for path in sorted(target.glob("intrinsics_*.npy"))[kept:]:
        path.unlink()
    recording = imported(EgoSimClips(source=tmp_path / "fold_1"))[0]["fold_1"]
    np.testing.assert_allclose(recording.world_from_camera, world.poses, atol=1e-6)
    assert (recording.intrinsics_px is None) == (recording.joints_m is None) == (not kept)


def test_poses_of_another_rate_are_refused(world, tmp_path, imported):
    target = write_clip(tmp_path / "fold_1", world)
    for number in range(6, 12):
        (target / f"extrinsics_{number:06d}.npy").unlink()
    problem = imported(EgoSimClips(source=tmp_path / "fold_1"))[1]["fold_1"]
    assert "6 extrinsics, as at 8 frames per second" in problem
    assert "ffmpeg -i IN -vf fps=8 OUT" in problem


def test_a_clip_without_poses_keeps_video_and_caption(world, tmp_path, imported, caplog):
    target = write_clip(tmp_path / "fold_1", world)
    write_hands(tmp_path / "fold_1", world)
    for path in target.glob("extrinsics_*.npy"):
        path.unlink()
    recording = imported(EgoSimClips(source=tmp_path / "fold_1"))[0]["fold_1"]
    assert (recording.world_from_camera, recording.joints_m) == (None, None)
    assert recording.caption == "A person folds a towel."
    assert recording.frames == world.frames
    world.assert_first(recording)
    assert "cameras and hands stay unknown" in caplog.text


@pytest.mark.parametrize(
    ("change", "fps"),
    [
        (lambda frames: frames[:6], 8),
        (lambda frames: frames[:9], 12),
        (lambda frames: [*frames[:5], {"frame_idx": 5, "hands": []}], 8),
        (lambda frames: frames[:11], None),
        (lambda frames: frames[::2], None),
        (lambda frames: frames[4:8], None),
        (lambda frames: [f for f in frames if f["frame_idx"] != 3], None),
    ],
)
def test_hands_of_another_rate_are_refused(world, tmp_path, imported, change, fps):
    """A list of all frames has the video's length; a list of the frames with hands has gaps."""
    write_clip(tmp_path / "fold_1", world)
    write_hands(tmp_path / "fold_1", world)
    path = tmp_path / "fold_1/_proc/mano_full/video.json"
    frames = change(json.loads(path.read_text())["frames"])
    path.write_text(json.dumps({"video_id": "video", "frames": frames}))
    done, problems = imported(EgoSimClips(source=tmp_path / "fold_1"))
    if fps is not None:
        assert f"as at {fps} frames per second instead of 16" in problems["fold_1"]
        assert "Run HaMeR on the same video" in problems["fold_1"]
        return
    found = np.isfinite(done["fold_1"].joints_m).all(axis=(1, 2, 3))
    assert np.flatnonzero(found).tolist() == [frame["frame_idx"] for frame in frames]


def write_hands(folder, world, **changes):
    """HaMeR's result for the scene's hands, in its own camera of another focal length."""
    focal = 5000 / 256 * max(world.width, world.height)
    local = transform(invert(world.poses[:, None]), world.joints)
    frames = []
    for frame in range(world.frames):
        hands = []
        for side in range(2):
            points = local[frame, side] - local[frame, side].mean(axis=0)
            center = local[frame, side].mean(axis=0)
            depth = center[2] * focal / world.intrinsics[0, 0]
            place = [*center[:2].tolist(), depth]
            hands.append({
                "is_right": side, "confidence": 0.9, "cam_t_full": place,
                "keypoints_3d": (points * [2 * side - 1, 1, 1]).tolist(), **changes,
            })  # fmt: skip
        frames.append({"frame_idx": frame, "hands": hands})
    path = folder / "_proc/mano_full/video.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"video_id": "video", "frames": frames}))


def test_hands_of_hamer_are_placed_where_both_cameras_see_them(world, tmp_path, imported):
    """Weak perspective keeps pixels to a few percent of a hand, which gives the position."""
    write_clip(tmp_path / "fold_1", world)
    write_hands(tmp_path / "fold_1", world)
    joints = imported(EgoSimClips(source=tmp_path / "fold_1"))[0]["fold_1"].joints_m
    center, expected = joints.mean(axis=2), world.joints.mean(axis=2)
    np.testing.assert_allclose(center, expected, atol=0.02)
    np.testing.assert_allclose(
        joints - center[:, :, None], world.joints - expected[:, :, None], atol=1e-6
    )


def test_a_hand_is_placed_exactly_where_its_pixels_are():
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (21, 3))
    focal = 5000 / 256 * 640
    place = np.array([0.1, -0.05, 0.5])
    same = Cameras(
        world_from_camera=np.eye(4)[None],
        intrinsics_px=np.array([[focal, 0, 319.5], [0, focal, 239.5], [0, 0, 1]]),
        height=480,
        width=640,
    )
    np.testing.assert_allclose(place_hand(points, place, same), points + place, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"keypoints_3d": [[0, 0, 0]] * 20}, "keypoints_3d"),
        ({"cam_t_full": [0, 0, float("nan")]}, "not finite"),
        ({"cam_t_full": [0, 0, -1]}, "behind"),
        ({"is_right": None}, "is_right"),
    ],
)
def test_hostile_hands_are_refused(world, tmp_path, imported, changes, message):
    write_clip(tmp_path / "fold_1", world)
    write_hands(tmp_path / "fold_1", world, **changes)
    assert message in imported(EgoSimClips(source=tmp_path / "fold_1"))[1]["fold_1"]
