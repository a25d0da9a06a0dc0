"""Lenses agree with OpenCV and COLMAP; remapped images have no borders and the right pixels."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest

from egosim_jax.data.readers.lenses import Lens, Remap
from egosim_jax.types import InputError

INTRINSICS = np.array([[300.0, 0, 318], [0, 305, 242], [0, 0, 1]])
POINTS = np.random.default_rng(0).uniform([-0.8, -0.6, 0.9], [0.8, 0.6, 1.6], (200, 3))
BROWN = (-0.2, 0.05, 0.001, -0.002, 0.01)
FISHEYE = (-0.03, 0.01, -0.002, 0.0005)
ARIA = (0.4, -0.47, 0.08, 1.2, -1.6, 0.6, 2e-4, -6e-5, -1e-4, -1e-5, 6e-5, 2e-5)


def lens(model, coefficients):
    return Lens(
        model=model, coefficients=coefficients, intrinsics_px=INTRINSICS, height=480, width=640
    )


@pytest.mark.parametrize(
    ("model", "k", "project"),
    [("brown", BROWN, cv2.projectPoints), ("fisheye", FISHEYE, cv2.fisheye.projectPoints)],
)
def test_brown_and_fisheye_agree_with_opencv(model, k, project):
    zero = np.zeros(3)
    expected, _ = project(POINTS[:, None], zero, zero, INTRINSICS, np.array(k))
    np.testing.assert_allclose(lens(model, k).project(POINTS), expected[:, 0], atol=1e-9)


def test_fisheye624_agrees_with_colmap():
    """COLMAP's RAD_TAN_THIN_PRISM_FISHEYE is the same model; it runs in a process without cv2."""
    (fx, _, cx), (_, fy, cy), _ = INTRINSICS.tolist()
    program = (
        "import json, sys, numpy as np, pycolmap\n"
        "params, points = json.load(sys.stdin)\n"
        "camera = pycolmap.Camera(model='RAD_TAN_THIN_PRISM_FISHEYE', width=640, height=480, "
        "params=params)\n"
        "print(json.dumps([camera.img_from_cam(np.array(p)).tolist() for p in points]))\n"
    )
    request = json.dumps([[fx, fy, cx, cy, *ARIA], POINTS.tolist()])
    run = subprocess.run(
        [sys.executable, "-c", program], input=request, capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 0, run.stderr
    expected = np.array(json.loads(run.stdout))
    np.testing.assert_allclose(lens("fisheye624", ARIA).project(POINTS), expected, atol=1e-6)


@pytest.mark.parametrize(("model", "k"), [("brown", BROWN), ("fisheye", FISHEYE)])
def test_unproject_inverts_project(model, k):
    pixels = lens(model, k).project(POINTS)
    rays = lens(model, k).unproject(pixels)
    np.testing.assert_allclose(rays, POINTS[:, :2] / POINTS[:, 2:], atol=1e-6)


@pytest.mark.parametrize(("model", "k"), [("brown", BROWN), ("fisheye", FISHEYE)])
def test_a_remapped_image_has_no_border_and_shows_points_where_the_pinhole_projects(model, k):
    remap = Remap.of(lens(model, k))
    (white,) = remap.apply([np.full((480, 640, 3), 255, np.uint8)])
    assert (white == 255).all()
    pixels = lens(model, k).project(POINTS)
    moved = remap.move(pixels)
    flat = POINTS / POINTS[:, 2:] @ remap.intrinsics_px.T
    np.testing.assert_allclose(moved, flat[:, :2], atol=1e-3)
    image = np.zeros((480, 640, 3), np.uint8)
    inside = (np.abs(flat[:, :2] - [320, 240]) < [300, 220]).all(axis=1)
    for point, (x, y) in zip(pixels[inside][:5], flat[inside][:5, :2], strict=True):
        cv2.circle(image, tuple(np.rint(point).astype(int).tolist()), 3, (255, 255, 255), -1)
        (out,) = remap.apply([image])
        assert out[round(y), round(x), 0] > 200
        image[:] = 0


def test_a_lens_without_distortion_is_a_pinhole():
    assert lens("brown", (0.0,) * 5).is_pinhole()
    assert lens("brown", (1e-5, 0, 0, 0, 0)).is_pinhole()
    assert not lens("brown", BROWN).is_pinhole()


@pytest.mark.parametrize("k", [(0.0,) * 4, (np.nan,) * 5, (1e9,) * 5])
def test_wrong_coefficients_are_refused(k):
    with pytest.raises(InputError, match="5 finite coefficients"):
        lens("brown", k)


def test_an_extreme_lens_is_refused():
    with pytest.raises(InputError, match="cannot be remapped"):
        Remap.of(lens("brown", (50.0, 50.0, 0, 0, 0)))
