"""Metric hands from keypoints in pixels: exact for known hands."""

from fractions import Fraction

import numpy as np

from egosim_jax.perception.video.estimates import LEFT, RIGHT, HandTracks
from egosim_jax.perception.video.hands import lift, steady

INTRINSICS_PX = np.array([[600.0, 0, 415.5], [0, 620.0, 239.5], [0, 0, 1]])


def project(joints_m):
    pixels = joints_m @ INTRINSICS_PX.T
    return pixels[..., :2] / pixels[..., 2:]


def hands(frames=5):
    """Hands in meters at known places in front of the camera."""
    rng = np.random.default_rng(0)
    shape = rng.normal(0, 0.04, (frames, 2, 21, 3))
    return shape, shape + rng.uniform([-0.3, -0.2, 0.3], [0.3, 0.2, 0.8], (frames, 2, 1, 3))


def tracks_of(shape, joints_m):
    return HandTracks(
        joints_px=project(joints_m), joints_hand_m=shape, presence=np.ones(joints_m.shape[:2])
    )


def test_a_known_hand_is_lifted_to_its_exact_place():
    shape, joints_m = hands()
    lifted = lift(tracks_of(shape - shape.mean((-2,), keepdims=True), joints_m), INTRINSICS_PX)
    np.testing.assert_allclose(lifted, joints_m, atol=1e-9)


def test_a_lifted_hand_projects_to_its_pixels_even_with_another_shape():
    shape, joints_m = hands()
    tracks = tracks_of(shape * 1.2 + 0.005, joints_m)
    np.testing.assert_allclose(project(lift(tracks, INTRINSICS_PX)), tracks.joints_px, atol=1e-6)


def test_a_larger_hand_with_the_same_image_is_farther_away():
    shape, joints_m = hands()
    lifted = lift(tracks_of(1.1 * shape, joints_m), INTRINSICS_PX)
    np.testing.assert_allclose(lifted, 1.1 * joints_m, rtol=1e-6)


def test_a_missing_hand_stays_missing():
    tracks = tracks_of(*hands())
    tracks.joints_px[2, LEFT] = np.nan
    lifted = lift(tracks, INTRINSICS_PX)
    assert np.isnan(lifted[2, LEFT]).all()
    assert np.isfinite(lifted[2, RIGHT]).all()


def test_a_hand_that_would_be_behind_the_camera_is_missing():
    shape, joints_m = hands()
    tracks = tracks_of(-shape, joints_m)
    assert np.isnan(lift(tracks, INTRINSICS_PX)).all()


def test_hands_of_changing_size_get_one_size_and_stay_on_their_rays():
    known = np.repeat(hands(1)[1], 20, axis=0)
    error = np.random.default_rng(0).uniform(0.8, 1.25, (20, 2, 1, 1))
    error[::2] = 1  # most sizes are right, and so is the median
    calm = steady(known * error, Fraction(16))
    np.testing.assert_allclose(calm[..., :2] / calm[..., 2:], known[..., :2] / known[..., 2:])
    np.testing.assert_allclose(calm, known, rtol=0.05)
    known[3, LEFT] = np.nan
    assert np.isnan(steady(known, Fraction(16))[3, LEFT]).all()
    assert np.isfinite(steady(known, Fraction(16))[4]).all()
