"""Scene points of a capture, with colors and observations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Float32, Int32, UInt8

from egosim_jax.types import InputError

MAX_POINTS = 1 << 26
"""Maximum number of points, and of observations."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class ScenePoints:
    """Scene points, with colors and the pixels that observe them where known."""

    points_m: Float32[np.ndarray, "p 3"]
    """World positions, in the unit of the camera poses."""
    colors: UInt8[np.ndarray, "p 3"] | None = None
    """Colors of the points."""
    error_px: Float32[np.ndarray, " p"] | None = None
    """Mean reprojection error of each point, in pixels."""
    frames: Int32[np.ndarray, " o"] | None = None
    """Frame index of each observation, from the recording's first frame."""
    indices: Int32[np.ndarray, " o"] | None = None
    """Point index of each observation."""
    pixels_px: Float32[np.ndarray, "o 2"] | None = None
    """Column and row of each observation, in pixels."""

    def __post_init__(self) -> None:
        """Check dtypes, shapes, ranges and that all values are finite."""
        if np.ndim(self.points_m) != 2 or not 0 < len(self.points_m) <= MAX_POINTS:
            raise InputError(
                f"points_m has shape {np.shape(self.points_m)}: it must be (points, 3) with 1 to "
                f"{MAX_POINTS:,} points. Give None if no point is known."
            )
        observations = self.frames, self.indices, self.pixels_px
        present = [value is not None for value in observations]
        if any(present) != all(present):
            raise InputError("frames, indices and pixels_px of the points must be given together.")
        count = len(self.points_m)
        seen = 0 if self.frames is None else int(np.size(self.frames))
        for name, dtype, shape in (
            ("points_m", "float32", (count, 3)), ("colors", "uint8", (count, 3)),
            ("error_px", "float32", (count,)), ("frames", "int32", (seen,)),
            ("indices", "int32", (seen,)), ("pixels_px", "float32", (seen, 2)),
        ):  # fmt: skip
            value = getattr(self, name)
            if value is None:
                continue
            actual = f"{getattr(value, 'dtype', type(value).__name__)} {np.shape(value)}"
            if actual != f"{dtype} {shape}" or not np.isfinite(value).all():
                raise InputError(
                    f"{name} of the points is {actual}: it must be finite {dtype} {shape}."
                )
        if seen > MAX_POINTS:
            raise InputError(f"{seen:,} observations exceed the maximum, {MAX_POINTS:,}.")
        if self.indices is not None and seen:
            low, high = int(self.indices.min()), int(self.indices.max())
            if not 0 <= low <= high < count:
                raise InputError(
                    f"Observations name points {low} to {high}: there are {count}, counted from 0."
                )

    def within(self, start: int, stop: int) -> ScenePoints:
        """Return the points with the observations in a range of frames, renumbered from 0."""
        if self.frames is None or self.indices is None or self.pixels_px is None:
            return self
        kept = (self.frames >= start) & (self.frames < stop)
        return replace(
            self,
            frames=self.frames[kept] - np.int32(start),
            indices=self.indices[kept],
            pixels_px=self.pixels_px[kept],
        )
