"""Metric hands in the camera, from keypoints in pixels and the shape of a hand of mean size.

Let w be a keypoint up to the hand's translation T, and (x, y, 1) the ray through its pixel. Each
keypoint gives two linear equations in T: x (T_z + w_z) = T_x + w_x, and the same for y. Least
squares gives T, and so the depth T_z + w_z of each keypoint. The lifted keypoint is on its ray at
that depth, so a drawn skeleton coincides with the observed hand.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from egosim_jax.perception.estimates import HandTracks


def lift(
    tracks: HandTracks, intrinsics_px: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "f 2 21 3"]:
    """Return the hands' keypoints in meters, in the camera of each frame; NaN if missing.

    A hand also counts as missing if its fit has a keypoint behind the camera.
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
    """Return the depth of each hand's keypoints by least squares."""
    matrix = np.zeros((*rays.shape, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = 1
    matrix[..., 2] = -rays
    wanted = rays * joints_hand_m[..., 2:] - joints_hand_m[..., :2]
    matrix = matrix.reshape(len(rays), -1, 3)
    solution = np.linalg.pinv(matrix) @ wanted.reshape(len(rays), -1, 1)
    return solution[:, 2] + joints_hand_m[..., 2]
