"""Camera trajectories: poses and intrinsics, checked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.types.settings import InputError
from egosim_jax.types.shown import Shown

FOCAL_WIDTHS = (0.1, 20.0)
"""Minimum and maximum plausible focal length, in image widths."""
MAX_SKEW = 0.1
"""Maximum plausible skew of the pixels, in focal lengths."""


@no_type_check
@dataclass(frozen=True, kw_only=True, repr=False)
class Cameras(Shown):
    """Camera trajectory: one pose per frame, in OpenCV axes (x right, y down, z forward)."""

    world_from_camera: Float[np.ndarray, "f 4 4"]
    """Rigid transforms, in meters."""
    intrinsics_px: Float[np.ndarray, "3 3"]
    """Focal lengths and principal point in pixels, with pixel centers at integer coordinates."""
    height: int
    """Image rows in pixels."""
    width: int
    """Image columns in pixels."""

    def __post_init__(self) -> None:
        """Check shapes, that every pose is a rigid transform, and the intrinsics and image size."""
        for name, shape in (("world_from_camera", (4, 4)), ("intrinsics_px", (3, 3))):
            value = getattr(self, name)
            have, dtype = np.shape(value), getattr(value, "dtype", None)
            if have[-2:] != shape or len(have) != (3 if name == "world_from_camera" else 2):
                raise InputError(
                    f"{name} has shape {have}: it must be "
                    f"{'(frames, 4, 4)' if shape == (4, 4) else '(3, 3)'}."
                )
            if 0 in have or dtype is None or dtype.kind not in "fiu":
                raise InputError(
                    f"{name} is {dtype or type(value).__name__} {have}: it must be an array of "
                    "numbers, with at least one frame of poses."
                )
        check_rigid(self.world_from_camera)
        self._check_intrinsics()

    def _check_intrinsics(self) -> None:
        (fx, skew, cx), (_, fy, cy), _ = matrix = np.asarray(self.intrinsics_px, float)
        sizes = self.height, self.width
        written = f"intrinsics_px {matrix.tolist()}, width {self.width}, height {self.height}"
        integers = all(hasattr(size, "__index__") for size in sizes)
        if not (integers and np.isfinite(matrix).all() and min(fx, fy, *sizes) > 0):
            raise InputError(
                f"Cameras have invalid intrinsics or image size: {written}. All must be finite, "
                "focal lengths positive, sizes positive whole numbers."
            )
        low, high = FOCAL_WIDTHS[0] * self.width, FOCAL_WIDTHS[1] * self.width
        plausible = np.abs(matrix[[1, 2, 2, 2], [0, 0, 1, 2]] - [0, 0, 0, 1]).max() < 1e-6
        plausible &= low <= min(fx, fy) and max(fx, fy) <= high and abs(skew) <= MAX_SKEW * fx
        plausible &= -0.5 <= cx <= self.width - 0.5 and -0.5 <= cy <= self.height - 0.5
        if not plausible:
            raise InputError(
                f"Cameras have implausible intrinsics: {written}. They must be [fx, skew, cx], "
                f"[0, fy, cy], [0, 0, 1] in pixels of this size: focal lengths from {low:g} to "
                f"{high:g}, the principal point inside the image. Do not transpose or normalize "
                "them, and scale them to the clip's size."
            )


def check_rigid(world_from_camera: Float[np.ndarray, "f 4 4"]) -> None:
    """Raise `InputError` at the first camera pose that is not a rigid transform."""
    rigid = is_rigid(world_from_camera)
    if not rigid.all():
        frame = int(np.argmin(rigid))
        raise InputError(
            f"Camera pose at frame {frame} is not a rigid transform: it must be finite, with a "
            "rotation of determinant 1 and the last row 0 0 0 1, not "
            f"{world_from_camera[frame].tolist()}."
        )


def is_rigid(poses: Float[np.ndarray, "f 4 4"]) -> Bool[np.ndarray, " f"]:
    """Return which poses are rigid transforms."""
    rigid = np.asarray(np.isfinite(poses).all(axis=(1, 2)))
    poses = np.where(rigid[:, None, None], poses, np.eye(4))
    rotations = poses[:, :3, :3]
    drift = np.abs(rotations @ rotations.swapaxes(-1, -2) - np.eye(3)).max(axis=(1, 2))
    rigid &= (drift < 1e-3) & (np.linalg.det(rotations) > 0)
    return rigid & (np.abs(poses[:, 3] - [0, 0, 0, 1]).max(axis=1) < 1e-6)
