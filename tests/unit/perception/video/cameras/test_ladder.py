"""Rungs without structure from motion, refusals and options, on a rendered room."""

import numpy as np
import pytest

from egosim_jax.perception.video.cameras import CameraLadder
from egosim_jax.perception.video.estimates import CameraEstimate, CameraEstimator, Rung
from egosim_jax.types import Cameras, InputError
from tests.unit.perception.video.cameras.room import FOCAL, path, render

LADDER = CameraLadder()
ROTATION = CameraLadder(rung="rotation", focal_px=FOCAL)
TURN = np.array([3.0, -8.0, 2.0])


def estimate(ladder: CameraLadder, frames: np.ndarray) -> CameraEstimate:
    return ladder(frames, np.zeros(frames.shape[:3], bool))


def noisy(frames: np.ndarray) -> np.ndarray:
    noise = np.random.default_rng(0).normal(0, 2, frames.shape)
    return np.clip(frames + noise, 0, 255).astype(np.uint8)


def angles_deg(found: CameraEstimate, cameras: Cameras) -> np.ndarray:
    assert found.cameras is not None
    have, want = found.cameras.world_from_camera, cameras.world_from_camera
    relative = have[:, :3, :3].swapaxes(1, 2) @ want[:, :3, :3]
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def test_it_is_an_estimator() -> None:
    assert isinstance(LADDER, CameraEstimator)


@pytest.mark.parametrize("portrait", [False, True])
def test_a_camera_that_does_not_move_is_static(portrait: bool) -> None:
    frames = noisy(np.repeat(render(path(1, portrait=portrait)), 12, axis=0))
    moving = np.zeros(frames.shape[:3], bool)
    for frame in range(12):
        frames[frame, 100:180, 10 * frame : 10 * frame + 80] = 40
        moving[frame, 95:185, max(0, 10 * frame - 5) : 10 * frame + 85] = True
    found = LADDER(frames, moving, focal_px=200.0)
    assert found.verdict.rung == "static"
    assert not found.metric
    assert found.cameras is not None
    assert (found.cameras.world_from_camera == np.eye(4)).all()
    assert found.cameras.intrinsics_px[0, 0] == 200
    assert found.verdict.figures["static_still"] == 1


def test_an_assumed_view_is_recorded() -> None:
    found = estimate(LADDER, noisy(np.repeat(render(path(1)), 4, axis=0)))
    assert found.verdict.figures["static_assumed_view_deg"] == 90
    assert "assumed to be 90 degrees" in found.verdict.reason
    assert found.cameras is not None
    assert found.cameras.intrinsics_px[0, 0] == pytest.approx(160)


def test_rotations_are_found_to_a_twentieth_of_a_degree() -> None:
    cameras = path(15, turn_deg=TURN)
    found = estimate(ROTATION, noisy(render(cameras)))
    assert found.verdict.rung == "rotation"
    assert angles_deg(found, cameras).max() < 0.05
    assert found.verdict.figures["rotation_residual_px"] < 0.3


def test_a_large_turn_is_followed_over_key_frames_and_gives_the_focal_length() -> None:
    cameras = path(16, turn_deg=np.array([0.0, 50.0, 0.0]))
    found = estimate(CameraLadder(rung="rotation"), noisy(render(cameras)))
    assert angles_deg(found, cameras).max() < 0.5
    assert found.verdict.figures["rotation_focal_px"] == pytest.approx(FOCAL, rel=0.02)


def test_a_small_turn_does_not_give_the_focal_length() -> None:
    found = estimate(CameraLadder(rung="rotation"), noisy(render(path(8, turn_deg=TURN / 4))))
    assert found.verdict.figures["rotation_assumed_view_deg"] == 90


def test_a_camera_with_parallax_is_not_a_rotation() -> None:
    frames = render(path(10, move=np.array([0.5, 0.0, 0.0])))
    found = estimate(ROTATION, frames)
    assert found.verdict.figures["rotation_residual_px"] > 1.5


def test_black_frames_between_others_are_interpolated() -> None:
    cameras = path(15, turn_deg=TURN)
    frames = noisy(render(cameras))
    frames[7] = 0
    found = estimate(ROTATION, frames)
    assert found.verdict.figures["blank_frames"] == 1
    assert angles_deg(found, cameras).max() < 0.1


@pytest.mark.parametrize("frame", [5, 11])
def test_a_cut_is_refused_wherever_it_is(frame: int) -> None:
    frames = np.repeat(render(path(1)), 12, axis=0)
    frames[frame:] = render(path(1), seed=1)[0]
    found = estimate(LADDER, noisy(frames))
    assert found.verdict.rung == "refused"
    assert f"a cut: frame {frame} " in found.verdict.reason


@pytest.mark.parametrize("kind", ["black", "blank", "covered"])
def test_videos_without_texture_are_refused(kind: str) -> None:
    frames = noisy(np.repeat(render(path(1)), 8, axis=0))
    moving = np.zeros(frames.shape[:3], bool)
    if kind == "covered":
        moving[:] = True
    else:
        frames[:] = 0 if kind == "black" else 128
    found = LADDER(frames, moving)
    assert found.verdict.rung == "refused"
    assert "too little texture" in found.verdict.reason
    assert found.verdict.figures["blank_frames"] == 8


def test_a_long_video_is_not_reconstructed() -> None:
    frames = render(path(13, move=np.array([0.5, 0.0, 0.0])))
    found = estimate(CameraLadder(max_images=3, rung="incremental"), np.repeat(frames, 2, axis=0))
    assert found.verdict.rung == "refused"
    assert "26 frames are too many" in found.verdict.reason


@pytest.mark.parametrize("rung", ["static", "rotation"])
def test_a_single_frame_has_a_camera(rung: Rung) -> None:
    found = estimate(CameraLadder(rung=rung), render(path(1)))
    assert found.verdict.rung == rung
    assert found.cameras is not None
    assert found.cameras.world_from_camera.tolist() == [np.eye(4).tolist()]


def test_bad_input_is_refused_before_work() -> None:
    frames = render(path(2))
    still = np.zeros(frames.shape[:3], bool)
    with pytest.raises(InputError, match="focal length of 3 pixels is implausible"):
        LADDER(frames, still, focal_px=3.0)
    with pytest.raises(InputError, match="rung focal needs a focal length"):
        CameraLadder(rung="focal")(frames, still)
