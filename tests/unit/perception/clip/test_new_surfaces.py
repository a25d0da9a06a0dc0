"""New surfaces: planes continue where their colors do, and everything else stays unknown."""

import numpy as np
import pytest

from egosim_jax.geometry import look_at, pixel_rays
from egosim_jax.perception.clip.new_surfaces import NewSurfaces
from egosim_jax.perception.pipeline import Observation
from egosim_jax.types import Clip
from tests.scenes import pinhole, state_of, without_hands

HEIGHT, WIDTH, FRAMES = 36, 48, 3
OAK, STONE = np.array([190, 150, 100]), np.array([110, 112, 120])
UP = np.array([0.0, 0.0, 1.0])
POSE = look_at(np.array([0.0, -0.3, 0.5]), np.zeros(3), up=UP)
CAMERAS = pinhole([POSE] * FRAMES, 45.0, HEIGHT, WIDTH)
RAYS = pixel_rays(CAMERAS.intrinsics_px, height=HEIGHT, width=WIDTH) @ POSE[:3, :3].T
TABLE_M = -POSE[2, 3] / RAYS[..., 2]
"""Depth of the table in each pixel."""
RIGHT_M = POSE[0, 3] + TABLE_M * RAYS[..., 0]
"""Coordinate x of the point of the table that each pixel sees."""


def perceive(colors, *, ids=None, motions=(), supports=()):
    """Return the stage's result for a state with the left half of a table."""
    x, y = (v.ravel() for v in np.meshgrid(np.arange(-0.5, 0, 0.004), np.arange(-0.4, 0.6, 0.004)))
    state = state_of(np.stack([x, y, 0 * x], axis=1), colors=OAK)
    frames = np.repeat(colors[None].astype(np.uint8), FRAMES, axis=0)
    so_far = Observation(
        cameras=CAMERAS,
        object_ids=np.zeros(frames.shape[:3], np.int32) if ids is None else ids,
        depth_m=np.full(frames.shape[:3], np.inf, np.float32),
        motions=dict(motions),
        support_planes=dict(supports),
    )
    return NewSurfaces()(Clip(frames=frames, fps=8), without_hands(CAMERAS), state, so_far)


def test_the_table_continues_up_to_its_edge():
    colors = np.where((RIGHT_M < 0.06)[..., None], OAK, STONE)
    depth = perceive(colors).depth_m[0]
    near = (RIGHT_M > 0.005) & (RIGHT_M < 0.055)
    np.testing.assert_allclose(depth[near], TABLE_M[near], atol=0.002)
    assert not np.isfinite(depth[RIGHT_M > 0.06]).any()
    assert not np.isfinite(depth[RIGHT_M < -0.03]).any()


def test_the_part_below_a_shadow_continues_the_table_too():
    shadow = np.where((RIGHT_M > 0.02)[..., None], 0.75 * OAK, OAK)
    near = (RIGHT_M > 0.005) & (RIGHT_M < 0.05)
    assert np.isfinite(perceive(shadow).depth_m[0][near]).mean() > 0.95


def test_far_from_all_points_nothing_is_assumed():
    depth = perceive(np.broadcast_to(OAK, (HEIGHT, WIDTH, 3))).depth_m[0]
    assert not np.isfinite(depth[RIGHT_M > 0.2]).any()


def test_nothing_is_added_at_hands():
    ids = np.where(RIGHT_M > 0.03, -1, 0).astype(np.int32)
    colors = np.broadcast_to(OAK, (HEIGHT, WIDTH, 3))
    found = perceive(colors, ids=np.repeat(ids[None], FRAMES, axis=0))
    assert not np.isfinite(found.depth_m[found.object_ids < 0]).any()


@pytest.mark.parametrize("color", [STONE, np.array([127, 127, 127])])
def test_another_color_is_another_surface(color):
    colors = np.where((RIGHT_M < 0)[..., None], OAK, color)
    assert not np.isfinite(perceive(colors).depth_m[0][RIGHT_M > 0.01]).any()
