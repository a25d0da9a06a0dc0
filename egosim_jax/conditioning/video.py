"""Conversion of pixels between uint8 RGB on disk and [-1, 1] in the models.

    to the model     x = p / 127.5 - 1
    from the model   p = floor((x + 1) / 2 * 255), x clipped to [-1, 1]

The EgoSim release truncates rather than rounds: p = 255 takes x = 1 exactly, and there and back
again some levels come out one lower (63 of the 256 in NumPy), where float32 left x a hair too
small. Both directions serve NumPy and jax arrays.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import numpy as np

Numbers = TypeVar("Numbers", np.ndarray, jax.Array)


def to_model(frames: Numbers) -> Numbers:
    """Convert RGB in uint8, of any shape, to float32 in [-1, 1]."""
    return frames.astype(np.float32) / 127.5 - 1


def to_uint8(video: Numbers) -> Numbers:
    """Convert RGB in [-1, 1], of any shape, to uint8, clipped."""
    return ((video.clip(-1, 1) + 1) / 2 * 255).astype(np.uint8)
