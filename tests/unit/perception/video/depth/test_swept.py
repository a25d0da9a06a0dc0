"""Depth of posed videos of the tabletop world, versus its exact depth."""

from dataclasses import replace

import numpy as np
import pytest

from egosim_jax.perception.video.depth import SweptDepth
from egosim_jax.perception.video.estimates import DepthEstimator
from egosim_jax.types import InputError
from tests.unit.perception.posed import estimate_of, hands_of, make_clip

UNIT_M = 0.5


@pytest.fixture(scope="module")
def clip():
    return make_clip()


@pytest.fixture(scope="module")
def moving(clip):
    return hands_of(clip)


@pytest.fixture(scope="module")
def found(clip, moving):
    return SweptDepth()(clip.frames, moving, estimate_of(clip, unit=UNIT_M), [0, 8])


def errors(clip, found, number):
    frame = found.frames[number]
    return np.abs(found.depth_m[number] * UNIT_M / clip.depth_m[frame] - 1)


def test_it_is_a_depth_estimator():
    assert isinstance(SweptDepth(), DepthEstimator)


def test_measured_depth_is_within_two_percent(clip, moving, found):
    for number, frame in enumerate(found.frames):
        measured = found.confident[number] & ~moving[frame]
        assert measured.mean() > 0.01
        assert np.median(errors(clip, found, number)[measured]) < 0.02


def test_completed_depth_is_known_everywhere_and_mostly_within_five_percent(clip, moving, found):
    assert np.isfinite(found.depth_m).all()
    assert (found.depth_m > 0).all()
    scene = ~moving[0] & np.isfinite(clip.depth_m[0])
    assert (errors(clip, found, 0)[scene] < 0.05).mean() > 0.85


def test_hands_are_not_measured(moving, found):
    from cv2 import erode

    inside = erode(moving[0].astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert inside.any()
    assert not found.confident[0][inside].any()


def test_a_few_false_points_are_dropped(clip, moving, found):
    estimate = estimate_of(clip, unit=UNIT_M)
    points = estimate.points.points_m.copy()
    eye = estimate.cameras.world_from_camera[0, :3, 3]
    points[::20] = eye + 0.3 * (points[::20] - eye)
    spoiled = replace(estimate, points=replace(estimate.points, points_m=points))
    again = SweptDepth()(clip.frames, moving, spoiled, [0])
    scene = ~moving[0] & np.isfinite(clip.depth_m[0])
    good, bad = (errors(clip, depth, 0)[scene] for depth in (found, again))
    assert (bad < 0.05).mean() > (good < 0.05).mean() - 0.03


@pytest.mark.parametrize("rung", ["static", "rotation"])
def test_without_parallax_depth_is_a_plane_and_says_so(clip, moving, rung):
    estimate = estimate_of(clip, rung=rung, points=False)
    poses = estimate.cameras.world_from_camera.copy()
    poses[:, :3, 3] = poses[0, :3, 3]
    estimate = replace(estimate, cameras=replace(estimate.cameras, world_from_camera=poses))
    found = SweptDepth()(clip.frames, moving, estimate, [0])
    np.testing.assert_allclose(found.depth_m, 1, rtol=1e-5)
    assert not found.confident.any()
    assert not found.metric
    assert "assumed" in found.reason


def test_metric_cameras_that_hardly_move_see_a_plane_in_meters(clip, moving):
    estimate = replace(estimate_of(clip, points=False), metric=True)
    poses = estimate.cameras.world_from_camera.copy()
    poses[:, :3, 3] = poses[0, :3, 3] + 1e-4 * np.arange(len(poses))[:, None]
    estimate = replace(estimate, cameras=replace(estimate.cameras, world_from_camera=poses))
    found = SweptDepth()(clip.frames[:1].repeat(9, axis=0), moving, estimate, [0])
    assert found.metric
    assert "parallax" in found.reason
    np.testing.assert_allclose(np.median(found.depth_m), 0.6, rtol=0.01)


def test_refused_cameras_are_refused(clip, moving):
    refused = replace(estimate_of(clip), cameras=None)
    with pytest.raises(InputError, match="refused"):
        SweptDepth()(clip.frames, moving, refused, [0])
