"""Camera estimates for all frames of a video, from the poses of some frames."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.perception.cameras.gate import Reconstruction
from egosim_jax.perception.cameras.lens import pinhole_focal, to_pinhole
from egosim_jax.perception.estimates import CameraEstimate, Lens, SparsePoints, Verdict
from egosim_jax.types import Cameras


def pinhole(focal_px: float, *, height: int, width: int) -> Float[np.ndarray, "3 3"]:
    """Return intrinsics with the principal point at the image center."""
    return np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1.0]])


def complete_path(
    frames: Int[np.ndarray, " r"], poses: Float[np.ndarray, "r 4 4"], count: int
) -> Float[np.ndarray, "f 4 4"]:
    """Return a pose for each of `count` frames; missing poses are interpolated (slerp).

    `frames` ascends from 0 to `count` - 1.
    """
    import cv2

    path = np.tile(np.eye(4), (count, 1, 1))
    path[frames] = poses
    for index in np.flatnonzero(np.diff(frames) > 1):
        first, last = int(frames[index]), int(frames[index + 1])
        start, end = poses[index], poses[index + 1]
        turn = cv2.Rodrigues(start[:3, :3].T @ end[:3, :3])[0]
        for frame in range(first + 1, last):
            share = (frame - first) / (last - first)
            path[frame, :3, :3] = start[:3, :3] @ cv2.Rodrigues(turn * share)[0]
            path[frame, :3, 3] = (1 - share) * start[:3, 3] + share * end[:3, 3]
    return path


def estimate_from(
    found: Reconstruction, verdict: Verdict, *, frames: int, height: int, width: int
) -> CameraEstimate:
    """Return an accepted reconstruction as a `CameraEstimate` of undistorted frames.

    The first camera is the world frame, and the median depth in the first frame is the unit.
    """
    rotation, offset = found.camera_from_world[:, :, :3], found.camera_from_world[:, :, 3]
    points = found.points @ rotation[0].T + offset[0]
    seen = points[found.observed[found.observed_in == 0]]
    unit = float(np.median(seen[:, 2]))
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    poses[:, :3, :3] = rotation[0] @ rotation.swapaxes(1, 2)
    poses[:, :3, 3] = (offset[0] - np.einsum("fij,fj->fi", poses[:, :3, :3], offset)) / unit
    lens = Lens(focal_px=found.focal_px, radial=found.radial)
    focal = pinhole_focal(lens, height=height, width=width)
    intrinsics = pinhole(focal, height=height, width=width)
    return CameraEstimate(
        cameras=Cameras(
            world_from_camera=complete_path(found.frames, _orthonormal(poses), frames),
            intrinsics_px=intrinsics,
            height=height,
            width=width,
        ),
        metric=False,
        verdict=verdict,
        points=SparsePoints(
            points_m=points / unit,
            error_px=found.error_px,
            frames=found.frames[found.observed_in].astype(np.int32),
            indices=found.observed,
            pixels_px=to_pinhole(found.pixels_px, lens, intrinsics),
        ),
        lens=lens,
    )


def _orthonormal(poses: Float[np.ndarray, "f 4 4"]) -> Float[np.ndarray, "f 4 4"]:
    """Return poses whose rotations are orthonormal up to rounding."""
    u, _, vt = np.linalg.svd(poses[:, :3, :3])
    exact = poses.copy()
    exact[:, :3, :3] = u @ vt
    return exact
