"""Support planes of a scene."""

import numpy as np
import pytest

from egosim_jax.state.planes import fit_plane, support_planes

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


def test_too_few_points_have_no_plane(room):
    assert support_planes(room[:20], UP) == []


def test_a_plane_has_its_inliers(room):
    plane, inliers = fit_plane(room[:6000], 0.006)
    assert len(inliers) > 5900
    np.testing.assert_allclose(np.abs(plane[:3]), [0, 1, 0], atol=0.01)
