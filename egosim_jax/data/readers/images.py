"""Write the images of a capture as the video of a recording."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import Float

from egosim_jax.data.readers.lenses import Lens, Remap
from egosim_jax.io.video import write_frames
from egosim_jax.types import InputError

MAX_IMAGES = 100_000
"""Maximum number of images in a capture."""


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


def longest_run(names: Sequence[str], known: Callable[[str], bool]) -> slice:
    """Return the longest contiguous run of known names, because a video has no gaps."""
    best = run = slice(0, 0)
    for index, name in enumerate(names):
        run = slice(run.start if known(name) else index + 1, index + 1)
        if run.stop - run.start > best.stop - best.start:
            best = run
    return best
