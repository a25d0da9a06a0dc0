"""Parts of the object tracker, each on its own."""

import numpy as np
import pytest

from egosim_jax.perception.object_motion import (
    TrackObjects,
    _support_plane,
    object_model,
)
from egosim_jax.types import SceneState


def test_the_supporting_plane_is_the_same_in_every_run():
    """Open3D's RANSAC stops early; several threads would stop it at different samples."""
    rng = np.random.default_rng(0)
    table = rng.uniform(-0.14, 0.14, (9000, 3)) * [1, 1, 0] + rng.normal(0, 0.003, (9000, 3))
    wall = rng.uniform(-0.14, 0.14, (3000, 3)) * [1, 0, 1] + [0, 0.14, 0]
    others = np.concatenate([table, wall]).astype(np.float32)
    points = rng.uniform(-0.03, 0.03, (200, 3))
    planes = {_support_plane(points, others, TrackObjects()).tobytes() for _ in range(12)}
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
    plane = object_model(1, state, TrackObjects()).plane
    np.testing.assert_array_equal(plane[:3], up)
    assert np.isnan(plane[3])
