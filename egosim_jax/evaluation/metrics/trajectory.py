"""Camera trajectory errors. The paper gives no formula for its Cam ERR; this definition is ours.

The ground-truth scene is known at every frame. Dense optical flow from the ground-truth frame to
the generated frame gives a pixel for each scene point. PnP (RANSAC, then least squares) finds the
camera that sees the points at these pixels. For the ground-truth frames themselves, the error is 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from egosim_jax.geometry import invert, pixel_rays, rotation_angles_deg, transform
from egosim_jax.types import Cameras

MAX_KEYPOINTS = 800
"""Maximum number of tracked points, chosen by image gradient."""
MIN_EXTENT = 1e-3
"""Minimum distance of a camera from the first one, in units of the path, that is no jitter."""
MIN_INLIERS = 12
"""Minimum number of points for a pose."""
INLIER_THRESHOLD_PX = 1.0
"""Inlier threshold in pixels."""


def estimate_cameras(
    frames: UInt8[np.ndarray, "f h w 3"],
    target: UInt8[np.ndarray, "f h w 3"],
    depth_m: Float32[np.ndarray, "f h w"],
    still: Bool[np.ndarray, "f h w"],
    cameras: Cameras,
) -> Float[np.ndarray, "f 4 4"]:
    """Return `world_from_camera` of each frame; NaN where too few points agree.

    `depth_m` and `cameras` belong to the target frames. `still` marks their static pixels, without
    hands and manipulated objects.
    """
    import cv2

    flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    poses = np.full((len(frames), 4, 4), np.nan)
    for number, pose in enumerate(cameras.world_from_camera):
        gray = [cv2.cvtColor(image[number], cv2.COLOR_RGB2GRAY) for image in (target, frames)]
        row, column = select_keypoints(gray[0], still[number] & np.isfinite(depth_m[number]))
        if len(row) < MIN_INLIERS:
            continue
        moved = flow.calc(gray[0], gray[1], None)[row, column]
        pixels = np.stack([column, row], axis=1) + moved.astype(float)
        local = rays[row, column] * depth_m[number, row, column][:, None]
        poses[number] = _pose(transform(pose, local), pixels, cameras)
    return poses


def select_keypoints(
    gray: UInt8[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"]
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the usable pixels with the strongest gradient."""
    down, right = np.gradient(gray.astype(float))
    strength = np.where(usable, np.hypot(down, right), -1.0)
    order = np.argsort(strength, axis=None, kind="stable")[::-1][
        : min(MAX_KEYPOINTS, int(usable.sum()))
    ]
    row, column = np.unravel_index(order, gray.shape)
    return row, column


def _pose(
    points_m: Float[np.ndarray, "n 3"], pixels: Float[np.ndarray, "n 2"], cameras: Cameras
) -> Float[np.ndarray, "4 4"]:
    """Return `world_from_camera` of the camera that sees the points at the pixels, or NaN."""
    import cv2

    cv2.setRNGSeed(0)  # RANSAC draws from OpenCV's global generator
    intrinsics = cameras.intrinsics_px.astype(float)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points_m,
        pixels,
        intrinsics,
        None,
        iterationsCount=300,
        reprojectionError=INLIER_THRESHOLD_PX,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < MIN_INLIERS:
        return np.full((4, 4), np.nan)
    near = inliers[:, 0].astype(int)
    rotation, translation = cv2.solvePnPRefineLM(
        points_m[near], pixels[near], intrinsics, None, rotation, translation
    )
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3] = cv2.Rodrigues(rotation)[0]
    camera_from_world[:3, 3] = translation[:, 0]
    return invert(camera_from_world)


def camera_errors(
    world_from_camera: Float[np.ndarray, "f 4 4"], target: Float[np.ndarray, "f 4 4"]
) -> tuple[float, float]:
    """Return the RMS errors of position in meters and of rotation in degrees.

    Frames without a finite pose are ignored: report their number, too. NaN if no pose is finite.
    """
    located = np.isfinite(world_from_camera).all(axis=(1, 2))
    if not located.any():
        return float("nan"), float("nan")
    between = invert(target[located]) @ world_from_camera[located]
    meters = np.linalg.norm(between[:, :3, 3], axis=1)
    return _rms(meters), _rms(rotation_angles_deg(between))


class PathErrors(NamedTuple):
    """Errors of a camera path with unknown scale and world frame, such as an estimated path."""

    rotation_deg: float
    """RMS angle in degrees between the rotations relative to the first frame."""
    translation: float
    """RMS distance of positions relative to the first frame, each path divided by its extent."""
    ate: float
    """RMS distance of the positions after a least-squares scale, in the target's unit."""


def path_errors(
    world_from_camera: Float[np.ndarray, "f 4 4"], target: Float[np.ndarray, "f 4 4"]
) -> PathErrors:
    """Return the errors of a path relative to its first camera, independent of its scale.

    The extent of a path is the maximum distance from its first camera, or 1 if it does not move.
    Frames without a finite pose are ignored. NaN if the first pose is not finite, or no other is.
    """
    located = np.asarray(np.isfinite(world_from_camera).all(axis=(1, 2)))
    if not located[0] or located.sum() < 2:
        return PathErrors(float("nan"), float("nan"), float("nan"))
    estimated, wanted = (invert(p[0]) @ p[located] for p in (world_from_camera, target))
    between = invert(wanted) @ estimated
    here, there = estimated[:, :3, 3], wanted[:, :3, 3]
    strength = np.square(here).sum()
    scale = max((here * there).sum() / strength, 0.0) if strength else 1.0
    return PathErrors(
        rotation_deg=_rms(rotation_angles_deg(between)),
        translation=_rms(np.linalg.norm(here / _extent(here) - there / _extent(there), axis=1)),
        ate=_rms(np.linalg.norm(scale * here - there, axis=1)),
    )


def _extent(positions: Float[np.ndarray, "f 3"]) -> float:
    """Return the maximum distance from the first camera, or 1 for a camera that does not move."""
    extent = float(np.linalg.norm(positions, axis=1).max())
    return extent if extent > MIN_EXTENT else 1.0


def _rms(values: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
