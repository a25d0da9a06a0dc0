"""Points of an object after an update, against its ground-truth surface."""

import numpy as np
import pytest

from egosim_jax.evaluation.metrics.state_update import (
    distance_to_mesh,
    nearest,
    object_accuracy,
    symmetric_distance,
)
from egosim_jax.worlds.tabletop.bodies import box

AT = np.array([0.3, 0.0, 0.0])


def top(step=0.004):
    """Points on the upper side of a cube of 10 cm at the origin."""
    x, y = np.mgrid[-0.05:0.0501:step, -0.05:0.0501:step]
    return np.stack([x, y, np.full_like(x, 0.1)], axis=-1).reshape(-1, 3)


def cube_at(place):
    vertices, triangles = box((-0.05, -0.05, 0), (0.05, 0.05, 0.1))
    return vertices + place, triangles


def judged(after):
    before = top().astype(np.float32)
    return object_accuracy(
        before, after.astype(np.float32), surface=cube_at(AT), seen_m=top(0.003) + AT
    )


def test_an_object_that_moved_completely_is_accurate_and_complete():
    assert judged(top() + AT) == {"accuracy": 100, "completeness": 100, "ghost": 0}


def test_a_ghost_is_inaccurate_and_remains():
    assert judged(top()) == {"accuracy": 0, "completeness": 0, "ghost": 100}


def test_half_an_object_is_half_complete():
    points = top() + AT
    found = judged(points[points[:, 0] < AT[0]])
    assert found["accuracy"] == 100
    assert found["completeness"] == pytest.approx(60, abs=3)  # one more centimeter counts as known


def test_distances_are_those_to_the_surface_inside_and_outside():
    points = np.array([[0, 0, 0.15], [0.05, 0, 0.05], [0, 0, 0.09], [0.08, 0.09, 0.05]])
    expected = [0.05, 0, 0.01, 0.05]
    np.testing.assert_allclose(distance_to_mesh(points, cube_at([0, 0, 0])), expected, atol=1e-6)


def test_the_symmetric_distance_sees_what_one_side_lacks():
    some = top()
    assert symmetric_distance(some, some) == 0
    assert symmetric_distance(some, some + [0, 0, 0.002]) == pytest.approx(0.002)
    more = np.concatenate([some, some + AT])
    assert symmetric_distance(some, more) == symmetric_distance(more, some) > 0.1
    assert symmetric_distance(some, some[:0]) == np.inf
    assert np.isinf(nearest(some, some[:0])).all()
