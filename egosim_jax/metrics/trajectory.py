"""Where a generated video was seen from. The paper's Cam ERR has no formula; this is our own.

The true scene is known at every frame. Dense optical flow from the true frame to the generated one
says where each of its points went, and the camera that sees them there is found by PnP (RANSAC,
then least squares). On the true frames themselves the error is 0.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from egosim_jax.geometry import invert, pixel_rays, transform
from egosim_jax.types import Cameras

MOST, LEAST = 800, 12
"""Points that are followed, where the picture changes most, and points that a pose takes."""
TOLERANCE_PX = 1.0
"""How far off a point may be that counts."""


def seen_from(
    frames: UInt8[np.ndarray, "f h w 3"],
    truth: UInt8[np.ndarray, "f h w 3"],
    depth_m: Float32[np.ndarray, "f h w"],
    still: Bool[np.ndarray, "f h w"],
    cameras: Cameras,
) -> Float[np.ndarray, "f 4 4"]:
    """`world_from_camera` that each frame shows; NaN where the points agree on none.

    `depth_m` and `cameras` are those of the true frames, `still` is where they show what does not
    move: no hands and nothing they act on.
    """
    import cv2

    flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    path = np.full((len(frames), 4, 4), np.nan)
    for number, pose in enumerate(cameras.world_from_camera):
        gray = [cv2.cvtColor(picture[number], cv2.COLOR_RGB2GRAY) for picture in (truth, frames)]
        row, column = _telling(gray[0], still[number] & np.isfinite(depth_m[number]))
        if len(row) < LEAST:
            continue
        moved = flow.calc(gray[0], gray[1], None)[row, column]
        pixels = np.stack([column, row], axis=1) + moved.astype(float)
        there = rays[row, column] * depth_m[number, row, column][:, None]
        path[number] = _pose(transform(pose, there), pixels, cameras)
    return path


def _telling(
    gray: UInt8[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"]
) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the usable pixels where the picture changes most."""
    down, right = np.gradient(gray.astype(float))
    strength = np.where(usable, np.hypot(down, right), -1.0)
    order = np.argsort(strength, axis=None, kind="stable")[::-1][: min(MOST, int(usable.sum()))]
    row, column = np.unravel_index(order, gray.shape)
    return row, column


def _pose(
    places_m: Float[np.ndarray, "n 3"], pixels: Float[np.ndarray, "n 2"], cameras: Cameras
) -> Float[np.ndarray, "4 4"]:
    """`world_from_camera` of the camera that sees the places at the pixels, or NaN."""
    import cv2

    cv2.setRNGSeed(0)
    intrinsics = cameras.intrinsics_px.astype(float)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        places_m,
        pixels,
        intrinsics,
        None,
        iterationsCount=300,
        reprojectionError=TOLERANCE_PX,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < LEAST:
        return np.full((4, 4), np.nan)
    near = inliers[:, 0].astype(int)
    turn, shift = cv2.solvePnPRefineLM(places_m[near], pixels[near], intrinsics, None, turn, shift)
    camera_from_world = np.eye(4)
    camera_from_world[:3, :3], camera_from_world[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
    return invert(camera_from_world)


def camera_errors(
    world_from_camera: Float[np.ndarray, "f 4 4"], truth: Float[np.ndarray, "f 4 4"]
) -> tuple[float, float]:
    """Root mean square error of position in meters and of rotation in degrees.

    Frames whose pose is not finite do not count; NaN if none is.
    """
    known = np.isfinite(world_from_camera).all(axis=(1, 2))
    if not known.any():
        return float("nan"), float("nan")
    between = invert(truth[known]) @ world_from_camera[known]
    meters = np.linalg.norm(between[:, :3, 3], axis=1)
    cosines = (np.trace(between[:, :3, :3], axis1=1, axis2=2) - 1) / 2
    degrees = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    return float(np.sqrt(np.mean(meters**2))), float(np.sqrt(np.mean(degrees**2)))
