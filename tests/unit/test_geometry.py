"""Cameras and rigid transforms, each against an independent formula."""

import numpy as np
import pytest

from egosim_jax.geometry import (
    invert,
    look_at,
    pixel_rays,
    pixels_of,
    project,
    rotation_z,
    transform,
    upsample_intrinsics,
)
from egosim_jax.types import Cameras

INTRINSICS = np.array([[50.0, 0, 15.3], [0, 48.0, 11.1], [0, 0, 1]])


def pose():
    rng = np.random.default_rng(0)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, rng.normal(size=3)
    return matrix


def test_a_motion_and_its_inverse_leave_points_where_they_were():
    points = np.random.default_rng(1).normal(size=(5, 3))
    np.testing.assert_allclose(invert(pose()), np.linalg.inv(pose()), atol=1e-12)
    there = transform(pose(), points)
    homogeneous = np.concatenate([points, np.ones((5, 1))], axis=1)
    np.testing.assert_allclose(there, (homogeneous @ pose().T)[:, :3])


def test_a_pixels_ray_projects_to_its_center():
    rays = 2.5 * pixel_rays(INTRINSICS, height=4, width=6).reshape(-1, 3)
    columns, rows = project(INTRINSICS, rays)
    np.testing.assert_allclose(columns, np.tile(np.arange(6), 4), atol=1e-12)
    np.testing.assert_allclose(rows, np.repeat(np.arange(4), 6), atol=1e-12)


@pytest.mark.parametrize("times", [2, 3])
def test_the_parts_of_a_pixel_surround_its_center(times):
    coarse = pixel_rays(INTRINSICS, height=4, width=6)
    parts = pixel_rays(upsample_intrinsics(INTRINSICS, times), height=4 * times, width=6 * times)
    means = parts.reshape(4, times, 6, times, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(means, coarse, atol=1e-12)


def test_a_quarter_turn_takes_x_to_y():
    np.testing.assert_allclose(rotation_z(np.pi / 2) @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_a_camera_that_looks_at_a_point_has_it_in_the_middle_and_up_above():
    eye, target, up = np.array([1.0, -2, 3]), np.array([0.5, 0.5, 0]), np.array([0.0, 0, 1])
    world_from_camera = look_at(eye, target, up=up)
    local = transform(invert(world_from_camera), np.stack([target, target + 0.1 * up]))
    np.testing.assert_allclose(local[0], [0, 0, np.linalg.norm(target - eye)], atol=1e-12)
    assert local[1, 1] < 0
    assert local[1, 0] == pytest.approx(0)
    assert np.linalg.det(world_from_camera[:3, :3]) == pytest.approx(1)


def test_points_fall_into_the_pixels_whose_squares_they_are_in():
    cameras = Cameras(
        world_from_camera=np.eye(4)[None],
        intrinsics_px=np.array([[10.0, 0, 2], [0, 10, 1], [0, 0, 1]]),
        height=3,
        width=5,
    )
    u, v, z = np.array(
        [[0, 0, 1], [4.49, 2.49, 2], [-0.49, -0.49, 3], [4.51, 1, 1], [2, -0.51, 1], [2, 1, -1]]
    ).T
    points = np.stack([(u - 2) / 10 * z, (v - 1) / 10 * z, z], axis=-1)
    row, column, inside = pixels_of(cameras, np.concatenate([points, np.zeros((1, 3))]))
    assert inside.tolist() == [True, True, True, False, False, False, False]
    assert row[inside].tolist() == [0, 2, 0]
    assert column[inside].tolist() == [0, 4, 0]
