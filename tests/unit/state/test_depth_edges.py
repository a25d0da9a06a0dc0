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
    _, depth, _ = cast([GREEN], VIEW)
    smeared = cv2.blur(depth, (3, 3))
    near, far = (change(depth, np.ones((5, 5))) for change in (cv2.erode, cv2.dilate))
    between = np.minimum(np.abs(smeared - near), np.abs(far - smeared)) > 0.02
    removed = between_surfaces(smeared, FOCAL)
    assert removed[between].mean() > 0.6
    assert removed[~between].mean() < 0.005


def test_unknown_depth_is_between_nothing():
    depth = np.full((20, 20), np.nan)
    depth[5:9] = 1.0
    assert not between_surfaces(depth, 100.0).any()
