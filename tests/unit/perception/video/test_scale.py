"""Scale of estimated cameras from synthetic hands, planes and depth maps."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.geometry import pixel_rays
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimate, Verdict
from egosim_jax.perception.video.scale import (
    FINGERTIPS,
    contact_scale,
    estimate_scale,
    scale_cameras,
    scale_depth,
)
from egosim_jax.types import InputError
from tests.scenes import pinhole

UNIT_M = 0.37
HEIGHT, WIDTH, FRAMES = 60, 80, 12
TABLE_M = 0.4


@pytest.fixture
def estimate():
    poses = np.repeat(np.eye(4)[None], FRAMES, axis=0)
    poses[:, 0, 3] = np.linspace(0, 0.05, FRAMES) / UNIT_M
    return CameraEstimate(
        cameras=pinhole(poses, 60.0, HEIGHT, WIDTH),
        metric=False,
        verdict=Verdict(rung="incremental", reason="given to a test", figures={}),
    )


def depth_of(values, estimate):
    return DepthEstimate(
        frames=np.array([0], np.int32),
        depth_m=values[None].astype(np.float32),
        confident=np.ones((1, HEIGHT, WIDTH), bool),
        metric=False,
    )


@pytest.fixture
def table(estimate):
    """Depth of an oblique table: a plane through (0, 0, 0.6 m) at distance 0.4 m."""
    rays = pixel_rays(estimate.cameras.intrinsics_px, height=HEIGHT, width=WIDTH)
    sine = TABLE_M / 0.6
    normal = np.array([0, np.sqrt(1 - sine**2), sine])
    return depth_of(TABLE_M / (rays @ normal) / UNIT_M, estimate)


def hands_above(estimate, table, heights):
    """Return metric joints whose fingertips are at factors of the table's depth, per frame."""
    joints = np.full((FRAMES, 2, 21, 3), np.nan)
    rng = np.random.default_rng(0)
    rays = pixel_rays(estimate.cameras.intrinsics_px, height=HEIGHT, width=WIDTH)
    for frame, factor in enumerate(heights):
        for tip in FINGERTIPS:
            row, column = rng.integers(20, 40), rng.integers(25, 55)
            behind = table.depth_m[0, row, column] * UNIT_M
            joints[frame, 1, tip] = rays[row, column] * behind * factor
    return joints


def test_hands_that_touch_a_wall_give_its_exact_distance(estimate):
    wall = depth_of(np.full((HEIGHT, WIDTH), 0.6 / UNIT_M), estimate)
    heights = np.r_[np.linspace(0.4, 0.9, FRAMES - 4), [1.0] * 4]
    found = estimate_scale(estimate, wall, hands_above(estimate, wall, heights))
    assert found.source == "hands"
    assert found.meters_per_unit == pytest.approx(UNIT_M, rel=1e-3)
    assert 0.1 <= found.uncertainty < 0.15


def test_hands_on_an_oblique_table_give_its_scale(estimate, table):
    heights = np.r_[np.linspace(0.4, 0.9, FRAMES - 4), [1.0] * 4]
    found = estimate_scale(estimate, table, hands_above(estimate, table, heights))
    assert found.meters_per_unit == pytest.approx(UNIT_M, rel=0.05)


def test_moving_pixels_are_not_scene(estimate):
    depth = np.full((HEIGHT, WIDTH), 0.6 / UNIT_M)
    wall = depth_of(depth, estimate)
    heights = [1.0] * FRAMES
    joints = hands_above(estimate, wall, heights)
    moving = np.zeros((FRAMES, HEIGHT, WIDTH), bool)
    moving[0, :30] = True
    hand = depth.copy()
    hand[:30] = 0.1 / UNIT_M
    found = estimate_scale(estimate, depth_of(hand, estimate), joints, moving)
    assert found.meters_per_unit == pytest.approx(UNIT_M, rel=1e-3)


def test_the_height_of_the_camera_gives_the_scale(estimate, table):
    found = estimate_scale(estimate, table, camera_height_m=TABLE_M)
    assert found.source == "camera height"
    assert found.meters_per_unit == pytest.approx(UNIT_M, rel=1e-3)


def test_a_metric_depth_map_gives_the_scale(estimate, table):
    metric = replace(table, depth_m=table.depth_m * np.float32(UNIT_M), metric=True)
    found = estimate_scale(estimate, table, metric_depth=metric)
    assert found.source == "metric depth"
    assert found.meters_per_unit == pytest.approx(UNIT_M, rel=1e-5)


def test_without_any_source_the_median_depth_is_assumed_and_flagged(estimate, table):
    missing = np.full((FRAMES, 2, 21, 3), np.nan)
    found = estimate_scale(estimate, table, missing)
    assert found.source == "median depth"
    assert found.uncertainty >= 0.5
    assert np.median(table.depth_m) * found.meters_per_unit == pytest.approx(0.6)


def test_a_given_scale_wins(estimate, table):
    assert estimate_scale(estimate, table, meters_per_unit=2.0).meters_per_unit == 2
    metric = replace(estimate, metric=True)
    assert estimate_scale(metric, table, camera_height_m=1.0).meters_per_unit == 1


def test_cameras_and_depth_are_scaled_once(estimate, table):
    scale = estimate_scale(estimate, table, meters_per_unit=UNIT_M)
    cameras = scale_cameras(estimate, scale)
    assert cameras.metric
    assert cameras.cameras.world_from_camera[-1, 0, 3] == pytest.approx(0.05)
    depth = scale_depth(table, scale)
    assert depth.metric
    assert scale_depth(depth, scale) is depth


def test_a_scale_that_is_not_positive_is_refused(estimate, table):
    with pytest.raises(InputError, match="--scale"):
        estimate_scale(estimate, table, meters_per_unit=-1.0)


def test_fingertips_touch_the_object_that_they_begin_to_move(estimate):
    depth = np.full((HEIGHT, WIDTH), 2 * TABLE_M / UNIT_M)
    ids = np.zeros((HEIGHT, WIDTH), np.int32)
    ids[20:30, 30:40] = 4
    depth[ids == 4] = TABLE_M / UNIT_M
    joints = np.full((FRAMES, 2, 21, 3), np.nan)
    joints[5:8, 1] = [0, 0, TABLE_M]
    contacts = np.array([[frame, 1, 4] for frame in range(4, 8)])
    scale = contact_scale(estimate.cameras, depth, ids, joints, contacts)
    assert scale is not None
    assert scale.meters_per_unit == pytest.approx(UNIT_M)
    assert contact_scale(estimate.cameras, depth, ids, joints, contacts[:1]) is None
    assert contact_scale(estimate.cameras, depth, 0 * ids, joints, contacts) is None
