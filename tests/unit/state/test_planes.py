"""Support planes of a scene."""

import numpy as np
import pytest

from egosim_jax.geometry import invert, look_at, transform
from egosim_jax.state.planes import fit_plane, support_planes, vertical
from tests.scenes import state_of

UP = np.array([0.0, 0.0, 1.0])


def patch(origin, side, other, count=1500, noise_m=0.001):
    """Points of a rectangle with noise."""
    rng = np.random.default_rng(3)
    where = rng.uniform(size=(count, 2)) @ np.array([side, other], float)
    return np.array(origin, float) + where + rng.normal(0, noise_m, (count, 3))


@pytest.fixture(scope="module")
def room():
    """Larger wall, table, and a shelf above the table; z points up."""
    wall = patch([-1, 1, 0], [2, 0, 0], [0, 0, 2], 6000)
    table = patch([-0.5, 0, 0.7], [1, 0, 0], [0, 0.6, 0], 4000)
    shelf = patch([-0.5, 0.7, 1.2], [1, 0, 0], [0, 0.2, 0])
    box_top = patch([0, 0.2, 0.8], [0.1, 0, 0], [0, 0.08, 0], 300)
    return np.concatenate([wall, table, shelf, box_top])


def test_table_and_shelf_are_support_planes_and_wall_and_box_are_not(room):
    tilted = np.array([0, 0.6, 0.8])  # of a camera that looks down
    table, shelf = support_planes(room, tilted, eye_m=np.array([0, -0.5, 1.6]))
    np.testing.assert_allclose(table.plane, [0, 0, 1, -0.7], atol=0.01)
    np.testing.assert_allclose(shelf.plane, [0, 0, 1, -1.2], atol=0.02)
    assert len(table.inliers) == pytest.approx(4000, rel=0.05)
    assert table.heights(np.array([[0, 0.2, 0.8]])) == pytest.approx(0.1, abs=0.01)


def test_a_point_is_on_one_plane_only():
    table = patch([-0.5, 0, 0.7], [1, 0, 0], [0, 0.6, 0], 4000)
    slanted = patch([-0.2, 0, 0.66], [0.4, 0, 0], [0, 0.6, 0.06], 2000)  # it crosses the table
    one, other = support_planes(np.concatenate([table, slanted]), UP)
    assert not np.intersect1d(one.inliers, other.inliers).size
    assert (other.inliers >= len(table)).mean() > 0.95


def test_two_searches_find_the_same_planes(room):
    first, second = (support_planes(room, UP) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.plane, other.plane)


@pytest.mark.parametrize(("count", "planes"), [(29, 0), (30, 1)])
def test_a_plane_has_at_least_30_points(count, planes):
    flat = patch([0, 0, 0.7], [1, 0, 0], [0, 1, 0], count, noise_m=0)
    assert len(support_planes(flat, UP)) == planes


def test_a_plane_has_its_inliers(room):
    plane, inliers = fit_plane(room[:6000], 0.006)
    assert len(inliers) > 5900
    np.testing.assert_allclose(np.abs(plane[:3]), [0, 1, 0], atol=0.01)


def scene(points_m, **provenance):
    return state_of(points_m, provenance=provenance)


@pytest.mark.parametrize("eye", [[0, -0.5, 1.6], [0.3, -0.4, 2.0], [-0.8, 0.3, 1.2]])
def test_up_is_the_normal_of_the_table_in_any_world(room, eye):
    points = room[6000:]  # table, shelf, and the box on the table
    camera = look_at(np.array(eye), np.array([0, 0.3, 0.7]), up=UP)
    np.testing.assert_allclose(vertical(scene(points), camera), UP, atol=0.01)
    local = transform(invert(camera), points)
    up = vertical(scene(local), np.eye(4))
    np.testing.assert_allclose(camera[:3, :3] @ up, UP, atol=0.01)


def test_up_is_the_nearer_axis_without_a_camera(room):
    points = room[6000:]
    np.testing.assert_array_equal(vertical(scene(points)), UP)
    for steep in (0.3, 0.9):  # a camera's own axes, however much it looks down
        ahead = np.array([0, np.cos(steep), -np.sin(steep)])
        camera = look_at(np.array([0, 0.3, 0.7]) - ahead, np.array([0, 0.3, 0.7]), up=UP)
        local = transform(invert(camera), points)
        np.testing.assert_array_equal(vertical(scene(local)), [0, -1, 0])


def test_up_without_a_table_is_that_of_the_camera(room):
    camera = look_at(np.array([0, -1.0, 1.0]), np.array([0, 1.0, 1.0]), up=UP)
    np.testing.assert_allclose(vertical(scene(room[:6000]), camera), UP, atol=1e-6)
    np.testing.assert_array_equal(vertical(scene(room[:5])), [0, -1, 0])
    np.testing.assert_array_equal(vertical(scene(room, world="tabletop"), np.eye(4)), UP)
