"""Parts of the object tracker: supporting planes, the fall after a release, and the put-down."""

import numpy as np
import pytest

from egosim_jax.perception.falling import fall, snap
from egosim_jax.perception.object_models import ObjectModels, Support
from egosim_jax.perception.pose_refinement import ObjectModel, ObjectMotion
from egosim_jax.types import SceneState

FPS = 8
TABLE = np.array([0, 0, 1, -0.7])
AXIS = np.linspace(0, 1, 21)


def grid(low, high):
    """Return points on the top and the front of a box."""
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
    """Return the motion of a cube to a place where a hand releases it."""
    path = np.repeat(np.eye(4)[None], 17, axis=0)
    share = np.clip((np.arange(17) - 4) / (released - 4), 0, 1)
    path[:, :3, 3] = share[:, None] * end_m
    model = ObjectModel(
        number=1, points_m=CUBE, colors=np.zeros((len(CUBE), 3), np.float32), plane=plane
    )
    return ObjectMotion(model=model, grasped=4, released=released, path=path, hinged=hinged)


def test_the_supporting_plane_is_the_same_in_every_run():
    """Open3D's RANSAC stops early, and with several threads at varying samples."""
    rng = np.random.default_rng(0)
    table = rng.uniform(-0.14, 0.14, (9000, 3)) * [1, 1, 0] + rng.normal(0, 0.003, (9000, 3))
    wall = rng.uniform(-0.14, 0.14, (3000, 3)) * [1, 0, 1] + [0, 0.14, 0]
    others = np.concatenate([table, wall]).astype(np.float32)
    points = rng.uniform(-0.03, 0.03, (200, 3))
    z = np.array([0.0, 0.0, 1.0])
    planes = {Support().plane(points, others, z, None).tobytes() for _ in range(12)}
    assert len(planes) == 1
    normal = np.frombuffer(planes.pop())[:3]
    assert abs(normal[2]) > 0.99


@pytest.mark.parametrize(
    ("provenance", "up"), [({"world": "tabletop"}, [0, 0, 1]), ({}, [0, -1, 0])]
)
def test_an_object_without_a_surface_around_it_has_a_horizontal_plane(provenance, up):
    state = SceneState(
        points_m=np.random.default_rng(0).uniform(-0.03, 0.03, (50, 3)).astype(np.float32),
        colors=np.zeros((50, 3), np.uint8),
        object_ids=np.ones(50, np.int32),
        last_seen=np.zeros(50, np.int32),
        intrinsics_px=np.eye(3),
        provenance=provenance,
    )
    plane = ObjectModels(state, np.eye(4), Support()).of(1).plane
    np.testing.assert_array_equal(plane[:3], up)
    assert np.isnan(plane[3])


@pytest.mark.parametrize(
    ("up", "eye_m"),
    [([0, 0, 1], None), ([0, 0.6, 0.8], [0, -0.4, 0.3]), ([0, 0.96, 0.28], [0, -0.1, 0.35])],
    ids=["known", "camera", "camera looking far down"],
)
def test_the_side_of_a_box_supports_nothing(up, eye_m):
    """A wall next to the object has more points than the table."""
    rng = np.random.default_rng(0)
    table = rng.uniform(-0.1, 0.1, (400, 3)) * [1, 1, 0]
    wall = rng.uniform(-0.1, 0.1, (2000, 3)) * [1, 0, 1] + [0, 0.09, 0.1]
    others = np.concatenate([table, wall]).astype(np.float32)
    eye = None if eye_m is None else np.array(eye_m)
    plane = Support().plane(np.zeros((30, 3)), others, np.array(up, float), eye)
    np.testing.assert_allclose(plane, [0, 0, 1, 0], atol=0.01)


