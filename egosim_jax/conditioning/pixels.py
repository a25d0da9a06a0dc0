"""Pixel ranges: between uint8 RGB and [-1, 1], and the first frame for the CLIP image encoder.

    to the model     x = p / 127.5 - 1
    from the model   p = floor((x + 1) / 2 * 255), x clipped to [-1, 1]

The EgoSim release truncates rather than rounds: p = 255 takes x = 1 exactly. Of the 256 levels, 63
return one lower in NumPy, where float32 left x slightly too small.

For CLIP, Wan 2.1 takes an image in [-1, 1], resizes it to the encoder's square, maps it to [0, 1]
and normalizes it with CLIP's statistics:

    pixels = (x / 2 + 1/2 - mean) / std

The EgoSim release passes an image in [0, 1] instead, in training too, so its encoder saw only the
upper half of the range. `image_range="unit"` reproduces that; "signed" is Wan's.

The resize is bicubic without antialiasing, on a grid of cells (not of corners), as torch's
`interpolate`. Output cell i is centered on s = (i + 1/2) n_in / n_out - 1/2 and weighs the four
cells around s, at distances d, by Keys' kernel (1981) with a = -3/4, the edge cells repeated:

    k(d) = (a + 2) d^3 - (a + 3) d^2 + 1              d <= 1
    k(d) = a d^3 - 5 a d^2 + 8 a d - 4 a              1 < d < 2
"""

from __future__ import annotations

from typing import Literal, TypeVar

import jax
import numpy as np
from jaxtyping import Float, UInt8

MEAN = np.array([0.48145466, 0.4578275, 0.40821073], np.float32)
"""CLIP's mean of RGB in [0, 1]."""
STD = np.array([0.26862954, 0.26130258, 0.27577711], np.float32)
"""CLIP's standard deviation of RGB in [0, 1]."""
KEYS_A = -0.75

Numbers = TypeVar("Numbers", np.ndarray, jax.Array)


def to_model(frames: Numbers) -> Numbers:
    """Convert RGB in uint8, of any shape, to float32 in [-1, 1]."""
    return frames.astype(np.float32) / 127.5 - 1


def to_uint8(video: Numbers) -> Numbers:
    """Convert RGB in [-1, 1], of any shape, to uint8, clipped."""
    return ((video.clip(-1, 1) + 1) / 2 * 255).astype(np.uint8)


def clip_pixels(
    frames: UInt8[np.ndarray, "b h w 3"],
    *,
    image_size: int,
    image_range: Literal["unit", "signed"],
) -> Float[np.ndarray, "b {image_size} {image_size} 3"]:
    """Return the image encoder's normalized float32 input for frames of the model's size."""
    _, height, width, _ = frames.shape
    x = frames.astype(np.float32) / 255
    if image_range == "signed":
        x = 2 * x - 1
    x = np.einsum("ih,bhwc->biwc", bicubic(height, image_size), x, optimize=True)
    x = np.einsum("jw,biwc->bijc", bicubic(width, image_size), x, optimize=True)
    return (x / 2 + 0.5 - MEAN) / STD


def bicubic(size_in: int, size_out: int) -> Float[np.ndarray, "{size_out} {size_in}"]:
    """Return the matrix that resizes one axis."""
    center = (np.arange(size_out) + 0.5) * size_in / size_out - 0.5
    matrix = np.zeros((size_out, size_in))
    for tap in range(-1, 3):
        cell = np.floor(center).astype(int) + tap
        np.add.at(
            matrix,
            (np.arange(size_out), cell.clip(0, size_in - 1)),
            _keys(np.abs(center - cell)),
        )
    return matrix.astype(np.float32)


def _keys(d: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    a = KEYS_A
    near = (a + 2) * d**3 - (a + 3) * d**2 + 1
    far = a * d**3 - 5 * a * d**2 + 8 * a * d - 4 * a
    return np.where(d <= 1, near, far)
