"""Metric hands in the camera from keypoints in pixels and the shape of a mean hand.

With keypoints w of the hand up to a translation T, and rays (x, y, 1) through its pixels, each
keypoint gives two equations that are linear in T: x (T_z + w_z) = T_x + w_x, and the same for y.
The least squares solution gives every keypoint its depth T_z + w_z. The keypoint is then put on its
ray at that depth, so that a drawn skeleton coincides with the observed hand.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from egosim_jax.perception.estimates import HandTracks


def lift(
    tracks: HandTracks, intrinsics_px: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "f 2 21 3"]:
    """Return the keypoints of the hands in meters, in the camera of each frame; NaN if missing.

    A hand whose fit has a keypoint behind the camera is missing, too.
    """
    pixels = np.concatenate([tracks.joints_px, np.ones_like(tracks.joints_px[..., :1])], axis=-1)
    rays = pixels @ np.linalg.inv(intrinsics_px).T
    rays /= rays[..., 2:]
    found = np.isfinite(tracks.joints_px).all((-1, -2)) & np.isfinite(tracks.joints_hand_m).all(
        (-1, -2)
    )
    joints_m = np.full(rays.shape, np.nan)
    if not found.any():
        return joints_m
    depth = _depths(rays[found][..., :2], tracks.joints_hand_m[found])
    depth[(depth <= 0).any(-1)] = np.nan
    joints_m[found] = rays[found] * depth[..., None]
    return joints_m


def _depths(
    rays: Float[np.ndarray, "n 21 2"], joints_hand_m: Float[np.ndarray, "n 21 3"]
) -> Float[np.ndarray, "n 21"]:
    """Return the depth of the keypoints of hands by least squares."""
    matrix = np.zeros((*rays.shape, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1
    matrix[..., 2] = -rays
    wanted = rays * joints_hand_m[..., 2:] - joints_hand_m[..., :2]
    matrix = matrix.reshape(len(rays), -1, 3)
    solution = np.linalg.pinv(matrix) @ wanted.reshape(len(rays), -1, 1)
    return solution[:, 2] + joints_hand_m[..., 2]
