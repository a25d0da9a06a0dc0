"""Fit images to another size: scale both axes alike, and crop the rest about the center.

Intrinsics follow. A crop that loses more than 40 % of the image, such as landscape from portrait,
is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

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

    def resample(self, image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """Return the image cropped and resized by LANCZOS, as the input of a model is."""
        rows, columns = image.shape[:2]
        left, top = (offset / self.scale for offset in self.offset_px)
        box = left, top, left + self.width / self.scale, top + self.height / self.scale
        ends = np.clip(np.round(box, 6), 0, [columns, rows, columns, rows]).tolist()
        resized = Image.fromarray(image).resize(
            (self.width, self.height), Image.Resampling.LANCZOS, box=ends
        )
        return np.asarray(resized)


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
    return Crop(
        height=height,
        width=width,
        scale=scale,
        offset_px=((columns * scale - width) / 2, (rows * scale - height) / 2),
    )
