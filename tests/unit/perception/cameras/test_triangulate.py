"""Points from given cameras."""

from dataclasses import replace

import numpy as np

from egosim_jax.perception.cameras.triangulate import triangulate
from tests.unit.perception.cameras import room


def test_points_are_on_the_walls_of_the_room():
    cameras = room.path(9, move=np.array([0.4, 0.0, 0.1]))
    frames = room.render(cameras)
    points = triangulate(frames, np.zeros(frames.shape[:3], bool), cameras)
    assert points is not None
    assert len(points.points_m) > 100
    assert np.median(points.error_px) < 0.5
    # The wall in front is at z = 3.5, the floor at y = 1.
    x, y, z = points.points_m.T
    wall = (np.abs(z - 3.5) < 0.6) & (np.abs(x) < 1.5) & (y < -0.5)
    assert wall.sum() > 20
    assert np.abs(np.median(z[wall]) - 3.5) < 0.05


def test_a_turning_camera_gives_no_points():
    cameras = room.path(9, turn_deg=np.array([0.0, 8.0, 0.0]))
    frames = room.render(cameras)
    assert triangulate(frames, np.zeros(frames.shape[:3], bool), cameras) is None


def test_moving_pixels_give_no_points():
    cameras = room.path(9, move=np.array([0.4, 0.0, 0.1]))
    frames = room.render(cameras)
    moving = np.zeros(frames.shape[:3], bool)
    moving[:, :, 160:] = True
    points = triangulate(frames, moving, cameras)
    assert points is not None
    assert points.pixels_px[:, 0].max() < 160


def test_the_unit_is_that_of_the_cameras():
    cameras = room.path(9, move=np.array([0.4, 0.0, 0.1]))
    frames = room.render(cameras)
    poses = cameras.world_from_camera.copy()
    poses[:, :3, 3] *= 10
    still = np.zeros(frames.shape[:3], bool)
    small, large = (
        triangulate(frames, still, c) for c in (cameras, replace(cameras, world_from_camera=poses))
    )
    assert small is not None
    assert large is not None
    assert np.allclose(large.points_m, 10 * small.points_m)
