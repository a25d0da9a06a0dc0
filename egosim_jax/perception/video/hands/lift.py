"""Metric hands in the camera, from keypoints in pixels and the shape of a hand of mean size.

Let w be a keypoint up to the hand's translation T, and (x, y, 1) the ray through its pixel. Each
keypoint gives two linear equations in T: x (T_z + w_z) = T_x + w_x, and the same for y. Least
squares gives T, and so the depth T_z + w_z of each keypoint. The lifted keypoint is on its ray at
that depth, so a drawn skeleton coincides with the observed hand.
"""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from jaxtyping import Float

from egosim_jax.perception.video.estimates import HandTracks
from egosim_jax.types.arrays import Matrix

PALM_BONES = np.array([(0, 5), (0, 9), (0, 13), (0, 17), (5, 17)])
"""Pairs of joints whose distance stays equal in a hand."""
SMOOTH_S = 0.12
"""Standard deviation of the smoothing of depth over time, in seconds."""


def lift(tracks: HandTracks, intrinsics_px: Matrix) -> Float[np.ndarray, "f 2 21 3"]:
    """Return the hands' keypoints in meters, in the camera of each frame; NaN if missing.

    A hand also counts as missing if its fit has a keypoint behind the camera.
    """
    pixels = np.concatenate([tracks.joints_px, np.ones_like(tracks.joints_px[..., :1])], axis=-1)
    rays = pixels @ np.linalg.inv(intrinsics_px).T
    rays /= rays[..., 2:]
    visible = np.isfinite(tracks.joints_px).all((-1, -2)) & np.isfinite(tracks.joints_hand_m).all(
        (-1, -2)
    )
    joints_m = np.full(rays.shape, np.nan)
    if not visible.any():
        return joints_m
    depth = _depths(rays[visible][..., :2], tracks.joints_hand_m[visible])
    depth[(depth <= 0).any(-1)] = np.nan
    joints_m[visible] = rays[visible] * depth[..., None]
    return joints_m


def steady(joints_m: Float[np.ndarray, "f n 21 3"], fps: Fraction) -> Float[np.ndarray, "f n 21 3"]:
    """Return lifted hands of constant size whose depth changes smoothly.

    The size of a lifted hand, and with it the depth, has an error that changes from frame to frame.
    Keypoints stay on their rays.
    """
    result = joints_m.copy()
    for hand in range(joints_m.shape[1]):
        frames = np.flatnonzero(np.isfinite(joints_m[:, hand]).all(axis=(1, 2)))
        if not len(frames):
            continue
        joints = joints_m[frames, hand]
        start, end = joints[:, PALM_BONES].transpose(2, 0, 1, 3)
        lengths = np.linalg.norm(end - start, axis=-1)
        size = np.median(lengths / np.median(lengths, axis=0), axis=1)
        depth = joints[:, np.unique(PALM_BONES), 2].mean(axis=1)
        apart_s = (frames[:, None] - frames) / float(fps)
        weights = np.exp(-0.5 * (apart_s / SMOOTH_S) ** 2)
        smooth = np.exp(weights @ np.log(depth / size) / weights.sum(axis=1))
        result[frames, hand] *= (smooth / depth)[:, None, None]
    return result


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
