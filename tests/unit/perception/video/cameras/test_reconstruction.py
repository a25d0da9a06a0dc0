"""Structure from motion on a rendered room versus its known cameras."""

from functools import cache

import numpy as np
import pytest

from egosim_jax.geometry import invert, project, transform, umeyama
from egosim_jax.perception.video.cameras import CameraLadder, ColmapConfig
from egosim_jax.perception.video.estimates import CameraEstimate, Lens, Rung
from egosim_jax.types import Cameras
from tests.unit.perception.video.cameras.room import FOCAL, path, render

pytest.importorskip("pycolmap")
pytestmark = pytest.mark.slow

MOVE, TURN = np.array([0.6, 0.05, 0.15]), np.array([2.0, 9.0, -1.0])
LENS = Lens(focal_px=FOCAL, radial=0.06)
CAMERAS = path(24, move=MOVE, turn_deg=TURN)
ONE_THREAD = ColmapConfig(threads=1, features=1024)


@cache
def room(radial: bool) -> np.ndarray:
    return render(CAMERAS, lens=LENS if radial else None)


@cache
def estimate(rung: Rung | None, radial: bool) -> CameraEstimate:
    frames = room(radial)
    focal = FOCAL if rung in ("focal", "global") else None
    ladder = CameraLadder(rung=rung, colmap=ONE_THREAD, focal_px=focal)
    return ladder(frames, np.zeros(frames.shape[:3], bool))


def errors(found: CameraEstimate, cameras: Cameras) -> tuple[float, float]:
    """Return the largest error of position, in path lengths, and of rotation in degrees."""
    assert found.cameras is not None
    have, want = found.cameras.world_from_camera, cameras.world_from_camera
    fit = umeyama(have[:, :3, 3], want[:, :3, 3], scaled=True)
    moved = transform(fit, have[:, :3, 3])
    length = np.linalg.norm(want[-1, :3, 3] - want[0, :3, 3])
    relative = have[:, :3, :3].swapaxes(1, 2) @ want[:, :3, :3]
    cosine = (np.trace(relative, axis1=1, axis2=2) - 1) / 2
    angle = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    gap = np.linalg.norm(moved - want[:, :3, 3], axis=1)
    return float(gap.max() / length), float(angle.max())


@pytest.mark.parametrize("rung", [None, "focal", "global"])
def test_paths_are_those_of_the_room(rung: Rung | None) -> None:
    found = estimate(rung, False)
    assert found.verdict.rung == (rung or "incremental")
    assert not found.metric
    position, angle = errors(found, CAMERAS)
    assert position < 0.02
    assert angle < 0.3
    assert found.verdict.figures[f"{found.verdict.rung}_focal_px"] == pytest.approx(FOCAL, rel=0.02)


def test_the_world_is_the_first_camera_and_its_unit_the_median_depth() -> None:
    found = estimate(None, False)
    assert found.cameras is not None
    assert found.points is not None
    assert found.cameras.world_from_camera[0] == pytest.approx(np.eye(4), abs=1e-9)
    seen = found.points.indices[found.points.frames == 0]
    assert np.median(found.points.points_m[seen, 2]) == pytest.approx(1)


@pytest.mark.parametrize("radial", [False, True])
def test_points_project_to_their_undistorted_pixels(radial: bool) -> None:
    found = estimate(None, radial)
    cameras, points = found.cameras, found.points
    assert cameras is not None
    assert points is not None
    inside = transform(
        invert(cameras.world_from_camera)[points.frames], points.points_m[points.indices][:, None]
    )
    columns, rows = project(cameras.intrinsics_px, inside[:, 0])
    gap = np.stack([columns, rows], axis=-1) - points.pixels_px
    assert np.median(np.linalg.norm(gap, axis=1)) < 0.5
    assert np.abs(np.median(gap, axis=0)).max() < 0.05


def test_a_radial_lens_is_found_and_removed() -> None:
    found = estimate(None, True)
    assert found.verdict.rung == "incremental"
    assert found.lens is not None
    assert found.lens.radial == pytest.approx(LENS.radial, abs=0.01)
    assert found.lens.focal_px == pytest.approx(FOCAL, rel=0.02)
    position, angle = errors(found, CAMERAS)
    assert position < 0.02
    assert angle < 0.3


def test_one_thread_gives_the_same_result_twice() -> None:
    first = estimate(None, False)
    frames = room(False)
    second = CameraLadder(colmap=ONE_THREAD)(frames, np.zeros(frames.shape[:3], bool))
    assert second.verdict == first.verdict
    assert first.cameras is not None
    assert second.cameras is not None
    assert (first.cameras.world_from_camera == second.cameras.world_from_camera).all()


def test_black_frames_and_skipped_images_are_interpolated() -> None:
    frames = room(False).copy()
    frames[[9, 10]] = 0
    ladder = CameraLadder(colmap=ONE_THREAD, max_images=22, rung="incremental")
    found = ladder(frames, np.zeros(frames.shape[:3], bool))
    assert found.verdict.rung == "incremental"
    assert "frames interpolated" in found.verdict.reason
    position, angle = errors(found, CAMERAS)
    assert position < 0.05
    assert angle < 0.6


def test_moving_pixels_are_not_used() -> None:
    frames, moving = room(False).copy(), np.zeros((24, 240, 320), bool)
    noise = render(path(1), seed=3)[0]
    for frame in range(24):
        frames[frame, 100:, 3 * frame : 3 * frame + 150] = noise[100:, :150]
        moving[frame, 95:, max(0, 3 * frame - 5) : 3 * frame + 155] = True
    found = CameraLadder(colmap=ONE_THREAD)(frames, moving)
    assert found.verdict.rung == "incremental"
    position, angle = errors(found, CAMERAS)
    assert position < 0.05
    assert angle < 0.6
