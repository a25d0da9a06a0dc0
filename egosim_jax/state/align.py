"""Alignment of a reconstruction to the world by its cameras.

Alignments are 4 x 4 matrices `world_from_reconstruction`, rigid or with one scale, applied as
p -> s R p + t. Source: EgoSim, section 3.3 (Sim(3) Umeyama alignment); the released
`reconstruct_from_artifacts` has the same methods, and rigid as its default.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from egosim_jax.geometry import umeyama
from egosim_jax.types import InputError
from egosim_jax.types.arrays import Pose, Poses

CameraMethod = Literal["centers", "orientations", "orientations and scale"]
"""Camera alignment method.

`centers` is Umeyama on camera centers with a scale; `orientations` is the mean rotation between the
cameras and then the translation between their centers, without or with a scale."""


def align_cameras(
    reconstruction_from_camera: Poses,
    world_from_camera: Poses,
    *,
    method: CameraMethod = "orientations",
) -> Pose:
    """Return `world_from_reconstruction` from cameras that are known in both.

    Orientations need one camera (two for a scale); centers alone need three non-collinear ones.
    If the centers coincide and determine no scale, it is 1.
    """
    _check_finite(reconstruction_from_camera, world_from_camera)
    targets, centers = world_from_camera[:, :3, 3], reconstruction_from_camera[:, :3, 3]
    if method == "centers":
        return umeyama(centers, targets, scaled=True)
    products = world_from_camera[:, :3, :3] @ reconstruction_from_camera[:, :3, :3].swapaxes(1, 2)
    u, _, vt = np.linalg.svd(products.sum(axis=0))
    motion = np.eye(4)
    motion[:3, :3] = (u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    if method == "orientations and scale":
        rotated = (centers - centers.mean(axis=0)) @ motion[:3, :3].T
        spread = np.square(rotated).sum()
        products = rotated * (targets - targets.mean(axis=0))
        scale = products.sum() / spread if spread > 1e-12 else 1.0
        # Nearly coinciding centers give scales that are only noise.
        motion[:3, :3] *= scale if 0 < scale <= 100 else 1.0
    motion[:3, 3] = targets.mean(axis=0) - motion[:3, :3] @ centers.mean(axis=0)
    return motion


def _check_finite(*arrays: np.ndarray) -> None:
    for array in arrays:
        if not np.isfinite(array).all():
            bad = int(np.argmin(np.isfinite(array).all(axis=tuple(range(1, array.ndim)))))
            raise InputError(
                f"Camera pose {bad} is not finite and cannot be aligned: {array[bad].tolist()}."
            )
