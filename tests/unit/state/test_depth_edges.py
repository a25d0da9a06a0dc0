"""Pixels between two surfaces of a depth image."""

import cv2
import numpy as np

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


def test_unknown_depth_is_between_nothing():
    depth = np.full((20, 20), np.nan)
    depth[5:9] = 1.0
    assert not between_surfaces(depth, 100.0).any()
