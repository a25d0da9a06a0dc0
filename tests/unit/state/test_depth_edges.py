"""Pixels between two surfaces of a depth image."""

import cv2
import numpy as np
import pytest

from egosim_jax.state.depth import between_surfaces, state_from_depth
from tests.boxes import GREEN, RED, cameras, cast

VIEW = cameras(1)
FOCAL = float(VIEW.intrinsics_px[0, 0])


def test_sharp_edges_keep_their_points():
    image, depth, _ = cast([RED, GREEN], VIEW)
    assert not between_surfaces(depth, FOCAL).any()
    state = state_from_depth(image, depth, VIEW.intrinsics_px, np.eye(4))
    assert len(state.points_m) == depth.size


def test_a_smeared_edge_loses_the_points_between_its_surfaces():
    view = cameras(1, height=288, width=480)
    _, depth, _ = cast([GREEN], view)
    smeared = cv2.blur(depth, (5, 5))
    near, far = (change(depth, np.ones((5, 5))) for change in (cv2.erode, cv2.dilate))
    between = np.minimum(np.abs(smeared - near), np.abs(far - smeared)) > 0.02
    removed = between_surfaces(smeared, float(view.intrinsics_px[0, 0]))
    assert removed[between].mean() > 0.6
    assert removed[~between].mean() < 0.02


@pytest.mark.parametrize(("length", "removed"), [(1, True), (6, True), (7, False)])
def test_a_ramp_is_at_most_six_pixels_between_three_of_each_surface(length, removed):
    depth = np.concatenate([np.full(3, 1.0), np.linspace(1, 2, length + 2)[1:-1], np.full(3, 2.0)])
    found = between_surfaces(np.tile(depth, (2, 1)), 100.0)
    expected = np.zeros(length + 6, bool)
    expected[3:-3] = removed
    np.testing.assert_array_equal(found, np.tile(expected, (2, 1)))


def test_unknown_depth_is_between_nothing():
    depth = np.full((20, 20), np.nan)
    depth[5:9] = 1.0
    assert not between_surfaces(depth, 100.0).any()
