"""Rotations and poses from quaternions and OpenGL axes, as datasets store them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def from_quaternions(xyzw: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 3 3"]:
    """Return rotation matrices of unit quaternions x y z w; NaN for other lengths.

    Lengths from 0.99 to 1.01 are normalized.
    """
    length = np.linalg.norm(xyzw, axis=-1, keepdims=True)
    x, y, z, w = np.moveaxis(xyzw / np.where(np.abs(length - 1) < 0.01, length, np.nan), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def make_poses(
    xyzw: Float[np.ndarray, "f 4"], translations: Float[np.ndarray, "f 3"]
) -> Float[np.ndarray, "f 4 4"]:
    """Return transforms of quaternions x y z w and translations."""
    poses = np.tile(np.eye(4), (len(xyzw), 1, 1))
    poses[:, :3, :3] = from_quaternions(xyzw)
    poses[:, :3, 3] = translations
    return poses


OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Conversion of camera axes from OpenGL's (x right, y up, z backward) to OpenCV's, or back."""
