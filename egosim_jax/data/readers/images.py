"""Write the images of a capture as the video of a recording."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from fractions import Fraction
from itertools import pairwise
from pathlib import Path, PurePath

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.readers import NOTE
from egosim_jax.data.readers.lenses import Lens, Remap
from egosim_jax.data.recording import UNNAMED, Recording
from egosim_jax.io.bounded import quote_text
from egosim_jax.io.images import read_image
from egosim_jax.io.writing import write_frames
from egosim_jax.types import InputError

MAX_IMAGES = 100_000
"""Maximum number of images in a capture."""
MAX_JUMP = 1.5
"""Maximum ratio between the step of two numbers and the usual step of a capture."""
_MOMENT = re.compile(
    r"(?<![0-9])(?:((?:19|20)[0-9]{2})([^0-9]?)([01][0-9])\2([0-3][0-9])[^0-9]{0,3}"
    r"([0-2][0-9])([^0-9]?)([0-5][0-9])\6([0-5][0-9])|([0-9]{10})(?=[_-]))"
    r"(?:[._-]?([0-9]{9}|[0-9]{6}|[0-9]{3}))?(?![0-9])"
)
"""Date and time, or seconds since 1970, perhaps with decimals."""


def write_recording(folder: Path, images: Iterable[np.ndarray], fps: Fraction) -> Recording:
    """Write images as video.mp4 in a folder; return its recording."""
    path = folder / "video.mp4"
    frames, height, width = write_frames(path, images, fps)
    return Recording(
        recording_id=UNNAMED, video=path, frames=frames, fps=fps, height=height, width=width
    )


def write_images(
    folder: Path, images: Iterable[np.ndarray], lens: Lens, fps: Fraction
) -> tuple[Recording, Remap | None]:
    """Write images as video.mp4 in a folder; return its recording, and their remapping.

    Images whose lens is a pinhole are not remapped.
    """
    remap = None if lens.is_pinhole() else Remap.of(lens)
    frames = _checked(images, lens) if remap is None else remap.apply(images)
    return write_recording(folder, frames, fps), remap


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


def longest_run(names: Sequence[str], known: Callable[[str], bool]) -> list[int]:
    """Return the indices of the longest run of known names, because a video has no gaps.

    A run also ends where the numbers in the names jump: images between were not registered, or
    removed. It ends where another folder or sequence begins, too. Images of two sequences may
    alternate, so each number in turn is taken for the one that counts.
    """
    parts, given = [_split(PurePath(name)) for name in names], [known(name) for name in names]
    best: list[int] = []
    for at in range(-1, max((len(part.numbers) for part in parts), default=0)):
        order = list(range(len(names)))
        if at >= 0:
            order.sort(key=lambda index, at=at: parts[index].key(at))
        follows = [False, *_follow([parts[index] for index in order])]
        longest = run = slice(0, 0)
        for place, index in enumerate(order):
            start = run.start if follows[place] else place
            run = slice(start if given[index] else place + 1, place + 1)
            if run.stop - run.start > longest.stop - longest.start:
                longest = run
        best = max(best, order[longest], key=len)
    return best


def describe_run(names: Sequence[str], run: Sequence[int]) -> dict[str, str]:
    """Return a recording's note on which of its images are used; nothing if all are."""
    if len(run) == len(names) or not run:
        return {}
    text = f"{len(run)} of {len(names)} images, the longest run without gaps: "
    return {NOTE: text + f"{quote_text(names[run[0]])} to {quote_text(names[run[-1]])}"}


@dataclass(frozen=True)
class _Parts:
    texts: tuple[str, ...]
    """Folder, and texts between the numbers."""
    numbers: tuple[Fraction, ...]
    """Numbers; date and time are one, in seconds."""
    is_time: tuple[bool, ...]
    """True for numbers with decimals, which are times."""

    def key(self, at: int) -> tuple[tuple[str, ...], tuple[Fraction, ...]]:
        """Return a sort key whose last part is the number `at`."""
        rest = self.numbers[:at] + self.numbers[at + 1 :]
        return self.texts, rest + self.numbers[at : at + 1]


def _follow(parts: Sequence[_Parts]) -> list[bool]:
    """Return for each name after the first whether its image follows the one before.

    Every number must change by about its usual step, the median. Of those that usually stay, only
    a time in whole seconds may continue. Names without numbers do not say.
    """
    steps = [
        [b - a for a, b in zip(first.numbers, second.numbers, strict=True)]
        if first.texts == second.texts
        else []
        for first, second in pairwise(parts)
    ]
    most = max(map(len, steps), default=0)
    columns = [[float(step[n]) for step in steps if len(step) > n] for n in range(most)]
    usual = [float(np.percentile(column, 50, method="lower")) for column in columns]

    def goes_on(step: Fraction, expected: float, is_time: bool) -> bool:
        low, high = sorted((expected / MAX_JUMP, expected * MAX_JUMP))
        return low < step < high or (not expected and 0 <= step <= is_time)

    return [
        any(step) and all(map(goes_on, step, usual, second.is_time))
        if first.numbers or second.numbers
        else first.texts[0] == second.texts[0] and first != second
        for (first, second), step in zip(pairwise(parts), steps, strict=True)
    ]


def _split(path: PurePath) -> _Parts:
    stem = _MOMENT.sub(_in_seconds, path.stem)
    parts = re.split(r"([0-9]{1,30}(?:\.[0-9]{1,30})?)", stem)
    return _Parts(
        texts=(str(path.parent), *parts[::2]),
        numbers=tuple(map(Fraction, parts[1::2])),
        is_time=tuple("." in part for part in parts[1::2]),
    )


def _in_seconds(match: re.Match[str]) -> str:
    """Return date and time as seconds, with at least one decimal."""
    *moment, unix, decimals = match.group(1, 3, 4, 5, 7, 8, 9, 10)
    if unix:
        return f"{unix}.{decimals or 0}"
    try:
        at = datetime.fromisoformat("{}-{}-{} {}:{}:{}".format(*moment))
    except ValueError:
        return match[0]
    return f"{(at - datetime.min) // timedelta(seconds=1)}.{decimals or 0}"
