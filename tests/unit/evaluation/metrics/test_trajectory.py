"""Camera errors of ground-truth frames, in order and exchanged."""

import numpy as np
import pytest

from egosim_jax.evaluation.metrics.trajectory import camera_errors, estimate_cameras, path_errors
from egosim_jax.geometry import look_at
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence
from egosim_jax.worlds.tabletop.scene import FIRST_HAND


def path(count=5):
    eyes = [np.array([0.1 * k, -0.4, 0.5]) for k in range(count)]
    return np.stack([look_at(eye, np.zeros(3), up=np.array([0, 0, 1.0])) for eye in eyes])


def test_position_and_rotation_errors_are_root_mean_squares():
    found = path()
    found[2, :3, 3] += found[2, :3, :3] @ [0, 0, 0.06]
    meters, degrees = camera_errors(found, path())
    assert meters == pytest.approx(0.06 / np.sqrt(5))
    assert degrees == pytest.approx(0, abs=1e-5)
    found = path()
    turn = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    found[3, :3, :3] = found[3, :3, :3] @ turn
    assert camera_errors(found, path())[1] == pytest.approx(90 / np.sqrt(5))


def test_lost_frames_do_not_count():
    found = path()
    found[1] = np.nan
    np.testing.assert_allclose(camera_errors(found, path()), (0, 0), atol=1e-5)
    assert np.isnan(camera_errors(np.full((5, 4, 4), np.nan), path())).all()


@pytest.fixture(scope="module")
def clip():
    return next(make_sequence(5, spec=VideoSpec(frames=9, height=96, width=160, fps=8)))


def still(clip):
    return ~((clip.ids >= FIRST_HAND) | (clip.ids == clip.body_ids[clip.target]))


def test_a_video_from_elsewhere_has_the_cameras_there(clip):
    """Each frame replaces the previous frame."""
    late = np.concatenate([clip.frames[1:], clip.frames[-1:]])
    truth = clip.cameras.world_from_camera
    found = estimate_cameras(late, clip.frames, clip.depth_m, still(clip), clip.cameras)[:-1]
    moved, _ = camera_errors(truth[1:], truth[:-1])
    off, _ = camera_errors(found, truth[1:])
    assert off < 2 / 3 * moved
    assert moved > 0.01


def test_a_video_without_features_has_no_cameras(clip):
    gray = np.full_like(clip.frames, 128)
    found = estimate_cameras(
        clip.frames, gray, clip.depth_m, np.zeros_like(still(clip)), clip.cameras
    )
    assert np.isnan(found).all()


def test_a_path_of_another_scale_and_world_has_no_error():
    world = look_at(np.array([3.0, 1.0, 2.0]), np.zeros(3), up=np.array([0, 0, 1.0]))
    found = path()
    found[:, :3, 3] *= 2.5
    np.testing.assert_allclose(path_errors(world @ found, path()), 0, atol=1e-5)


def test_the_rotation_error_of_a_path_is_that_of_each_turn():
    found = path()
    turn = np.array([[0, -1.0, 0], [1, 0, 0], [0, 0, 1]])
    found[3, :3, :3] = found[3, :3, :3] @ turn
    assert path_errors(found, path()).rotation_deg == pytest.approx(90 / np.sqrt(5), abs=1e-4)


def line(*meters, axis=0):
    poses = np.tile(np.eye(4), (len(meters), 1, 1))
    poses[:, axis, 3] = meters
    return poses


def test_paths_at_right_angles_have_known_errors():
    errors = path_errors(line(0, 1.0, 2.0, axis=1), line(0, 3.0, 6.0))
    assert errors.rotation_deg == 0
    # Divided by their extents, positions are 0, 1/2 and 1 along two axes.
    assert errors.translation == pytest.approx(np.sqrt((0.5 + 2.0) / 3))
    # No scale brings them closer than the origin is.
    assert errors.ate == pytest.approx(np.sqrt((9.0 + 36.0) / 3))


def test_a_camera_that_stays_is_off_by_the_extent_of_the_path():
    errors = path_errors(line(0, 0, 0), line(0, 3.0, 6.0))
    assert errors.ate == pytest.approx(np.sqrt((9.0 + 36.0) / 3))
    assert errors.translation == pytest.approx(np.sqrt((0.25 + 1.0) / 3))


def test_jitter_of_a_camera_is_no_path():
    jitter = np.tile(np.eye(4), (5, 1, 1))
    jitter[1:, :3, 3] = 1e-6 * np.random.default_rng(0).normal(size=(4, 3))
    still = np.tile(np.eye(4), (5, 1, 1))
    assert path_errors(jitter, still).translation < 1e-5
    assert path_errors(jitter, jitter[[0, 2, 1, 4, 3]]).translation < 1e-5
