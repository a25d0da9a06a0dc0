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

Box = tuple[int, int, int, int]
"""Left, top, right and bottom in pixels."""


def color_of(number: int) -> tuple[int, int, int]:
    """Return the RGB color of an object id."""
    red, green, blue = colorsys.hsv_to_rgb(GOLDEN * number % 1, 0.75, 1.0)
    return round(255 * red), round(255 * green), round(255 * blue)


def draw_objects(view: View, names: Mapping[int, str]) -> UInt8[np.ndarray, "f h w 3"]:
    """Return the frames of a view with colored objects and their names."""
    numbers = np.unique(view.object_ids[view.object_ids > 0]).tolist()
    frames = view.frames.copy()
    for number in numbers:
        pixels = view.object_ids == number
        tinted = (1 - TINT) * view.frames[pixels] + TINT * np.array(color_of(number))
        frames[pixels] = np.rint(tinted).astype(np.uint8)
    return np.stack(
        [
            _write_names(frame, ids, {n: object_name(n, names) for n in numbers})
            for frame, ids in zip(frames, view.object_ids, strict=True)
        ]
    )


def _write_names(frame: np.ndarray, ids: np.ndarray, names: Mapping[int, str]) -> np.ndarray:
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    taken: list[Box] = []
    for number, name in names.items():
        rows, columns = np.nonzero(ids == number)
        if len(rows):
            left, top, right, bottom = map(round, draw.textbbox((0, 0), name, stroke_width=1))
            size = right - left, bottom - top
            middle = round(np.median(columns)), round(np.median(rows))
            box = _free_box(middle, size, image.size, taken)
            taken.append(box)
            place = (box[0] - left, box[1] - top)
            draw.text(place, name, fill="white", stroke_width=1, stroke_fill="black")
    return np.asarray(image)


def _free_box(
    middle: tuple[int, int],
    size: tuple[int, int],
    image: tuple[int, int],
    taken: list[Box],
) -> Box:
    """Return a box around a point, inside the image.

    It is the nearest above or below that meets no taken box, if there is one.
    """
    (width, height), (x, y) = size, middle
    left = min(max(x - width // 2, 0), max(image[0] - width, 0))
    last = max(image[1] - height, 0)
    start = min(max(y - height // 2, 0), last)
    tops = sorted(range(last + 1), key=lambda top: abs(top - start))
    boxes = [(left, top, left + width, top + height) for top in tops]
    return next((box for box in boxes if not any(_meet(box, other) for other in taken)), boxes[0])


def _meet(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
