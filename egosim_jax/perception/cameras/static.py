"""Test for a camera that does not move: the background stays where frame 0 shows it."""

from __future__ import annotations

import numpy as np

from egosim_jax.perception.cameras.flow import MIN_CORNERS, Background

MIN_SHARE = 0.15
"""Least share of the corners of frame 0 that a frame must show again to be judged."""


def still_share(
    video: Background, *, max_shift_px: float, stop_below: float
) -> tuple[float, float]:
    """Return the share of still frames, and the median over frames of their shift in pixels.

    The shift of a frame is the median distance of the background's corners from where frame 0 has
    them, at working size; a frame that shows too few of them is not still. Stops once the share
    must end below `stop_below`.
    """
    corners = video.corners(0)
    count = len(video.gray)
    if len(corners) < MIN_CORNERS:
        return 0.0, float("inf")
    shifts = [0.0]
    for frame in range(1, count):
        there, good = video.follow(0, frame, corners, corners)
        enough = good.sum() >= max(MIN_CORNERS / 2, MIN_SHARE * len(corners))
        moved = np.linalg.norm((there - corners)[good], axis=1) if enough else [np.inf]
        shifts.append(float(np.median(moved)))
        failed = sum(shift >= max_shift_px for shift in shifts)
        if failed > (1 - stop_below) * count:
            break
    share = sum(shift < max_shift_px for shift in shifts) / count
    return share, float(np.median(shifts))
