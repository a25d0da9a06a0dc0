"""A state from one RGB-D image."""

import numpy as np
import pytest

from egosim_jax.geometry import look_at, pixel_rays
from egosim_jax.rendering.reference import render
from egosim_jax.state.depth import state_from_depth
from egosim_jax.types import InputError
from tests.scenes import pinhole

INTRINSICS = np.array([[40.0, 0, 19.5], [0, 40.0, 11.5], [0, 0, 1]])
POSE = look_at(np.array([0.1, -1.0, 0.4]), np.zeros(3), up=np.array([0, 0, 1.0]))


def image_and_depth():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (24, 40, 3), np.uint8)
    depth_m = rng.uniform(0.5, 2, (24, 40))
    depth_m[0, :3] = 0, np.nan, np.inf
    return image, depth_m


def test_the_state_seen_from_its_camera_is_the_image():
    image, depth_m = image_and_depth()
    ids = np.arange(24 * 40).reshape(24, 40) % 7
    state = state_from_depth(image, depth_m, INTRINSICS, POSE, object_ids=ids, names={1: "cup"})
    cameras = pinhole(POSE[None], 40.0, 24, 40)
    view = render(state, cameras, point_px=1)
    known = np.isfinite(depth_m) & (depth_m > 0)
    np.testing.assert_array_equal(view.frames[0][known], image[known])
    np.testing.assert_allclose(view.depth_m[0][known], depth_m[known], rtol=1e-5)
    np.testing.assert_array_equal(view.object_ids[0][known], ids[known])
    assert not view.frames[0][~known].any()


def test_split_pixels_lie_on_the_same_plane_and_leave_no_gaps_nearby():
    rays = pixel_rays(INTRINSICS, height=24, width=40)
    normal = np.array([0.1, 0.6, 0.8])
    depth_m = 1 / (rays @ normal)
    depth_m[:, 20:] *= 2
    depth_m[3, 3] = np.inf
    image = np.full((24, 40, 3), 90, np.uint8)
    state = state_from_depth(image, depth_m, INTRINSICS, np.eye(4), points_per_pixel=2)
    assert len(state.points_m) == 4 * (24 * 40 - 1)
    height = state.points_m @ normal
    inner = np.minimum(np.abs(height - 1), np.abs(height - 2))
    assert np.median(inner) < 1e-6
    assert inner.max() < 0.03
    near = np.eye(4)
    near[2, 3] = 0.4
    cameras = pinhole(near[None], 40.0, 24, 40)
    assert np.isfinite(render(state, cameras, point_px=1).depth_m[0, 8:16, 10:16]).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda image, depth: (image[:-1], depth), "must have the same size"),
        (lambda image, depth: (image, 1000 * depth), "Convert depth_m to meters"),
        (lambda image, depth: (image, np.zeros_like(depth)), "no positive finite value"),
    ],
)
def test_an_image_or_depth_that_makes_no_sense_is_refused(change, message):
    image, depth_m = change(*image_and_depth())
    with pytest.raises(InputError, match=message):
        state_from_depth(image, np.nan_to_num(depth_m), INTRINSICS, POSE)


@pytest.mark.parametrize(
    ("image", "depth_m", "message"),
    [
        (np.zeros((4, 6, 3), np.uint8), np.ones((1, 4, 6)), r"depth_m is float64 \(1, 4, 6\)"),
        (np.zeros((4, 6, 3), np.float32), np.ones((4, 6)), "image is float32"),
        (np.zeros((4, 6), np.uint8), np.ones((4, 6)), r"image is uint8 \(4, 6\)"),
        (np.zeros((8, 6, 3), np.uint8), np.ones((4, 6)), "must have the same size"),
    ],
)
def test_images_and_depth_of_other_shapes_or_dtypes_are_refused(image, depth_m, message):
    with pytest.raises(InputError, match=message):
        state_from_depth(image, depth_m, INTRINSICS, POSE)
