"""Tracked and triangulated corners of a textured wall, seen by a camera that moves sideways."""

import cv2
import numpy as np
import pytest

from egosim_jax.perception.video.depth import SweptDepth
from egosim_jax.perception.video.depth.triangulate import Triangulation, triangulate_frames
from egosim_jax.perception.video.estimates import CameraEstimate, Verdict
from tests.scenes import pinhole

HEIGHT, WIDTH, FRAMES, STEP_PX = 96, 128, 9, 3
FOCAL_PX, WALL = 100.0, 2.5


@pytest.fixture(scope="module")
def frames():
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH + FRAMES * STEP_PX, 3))
    wall = cv2.GaussianBlur(noise.astype(np.uint8), (0, 0), 1.5)
    wall = cv2.normalize(wall, None, 0, 255, cv2.NORM_MINMAX)
    return np.stack([wall[:, STEP_PX * k : STEP_PX * k + WIDTH] for k in range(FRAMES)])


@pytest.fixture(scope="module")
def cameras():
    poses = np.repeat(np.eye(4)[None], FRAMES, axis=0)
    poses[:, 0, 3] = np.arange(FRAMES) * STEP_PX * WALL / FOCAL_PX
    return pinhole(poses, FOCAL_PX, HEIGHT, WIDTH)


@pytest.mark.parametrize("frame", [0, 4])
def test_corners_are_at_their_depth(frames, cameras, frame):
    moving = np.zeros(frames.shape[:3], bool)
    moving[:, :, :40] = True
    points = Triangulation()(frames, moving, cameras, frame)
    assert len(points.points_m) > 30
    error = np.abs(points.points_m[:, 2] / WALL - 1)
    assert np.median(error) < 0.005
    assert np.median(points.error_px) < 0.2
    column, row = np.rint(points.pixels_px).astype(int).T
    assert not moving[points.frames, row, column].any()


def test_points_of_several_frames_are_joined(frames, cameras):
    moving = np.zeros(frames.shape[:3], bool)
    one, other = (Triangulation()(frames, moving, cameras, frame) for frame in (0, 4))
    both = triangulate_frames(frames, moving, cameras, [0, 4])
    assert len(both.points_m) == len(one.points_m) + len(other.points_m)
    last = both.indices >= len(one.points_m)
    seen = both.points_m[both.indices[last]]
    assert np.array_equal(seen, other.points_m[other.indices])


def test_a_camera_that_does_not_move_triangulates_nothing(frames):
    still = np.repeat(frames[:1], FRAMES, axis=0)
    moving = np.zeros(frames.shape[:3], bool)
    poses = np.repeat(np.eye(4)[None], FRAMES, axis=0)
    poses[:, 0, 3] = 1e-4 * np.arange(FRAMES)
    found = Triangulation()(still, moving, pinhole(poses, FOCAL_PX, HEIGHT, WIDTH), 0)
    assert not len(found.points_m)
    fixed = pinhole(FRAMES, FOCAL_PX, HEIGHT, WIDTH)
    assert triangulate_frames(still, moving, fixed, [0]) is None


def test_cameras_without_points_have_depth(frames, cameras):
    verdict = Verdict(rung="given", reason="given by a dataset", figures={})
    estimate = CameraEstimate(cameras=cameras, metric=True, verdict=verdict)
    found = SweptDepth()(frames, np.zeros(frames.shape[:3], bool), estimate, [0])
    assert found.metric
    assert found.confident.mean() > 0.03
    assert np.median(np.abs(found.depth_m / WALL - 1)) < 0.02
