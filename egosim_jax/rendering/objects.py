"""Views whose objects have a color and a name each."""

from __future__ import annotations

import colorsys
from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw

from egosim_jax.types import View, object_name

TINT = 0.6
"""Weight of an object's color in a view."""
GOLDEN = 0.618034
"""Step of the hue from one id to the next: few steps give hues that are far apart."""


def color_of(number: int) -> tuple[int, int, int]:
    """Return the RGB color of an object id."""
    red, green, blue = colorsys.hsv_to_rgb(GOLDEN * number % 1, 0.75, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def draw_objects(view: View, names: Mapping[int, str]) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the frames of a view with colored objects and their names."""
    numbers = np.unique(view.object_ids[view.object_ids > 0]).tolist()
    frames = view.frames.copy()
    for number in numbers:
        own = view.object_ids == number
        tinted = (1 - TINT) * view.frames[own] + TINT * np.array(color_of(number))
        frames[own] = np.rint(tinted).astype(np.uint8)
    return np.stack(
        [
            _write_names(frame, ids, {n: object_name(n, names) for n in numbers})
            for frame, ids in zip(frames, view.object_ids, strict=True)
        ]
    )


def _write_names(frame: np.ndarray, ids: np.ndarray, names: Mapping[int, str]) -> np.ndarray:
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    for number, name in names.items():
        rows, columns = np.nonzero(ids == number)
        if len(rows):
            middle = float(np.median(columns)), float(np.median(rows))
            style = {"anchor": "mm", "stroke_width": 1, "stroke_fill": "black"}
            draw.text(middle, name, fill="white", **style)
    return np.asarray(image)
