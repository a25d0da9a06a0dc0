"""Pair the frames of a video with the rows of a table that has no time stamps.

Row k belongs to the moment k / fps, at the video's rate. A table with a row for each frame of the
file, not for each moment, belongs to the times of these frames. What fits is used: of 163 frames
and 120 rows, the first 120. A table that seems to have another rate is refused.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import Int

from egosim_jax.io.bounded import quote_path
from egosim_jax.io.timing import CONVERT
from egosim_jax.io.video import VideoInfo
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)


@no_type_check
def pair_rows(video: Path, info: VideoInfo, rows: int, *, what: str) -> Int[np.ndarray, " f"]:
    """Return the row of each frame of a video; there may be fewer than the video has.

    `what` names the rows in messages. Raises `InputError` as `check_lengths` does.
    """
    timeline = info.timeline
    if rows == len(timeline.listed_s) != info.frames:
        _, own = np.unique(timeline.listed_s, return_index=True)
        return own[timeline.nearest(timeline.moments_s(0, info.frames))]
    return np.arange(check_lengths(video, info.frames, rows, fps=float(info.fps), what=what))


def check_lengths(video: Path, frames: int, rows: int, *, fps: float, what: str) -> int:
    """Return how many of the frames have a row, and log the rest.

    Raises `InputError` if no frame has one, or if the table seems to have another rate: one length
    is a multiple of the other, or 15 / 8 of it.
    """
    name, fits = quote_path(video), min(frames, rows)
    if fits < 1:
        raise InputError(
            f"{name} has {frames} frames and {rows} {what}: at least one frame must have its own. "
            "Get both files again."
        )
    longer = max(frames, rows)
    ratio = round(longer / fits)
    if fits >= 16 and abs(longer - 15 / 8 * fits) < 1:  # 16 of 30, as in EgoSim's data
        ratio = 15 / 8
    if ratio > 1 and abs(longer - ratio * fits) < ratio:
        rate = fps / ratio if frames > rows else fps * ratio
        raise InputError(
            f"{name} has {frames} frames and {rows} {what}, as at {rate:.4g} frames per second "
            f"instead of {fps:.4g}: frame and row of one number must be of one time. Convert the "
            f"video, for instance with `{CONVERT.format(f'{rate:.6g}')}`."
        )
    if frames != rows:
        logger.warning(
            "%s has %d frames and %d %s: the first %d of both are used", name, frames, rows, what,
            fits,
        )  # fmt: skip
    return fits