@pytest.mark.parametrize("plane", [TABLE, -TABLE])
@pytest.mark.parametrize(
    ("end_m", "height_m"),
    [([0.1, 0, 0.04], 0.0), ([0.3, 0, 0.13], 0.1), ([0.3, 0, 0.1], 0.1)],
    ids=["onto the table", "onto a block", "put down on a block"],
)
def test_a_released_object_rests_at_its_first_height_above_the_support(end_m, height_m, plane):
    fallen = fall(carried(end_m, plane=plane), OTHERS, FPS)
    np.testing.assert_allclose(fallen.path[-1, :3, 3], [*end_m[:2], height_m], atol=1e-6)
    np.testing.assert_array_equal(fallen.path[:13], carried(end_m).path[:13])


def test_a_released_object_falls_with_the_acceleration_of_gravity():
    fallen = fall(carried([0.1, 0, 0.2]), OTHERS, FPS)
    np.testing.assert_allclose(0.2 - fallen.path[13, 2, 3], 9.81 / 2 / FPS**2)
    np.testing.assert_allclose(fallen.path[-1, 2, 3], 0, atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [
        {"end_m": [0.1, 0, 0.04], "released": 16},
        {"end_m": [0.1, 0, 0.04], "hinged": True},
        {"end_m": [0.1, 0, 0.04], "plane": np.array([0, 0, 1, np.nan])},
        {"end_m": [0.1, 0, 0.005]},
    ],
    ids=["held to the end", "on a hinge", "no surface known", "not lifted"],
)
def test_other_objects_do_not_fall(options):
    np.testing.assert_array_equal(
        fall(carried(**options), OTHERS, FPS).path, carried(**options).path
    )


@pytest.mark.parametrize(
    ("end_m", "height_m"),
    [
        ([0.1, 0, 0.006], 0.0),
        ([0.1, 0, -0.006], 0.0),
        ([0.3, 0, 0.106], 0.1),
        ([0.3, 0, 0.094], 0.1),
        ([0.1, 0, 0.03], 0.03),
        ([0.1, 0, -0.03], -0.03),
    ],
    ids=["above", "below", "above a block", "in a block", "too far above", "too far below"],
)
def test_what_was_put_down_has_its_first_height_above_the_support(end_m, height_m):
    path = snap(carried(end_m), OTHERS).path
    np.testing.assert_allclose(path[-1, :3, 3], [*end_m[:2], height_m], atol=1e-6)
    np.testing.assert_allclose(path[8, :3, 3], path[-1, :3, 3] / 2, atol=1e-9)
    np.testing.assert_array_equal(path[:5], carried(end_m).path[:5])


def test_the_objects_own_missing_points_do_not_support_it():
    """A ball without an id lacks the points of its underside, which no table point is below."""
    crumbs = np.array([[0.0, 0.0, 0.709], [0.002, 0.0, 0.709]])
    others = np.concatenate([TOP[np.abs(TOP[:, 1]) > 0.05], BLOCK, crumbs]).astype(np.float32)
    path = snap(carried([0.3, 0, 0.103]), others).path
    np.testing.assert_allclose(path[-1, :3, 3], [0.3, 0, 0.1], atol=1e-6)


@pytest.mark.parametrize("rise_m", [0.002, -0.003])
def test_a_drawer_that_slides_out_of_its_case_keeps_its_height(rise_m):
    """Its case, and not what it rests on, is below it at first; later it is above the table."""
    case = np.concatenate([TOP * [0.1, 0.1, 0] + [0, 0, 0.71], TOP]).astype(np.float32)
    pulled = snap(carried([0, -0.1, rise_m]), case)
    np.testing.assert_allclose(pulled.path[-1, :3, 3], [0, -0.1, 0], atol=1e-6)


@pytest.mark.parametrize(
    "options",
    [{"released": 16}, {"hinged": True}, {"plane": np.array([0, 0, 1, np.nan])}],
    ids=["held to the end", "on a hinge", "no surface known"],
)
def test_nothing_else_is_put_down(options):
    motion = carried([0.1, 0, 0.006], **options)
    np.testing.assert_array_equal(snap(motion, OTHERS).path, motion.path)
