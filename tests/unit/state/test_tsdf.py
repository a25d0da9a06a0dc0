"""Surfaces of shapes whose depth a formula gives."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from scipy.spatial import cKDTree

from egosim_jax.geometry import look_at, pixel_rays
from egosim_jax.state.tsdf import Fusion, surface, valid_depth_mask
from egosim_jax.types import InputError
from tests.scenes import pinhole

HEIGHT, WIDTH = 120, 200
UP = np.array([0.0, 0.0, 1.0])


def cameras(count=9):
    turns = np.linspace(0, 2 * np.pi, count)
    eyes = [np.array([0.1 * np.sin(a), -0.12 + 0.05 * np.cos(a), 0.46]) for a in turns]
    poses = [look_at(e, np.array([0.01, 0.28, 0.03]), up=UP) for e in eyes]
    return pinhole(poses, 150.0, HEIGHT, WIDTH)


def rays(cameras, frame):
    pose = cameras.world_from_camera[frame]
    directions = pixel_rays(cameras.intrinsics_px, height=HEIGHT, width=WIDTH)
    return pose[:3, 3], directions @ pose[:3, :3].T


def plane(origin, directions):
    with np.errstate(divide="ignore"):
        return np.where(directions[..., 2] < 0, (0.004 - origin[2]) / directions[..., 2], np.inf)


CENTER, RADIUS = np.array([0.02, 0.3, 0.06]), 0.11


def sphere(origin, directions):
    offset = origin - CENTER
    a, b = (directions**2).sum(axis=-1), directions @ offset
    inside = b**2 - a * (offset @ offset - RADIUS**2)
    return np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)


LOW, HIGH = np.array([-0.1, 0.2, 0.0]), np.array([0.12, 0.4, 0.1])


def box(origin, directions):
    """The slab method: the last of the three entries, if before the first of the three exits."""
    with np.errstate(divide="ignore"):
        first, second = (LOW - origin) / directions, (HIGH - origin) / directions
    enter = np.minimum(first, second).max(axis=-1)
    leave = np.maximum(first, second).min(axis=-1)
    return np.where(enter < leave, enter, np.inf)


def to_plane(points):
    return np.abs(points[:, 2] - 0.004)


def to_sphere(points):
    return np.abs(np.linalg.norm(points - CENTER, axis=1) - RADIUS)


def to_box(points):
    outside = np.linalg.norm(np.maximum(np.maximum(LOW - points, points - HIGH), 0), axis=1)
    inside = np.minimum(points - LOW, HIGH - points).min(axis=1)
    return np.where(outside > 0, outside, np.abs(inside))


@pytest.mark.parametrize(
    ("depth", "distance"), [(plane, to_plane), (sphere, to_sphere), (box, to_box)]
)
def test_points_lie_within_half_a_voxel_of_the_true_surface(depth, distance):
    path = cameras()
    depths = np.stack([depth(*rays(path, k)) for k in range(9)]).astype(np.float32)
    depths = np.where(valid_depth_mask(depths), depths, 0)
    colors = np.full((9, HEIGHT, WIDTH, 3), (10, 200, 77), np.uint8)
    points, shades = surface(depths, colors, path, fusion=Fusion())
    assert len(points) > 5000
    errors = distance(points.astype(np.float64))
    assert np.mean(errors <= Fusion().voxel_m / 2) >= 0.95, np.percentile(errors, [50, 90, 95])
    assert (shades == (10, 200, 77)).all()


def test_the_whole_surface_that_is_seen_has_points():
    path = cameras()
    depths = np.stack([plane(*rays(path, k)) for k in range(9)]).astype(np.float32)
    colors = np.zeros((9, HEIGHT, WIDTH, 3), np.uint8)
    points, _ = surface(depths, colors, path, fusion=Fusion())
    grid = np.stack(np.meshgrid(np.arange(-0.1, 0.1, 0.01), np.arange(0.15, 0.4, 0.01)), axis=-1)
    gaps, _ = cKDTree(points[:, :2]).query(grid.reshape(-1, 2))
    assert gaps.max() <= 0.003


def test_unknown_and_far_depths_leave_no_points():
    path = cameras(3)
    for value in (0.0, np.inf, np.nan, 3.5):
        depths = np.full((3, HEIGHT, WIDTH), value, np.float32)
        points, shades = surface(
            depths, np.zeros((3, HEIGHT, WIDTH, 3), np.uint8), path, fusion=Fusion()
        )
        assert points.shape == shades.shape == (0, 3)


def test_a_surface_that_too_few_frames_observe_has_no_points():
    pose = np.repeat(np.eye(4)[None], 3, axis=0)
    pose[:, 0, 3] = 0, 5, 10
    path = replace(cameras(3), world_from_camera=pose)
    depths = np.full((3, HEIGHT, WIDTH), 0.5, np.float32)
    colors = np.zeros((3, HEIGHT, WIDTH, 3), np.uint8)
    for observations, has in ((1, True), (2, False)):
        fusion = Fusion(voxel_m=0.01, observations=observations)
        points, shades = surface(depths, colors, path, fusion=fusion)
        assert points.shape == shades.shape == (len(points), 3)
        assert (len(points) > 0) == has


@pytest.mark.parametrize("unknown", [0.0, np.inf, np.nan, -1.0])
def test_valid_depth_of_random_images_is_that_of_scipys_filters(unknown):
    rng = np.random.default_rng(0)
    depth = rng.normal(1, 0.025, (9, 23, 31)).astype(np.float32)
    known = rng.random(depth.shape) < 0.97
    depth[~known] = unknown
    near = ndimage.minimum_filter(np.where(known, depth, np.inf), (1, 5, 5), mode="nearest")
    far = ndimage.maximum_filter(np.where(known, depth, 0), (1, 5, 5), mode="nearest")
    valid = known & (far - near < 0.1 * np.where(known, depth, 1))
    assert 0.1 < valid.mean() < 0.9
    np.testing.assert_array_equal(valid_depth_mask(depth), valid)


def test_depth_is_invalid_at_an_edge_and_next_to_unknown_depth():
    depth = np.full((1, 12, 20), 1.0, np.float32)
    depth[0, :, 10:] = 0.8
    depth[0, 5, 3] = np.nan
    (found,) = valid_depth_mask(depth)
    assert not found[:, 8:12].any()
    assert not found[5, 3]
    assert found[:3, :7].all()
    assert found[:, 13:].all()


@pytest.mark.parametrize(
    "sizes", [{"voxel_m": 0.0}, {"truncation_m": 0.001}, {"max_depth_m": -1.0}]
)
def test_sizes_that_make_no_surface_are_refused(sizes):
    with pytest.raises(InputError, match="Invalid fusion parameters"):
        Fusion(**sizes)
