"""Pair the frames of a video with the rows of a table that has no time stamps.

Row k belongs to the moment k / fps, at the video's rate. A table with a row for each frame of the
file, not for each moment, belongs to the times of these frames. Lengths may differ by one frame or
1 %. A table of another length may have another rate, and is refused. So are numbered files.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import Int

from egosim_jax.io.bounded import quote_path
from egosim_jax.io.timing import CONVERT, MAX_RATE_RATIO
from egosim_jax.io.video import VideoInfo
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)


@no_type_check
def pair_rows(
    video: Path, info: VideoInfo, rows: int, *, what: str, frames: int | None = None
) -> Int[np.ndarray, " f"]:
    """Return the row of each frame of a video; there may be fewer than the video has.

    `what` names the rows in messages, and `frames` is the length of a part of the video. Raises
    `InputError` if no frame has a row, or if the rows are of another rate than the frames.
    """
    timeline = info.timeline
    frames = info.frames if frames is None else frames
    if rows == len(timeline.listed_s) != frames == info.frames:
        _, indices = np.unique(timeline.listed_s, return_index=True)
        return indices[timeline.nearest(timeline.moments_s(0, frames))]
    fewer, more = sorted((frames, rows))
    text = f"{quote_path(video)} has {frames} frames and {rows} {what}"
    if fewer < 1:
        raise InputError(f"{text}: at least one frame must have its own. Get both files again.")
    if not alike(fewer, more):
        rate = float(info.fps) * rows / frames
        raise InputError(
            f"{text}, as at {rate:.4g} frames per second instead of {float(info.fps):.4g}: frame "
            "and row of one number must be of one time. Convert the video, for instance with "
            f"`{CONVERT.format(f'{rate:.6g}')}`. If one of them only ends early, cut the other one "
            f"to {fewer}."
        )
    if frames != rows:
        logger.warning("%s: the first %d of both are used", text, fewer)
    return np.arange(fewer)


def alike(rows: int, frames: int) -> bool:
    """Return True for lengths that differ by at most one frame or 1 %: of one rate."""
    fewer, more = sorted((rows, frames))
    return more <= max(fewer + 1, fewer * MAX_RATE_RATIO)


def by_frame(
    files: Mapping[int, Path], video: Path, info: VideoInfo, *, what: str
) -> Mapping[int, Path]:
    """Return numbered files by frame of the video, from 0.

    As many files as frames are shifted if they are numbered from elsewhere. Raises `InputError` for
    numbers that are not the video's.
    """
    if not files:
        return files
    first, last = min(files), max(files)
    consecutive = last - first + 1 == len(files) > 1
    text = f"{quote_path(video)} has {info.frames} frames, and its {what} the numbers {first} to "
    text += f"{last}"
    if consecutive and not first:
        pair_rows(video, info, len(files), what=what)
    elif consecutive and len(files) == info.frames:
        logger.warning("%s: number %d is used for frame 0", text, first)
        return {number - first: path for number, path in files.items()}
    elif last >= info.frames or (consecutive and first == 1):
        raise InputError(
            f"{text}: frame k must have the number k, from 0. Number the files again, one for each "
            "frame."
        )
    elif len(files) < info.frames:
        logger.warning("%s: %d frames have none", text, info.frames - len(files))
    return files
