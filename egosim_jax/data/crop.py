"""Fit images to another size: scale both axes alike, and crop what is too much, about the center.

Intrinsics follow. A crop that loses more than 40 % of the image, such as landscape from portrait,
is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.types import InputError

MIN_KEPT = 0.6
"""Minimum fraction of the image that a crop must keep."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Crop:
    """Scale and crop that fit an image to a size."""

    height: int
    """Height of the result in pixels."""
    width: int
    """Width of the result in pixels."""
    scale: float
    """Pixels of the result per pixel of the image."""
    offset_px: tuple[float, float]
    """Column and row, in the resized image, of the result's first pixel."""

    def intrinsics(self, source_px: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """Return the intrinsics of the result, given the image's, both in pixels."""
        fitted = np.array(source_px, float)
        fitted[:2] *= self.scale
        fitted[:2, 2] += (self.scale - 1) / 2 - np.array(self.offset_px)
        return fitted

    def source_intrinsics(self, fitted_px: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
        """Return the intrinsics of the image, given the result's, both in pixels."""
        source = np.array(fitted_px, float)
        source[:2, 2] += np.array(self.offset_px) - (self.scale - 1) / 2
        source[:2] /= self.scale
        return source

    def fit(self, frame: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """Return an image, resized (by area if smaller) and cropped."""
        import cv2

        rows, columns = self._resized(frame)
        how = cv2.INTER_AREA if self.scale < 1 else cv2.INTER_CUBIC
        same = (rows, columns) == frame.shape[:2]
        return self.cut(frame if same else cv2.resize(frame, (columns, rows), interpolation=how))

    def fit_smoothly(
        self, frame: UInt8[np.ndarray, "h w 3"]
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Return an image, resized as the input of a model (`resize_image`) and cropped."""
        from egosim_jax.data.transforms import resize_image

        return self.cut(resize_image(frame, *self._resized(frame)))

    def fit_nearest(self, values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "height width"]:
        """Return a map, such as depth, resized by nearest neighbor and cropped."""
        import cv2

        rows, columns = self._resized(values)
        return self.cut(cv2.resize(values, (columns, rows), interpolation=cv2.INTER_NEAREST))

    def cut(self, resized: np.ndarray) -> np.ndarray:
        """Crop a resized image."""
        left, top = (round(offset) for offset in self.offset_px)
        return resized[top : top + self.height, left : left + self.width]

    def _resized(self, image: np.ndarray) -> tuple[int, int]:
        return round(image.shape[0] * self.scale), round(image.shape[1] * self.scale)


def plan_crop(source: tuple[int, int], size: tuple[int, int], *, name: str, fix: str) -> Crop:
    """Return how an image of a height and width is fitted to another height and width.

    Raises `InputError`, which ends with `fix`, if the shapes differ too much.
    """
    (rows, columns), (height, width) = source, size
    scale = max(height / rows, width / columns)
    kept = height * width / (rows * columns * scale**2)
    if kept < MIN_KEPT:
        raise InputError(
            f"{name} is {columns}x{rows}: {width}x{height} would keep {kept:.0%} of the image, "
            f"less than {MIN_KEPT:.0%}. {fix}"
        )
    rest = round(columns * scale) - width, round(rows * scale) - height
    return Crop(
        height=height,
        width=width,
        scale=scale,
        offset_px=(float(rest[0] // 2), float(rest[1] // 2)),
    )
