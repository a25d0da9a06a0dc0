"""Write the images of a capture as the video of a recording."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path, PurePath
from typing import no_type_check

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.data.readers import NOTE
from egosim_jax.data.readers.lenses import Lens, Remap
from egosim_jax.io.bounded import quote_text
from egosim_jax.io.images import read_image
from egosim_jax.io.video import write_frames
from egosim_jax.types import InputError

MAX_IMAGES = 100_000
"""Maximum number of images in a capture."""
MAX_JUMP = 1.5
"""Maximum ratio between the step of two numbers and the usual step of a capture."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class ImageVideo:
    """Video written from images, and its pinhole camera."""

    path: Path
    frames: int
    height: int
    width: int
    intrinsics_px: Float[np.ndarray, "3 3"]
    remap: Remap | None
    """Remapping of the images; None if their lens is a pinhole."""


def write_images(
    folder: Path, images: Iterable[np.ndarray], lens: Lens, fps: Fraction
) -> ImageVideo:
    """Write images as video.mp4 in a folder; remap them if their lens is not a pinhole."""
    remap = None if lens.is_pinhole() else Remap.of(lens)
    intrinsics = lens.intrinsics_px if remap is None else remap.intrinsics_px
    path = folder / "video.mp4"
    frames = _checked(images, lens) if remap is None else remap.apply(images)
    count, height, width = write_frames(path, frames, fps)
    return ImageVideo(path=path, frames=count, height=height, width=width,
                      intrinsics_px=intrinsics, remap=remap)  # fmt: skip


def _checked(images: Iterable[np.ndarray], lens: Lens) -> Iterator[np.ndarray]:
    for number, image in enumerate(images):
        if image.shape[:2] != (lens.height, lens.width):
            raise InputError(
                f"Image {number} has {image.shape[1]}x{image.shape[0]} pixels: its camera is "
                f"calibrated for {lens.width}x{lens.height}. Use the images of that size."
            )
        yield image


def read_posed(path: Path, lens: Lens) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image of a reconstruction, whose lens is for the pixels as they are stored.

    COLMAP and nerfstudio ignore EXIF's orientation. If only the image as it is shown has the size
    of its lens, the reconstruction was made of turned images.
    """
    image = read_image(path, pixels="stored")
    if image.shape[:2] == (lens.height, lens.width):
        return image
    shown = read_image(path)
    return shown if shown.shape[:2] == (lens.height, lens.width) else image


def longest_run(names: Sequence[str], known: Callable[[str], bool]) -> slice:
    """Return the longest contiguous run of known names, because a video has no gaps.

    A run also ends where the numbers in the names jump or another folder begins: images between
    were not registered, or removed.
    """
    follows = [False, *_follow(names)]
    best = run = slice(0, 0)
    for index, name in enumerate(names):
        start = run.start if follows[index] else index
        run = slice(start if known(name) else index + 1, index + 1)
        if run.stop - run.start > best.stop - best.start:
            best = run
    return best


def describe_run(names: Sequence[str], run: slice) -> dict[str, str]:
    """Return a recording's note on which of its images are used; nothing if all are."""
    used = names[run]
    if len(used) == len(names) or not used:
        return {}
    text = f"{len(used)} of {len(names)} images, the longest run without gaps: "
    return {NOTE: text + f"{quote_text(used[0])} to {quote_text(used[-1])}"}


def _follow(names: Sequence[str]) -> list[bool]:
    """Return for each name after the first whether its image follows the one before.

    The usual step between numbers is their median step. Names that do not differ in exactly one
    number do not say.
    """
    steps = list(map(_step, names, names[1:]))
    known = [step for step in steps if step is not None]
    usual = float(np.percentile(known, 50, method="lower")) if known else 1.0
    return [step is None or usual / MAX_JUMP < step < usual * MAX_JUMP for step in steps]


def _step(name: str, following: str) -> float | None:
    """Return the difference of two names' numbers; 0 for different folders, None if unknown."""
    first, second = PurePath(name), PurePath(following)
    if first.parent != second.parent or first == second:
        return 0.0
    texts, numbers = zip(*(_split(path.stem) for path in (first, second)), strict=True)
    if texts[0] != texts[1]:
        return None
    steps = [b - a for a, b in zip(*numbers, strict=True) if a != b]
    return float(steps[0]) if len(steps) == 1 else None


def _split(stem: str) -> tuple[list[str], list[Fraction]]:
    parts = re.split(r"([0-9]{1,30}(?:\.[0-9]{1,30})?)", stem)
    return parts[::2], [Fraction(part) for part in parts[1::2]]
