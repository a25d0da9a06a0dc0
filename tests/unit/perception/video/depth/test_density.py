"""Density of a wall's points for a camera that approaches it."""

import numpy as np
import pytest

from egosim_jax.perception.video.depth import points_per_pixel
from egosim_jax.rendering.reference import render
from egosim_jax.state.depth import state_from_depth
from tests.scenes import pinhole


@pytest.mark.parametrize(("nearest", "wanted"), [(1.0, 1), (0.6, 1), (0.3, 2)])
def test_a_wall_magnified_more_than_twice_gets_denser_points(nearest, wanted):
    poses = np.repeat(np.eye(4)[None], 5, axis=0)
    poses[:, 2, 3] = 1 - np.linspace(1, nearest, 5)
    cameras = pinhole(poses, 60.0, 60, 80)
    depth_m = np.ones((60, 80))
    density = points_per_pixel(depth_m, cameras)
    assert density == wanted
    image = np.full((60, 80, 3), 200, np.uint8)
    matrix = cameras.intrinsics_px
    state = state_from_depth(image, depth_m, matrix, np.eye(4), points_per_pixel=density)
    assert np.isfinite(render(state, cameras, point_px=2).depth_m[:, 5:-5, 5:-5]).all()
