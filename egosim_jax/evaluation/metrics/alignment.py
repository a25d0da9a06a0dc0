"""Shift by whole pixels that minimizes the squared error between two videos.

Renderings of a reconstructed scene may be displaced from the recorded video by the same few pixels
in all frames. The videos are compared inside a margin: every shift then compares the same pixels of
the reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import UInt8

from egosim_jax.evaluation.metrics.image import psnr
from egosim_jax.io.video import read_video
from egosim_jax.types import InputError, check_video


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Shift of a video relative to its reference, and PSNR before and after the correction."""

    shift_px: tuple[int, int]
    """Displacement of the video from the reference: columns to the right, rows down."""
    psnr_full: float
    """PSNR in dB over all pixels, before the correction, mean over frames."""
    psnr_inside: float
    """PSNR in dB inside the margin, before the correction, mean over frames."""
    psnr_aligned: float
    """PSNR in dB inside the margin, after the correction, mean over frames."""

    @property
    def gain(self) -> float:
        """PSNR gain of the correction in dB."""
        return self.psnr_aligned - self.psnr_inside


def align(
    video: UInt8[np.ndarray, "f h w 3"],
    reference: UInt8[np.ndarray, "g i j 3"],
    *,
    most_px: int = 12,
) -> Alignment:
    """Return the best shift of at most `most_px` pixels along each axis.

    Raises `InputError` if the videos differ in length or size, or are too small for the margin.
    """
    import cv2

    check_video("The reference", reference)
    check_video("The video", video, reference.shape[:3])
    _, height, width, _ = reference.shape
    if not 0 < 2 * most_px < min(height, width):
        raise InputError(
            f"Videos of {width}x{height} cannot be shifted by {most_px} pixels: it must be from 1 "
            f"to {(min(height, width) - 1) // 2}, less than half their size. (--most-px)"
        )
    rows, columns = slice(most_px, height - most_px), slice(most_px, width - most_px)
    inside = reference[:, rows, columns]
    errors = sum(  # one error map over all shifts per frame
        cv2.matchTemplate(frame, part, cv2.TM_SQDIFF).astype(np.float64)
        for frame, part in zip(video, inside, strict=True)
    )
    down, right = np.unravel_index(np.argmin(errors), np.shape(errors))
    shifted = video[:, down : down + inside.shape[1], right : right + inside.shape[2]]
    return Alignment(
        shift_px=(int(right) - most_px, int(down) - most_px),
        psnr_full=float(psnr(video, reference).mean()),
        psnr_inside=float(psnr(video[:, rows, columns], inside).mean()),
        psnr_aligned=float(psnr(shifted, inside).mean()),
    )


def align_clip(video: Path, reference: Path | None, *, most_px: int = 12) -> Alignment:
    """Return the best shift of a video file. Raises `InputError` without a recorded video."""
    if reference is None:
        raise InputError("it has no recorded video to compare with (column video).")
    return align(read_video(video).frames, read_video(reference).frames, most_px=most_px)
