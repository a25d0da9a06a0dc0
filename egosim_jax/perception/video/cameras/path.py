"""Camera estimates for all frames of a video, from the poses of some frames."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.perception.video.cameras.gate import Reconstruction
from egosim_jax.perception.video.cameras.lens import pinhole_focal, to_pinhole
from egosim_jax.perception.video.estimates import CameraEstimate, Lens, SparsePoints, Verdict
from egosim_jax.types import Cameras
from egosim_jax.types.arrays import Matrix, Poses


def pinhole(focal_px: float, *, height: int, width: int) -> Matrix:
    """Return intrinsics with the principal point at the image center."""
    return np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1.0]])


def complete_path(
    frames: Int[np.ndarray, " r"], poses: Float[np.ndarray, "r 4 4"], count: int
) -> Poses:
    """Return a pose for each of `count` frames; missing poses are interpolated (slerp).

    `frames` ascends from 0 to `count` - 1.
    """
    from scipy.spatial.transform import Rotation, Slerp

    if len(frames) == count:
        return poses
    path, every = np.tile(np.eye(4), (count, 1, 1)), np.arange(count)
    path[:, :3, :3] = Slerp(frames, Rotation.from_matrix(poses[:, :3, :3]))(every).as_matrix()
    path[:, :3, 3] = np.stack([np.interp(every, frames, x) for x in poses[:, :3, 3].T], axis=1)
    path[frames] = poses
    return path


def estimate_from(
    scene: Reconstruction, verdict: Verdict, *, frames: int, height: int, width: int
) -> CameraEstimate:
    """Return an accepted reconstruction as a `CameraEstimate` of undistorted frames.

    The first camera is the world frame, and the median depth in the first frame is the unit.
    """
    from scipy.spatial.transform import Rotation

    rotation, offset = scene.camera_from_world[:, :, :3], scene.camera_from_world[:, :, 3]
    points = scene.points @ rotation[0].T + offset[0]
    seen = points[scene.observed[scene.observed_in == 0]]
    unit = float(np.median(seen[:, 2]))
    poses = np.tile(np.eye(4), (len(rotation), 1, 1))
    turns = Rotation.from_matrix(rotation[0] @ rotation.swapaxes(1, 2))
    poses[:, :3, :3] = turns.as_matrix()  # orthonormal up to rounding
    poses[:, :3, 3] = (offset[0] - np.einsum("fij,fj->fi", poses[:, :3, :3], offset)) / unit
    lens = Lens(focal_px=scene.focal_px, radial=scene.radial)
    focal = pinhole_focal(lens, height=height, width=width)
    intrinsics = pinhole(focal, height=height, width=width)
    return CameraEstimate(
        cameras=Cameras(
            world_from_camera=complete_path(scene.frames, poses, frames),
            intrinsics_px=intrinsics,
            height=height,
            width=width,
        ),
        metric=False,
        verdict=verdict,
        points=SparsePoints(
            points_m=points / unit,
            error_px=scene.error_px,
            frames=scene.frames[scene.observed_in].astype(np.int32),
            indices=scene.observed,
            pixels_px=to_pinhole(scene.pixels_px, lens, intrinsics),
        ),
        lens=lens,
    )
