"""The fall of what was let go of above its support."""

import numpy as np
import pytest

from egosim_jax.perception.falling import fall
from egosim_jax.perception.pose_refinement import ObjectModel, ObjectMotion

FPS = 8
TABLE = np.array([0, 0, 1, -0.7])
AXIS = np.linspace(0, 1, 21)


def grid(low, high):
    """Return points of the upper side and the front of a box."""
    low, high = np.array(low), np.array(high)
    u, v = (x.ravel() for x in np.meshgrid(AXIS, AXIS))
    top = np.stack([u, v, np.ones_like(u)], axis=1)
    front = np.stack([u, np.zeros_like(u), v], axis=1)
    return low + np.concatenate([top, front]) * (high - low)


CUBE = grid([-0.02, -0.02, 0.705], [0.02, 0.02, 0.75])
SURFACE = np.stack([x.ravel() for x in np.meshgrid(8 * AXIS - 4, 8 * AXIS - 4)], axis=1) / 10
TOP = np.concatenate([SURFACE, np.full((len(SURFACE), 1), 0.7)], axis=1)
BLOCK = grid([0.25, -0.05, 0.7], [0.35, 0.05, 0.8])
OTHERS = np.concatenate([TOP, BLOCK]).astype(np.float32)


def carried(end_m, released=12, hinged=False, plane=TABLE):
    """Return the motion of a cube to a place, where it is released."""
    path = np.repeat(np.eye(4)[None], 17, axis=0)
    share = np.clip((np.arange(17) - 4) / (released - 4), 0, 1)
    path[:, :3, 3] = share[:, None] * end_m
    model = ObjectModel(
        number=1, points_m=CUBE, colors=np.zeros((len(CUBE), 3), np.float32), plane=plane
    )
    return ObjectMotion(model=model, grasped=4, released=released, path=path, hinged=hinged)


@pytest.mark.parametrize("plane", [TABLE, -TABLE])
@pytest.mark.parametrize(
    ("end_m", "height_m"),
    [([0.1, 0, 0.04], 0.0), ([0.3, 0, 0.13], 0.1), ([0.3, 0, 0.1], 0.1)],
    ids=["onto the table", "onto a block", "put down on a block"],
)
def test_it_comes_to_rest_as_high_above_its_support_as_it_began(end_m, height_m, plane):
    fallen = fall(carried(end_m, plane=plane), OTHERS, FPS)
    np.testing.assert_allclose(fallen.path[-1, :3, 3], [*end_m[:2], height_m], atol=1e-6)
    np.testing.assert_array_equal(fallen.path[:13], carried(end_m).path[:13])


def test_it_falls_with_the_acceleration_of_gravity():
    fallen = fall(carried([0.1, 0, 0.2]), OTHERS, FPS)
    np.testing.assert_allclose(0.2 - fallen.path[13, 2, 3], 9.81 / 2 / FPS**2)
    np.testing.assert_allclose(fallen.path[-1, 2, 3], 0, atol=1e-6)


@pytest.mark.parametrize(
    "given",
    [
        {"end_m": [0.1, 0, 0.04], "released": 16},
        {"end_m": [0.1, 0, 0.04], "hinged": True},
        {"end_m": [0.1, 0, 0.04], "plane": np.array([0, 0, 1, np.nan])},
        {"end_m": [0.1, 0, 0.005]},
    ],
    ids=["held to the end", "on a hinge", "no surface known", "not lifted"],
)
def test_nothing_else_falls(given):
    np.testing.assert_array_equal(fall(carried(**given), OTHERS, FPS).path, carried(**given).path)
