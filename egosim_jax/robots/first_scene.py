"""First frame of a recording of a robot: without the robot, and with depth in meters.

The robot's model, drawn in the described camera, says which pixels it covers and how far they are.
Measured depth must agree with it, and estimated depth is scaled by it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from egosim_jax.geometry import pixel_rays
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimator, Verdict
from egosim_jax.robots.background import EDGE, INPAINT_PX, dilated
from egosim_jax.robots.drawing import Shape
from egosim_jax.robots.recorded import Replay
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop.embree import Rays

DEPTH_RATIO = 1.15
"""Largest ratio of measured depth and the robot's own, or of its inverse."""
MIN_PIXELS = 50
"""Least number of pixels of the robot for a comparison of depth."""


def robot_depth(replay: Replay) -> Float32[np.ndarray, "h w"]:
    """Return the depth of the robot's model in the first frame; infinite where it is not."""
    camera = replay.camera
    pose = camera.world_from_camera[0]
    shape = Shape(robot=replay.robot)
    meshes = shape.pose(replay.q[0], float(replay.opening_m[0]), np.eye(4))
    rays = pixel_rays(camera.intrinsics_px, height=camera.height, width=camera.width)
    towards = (rays.reshape(-1, 3) @ pose[:3, :3].T).astype(np.float32)
    eye = np.broadcast_to(pose[:3, 3].astype(np.float32), towards.shape)
    return Rays(meshes).cast(eye, towards).distances.reshape(camera.height, camera.width)


def depth_ratio(
    depth_m: Float[np.ndarray, "h w"], robot_m: Float32[np.ndarray, "h w"]
) -> float | None:
    """Return the median ratio of depth and the robot's own; None with too few pixels of both."""
    edge = max(1, round(EDGE * depth_m.shape[1]))
    inside = ~dilated(~np.isfinite(robot_m), edge) & np.isfinite(depth_m) & (depth_m > 0)
    if inside.sum() < MIN_PIXELS:
        return None
    return float(np.median(depth_m[inside] / robot_m[inside]))


def check_depth(replay: Replay, depth_m: np.ndarray, robot_m: np.ndarray, *, name: str) -> None:
    """Raise `InputError` if measured depth contradicts the place of the robot in the image."""
    ratio = depth_ratio(depth_m, robot_m)
    if ratio is not None and not 1 / DEPTH_RATIO <= ratio <= DEPTH_RATIO:
        raise InputError(
            f"{name}: the depth at the robot in the first frame is {ratio:.3g} times the distance "
            "of its model: they may differ by 15 %. Depth must be in meters, of the first frame, "
            "and the camera's pose must be calibrated. (--depth, camera.base_from_camera)"
        )


def without_robot(
    replay: Replay, robot_m: Float32[np.ndarray, "h w"]
) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"]]:
    """Return the first frame with the robot inpainted, and the mask of its pixels and edge."""
    import cv2

    mask = dilated(np.isfinite(robot_m), max(1, round(EDGE * replay.camera.width)))
    image = cv2.inpaint(replay.first, mask.astype(np.uint8), INPAINT_PX, cv2.INPAINT_TELEA)
    return image.astype(np.uint8), mask


def estimate_depth(
    replay: Replay, robot_m: Float32[np.ndarray, "h w"], estimator: DepthEstimator, *, name: str
) -> Float32[np.ndarray, "h w"]:
    """Return the estimated depth of the first frame, scaled so that the robot is at its own.

    Raises `InputError` if the robot covers too few pixels for a scale.
    """
    verdict = Verdict(rung="given", reason="calibrated to the robot", figures={})
    cameras = CameraEstimate(cameras=replay.camera, metric=True, verdict=verdict)
    covered = np.isfinite(robot_m)
    depth = estimator(replay.first[None], covered[None], cameras, [0])
    ratio = depth_ratio(depth.depth_m[0], robot_m)
    if ratio is None:
        raise InputError(
            f"{name}: the robot covers fewer than {MIN_PIXELS} pixels of the first frame, so the "
            "estimated depth has no scale: give measured depth, or a state. (--depth, --state)"
        )
    return depth.depth_m[0] / np.float32(ratio)
