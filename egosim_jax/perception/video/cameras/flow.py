"""Sparse optical flow of the background, with tests for cuts and for a still camera.

The flow is pyramidal Lucas-Kanade with a forward-backward check.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from egosim_jax.types.arrays import Masks, Video

WORKING_PX = 960
"""Maximum side of a tracked image; larger images are downscaled to it."""
MIN_CORNERS = 20
"""Minimum number of background corners of an image with enough texture."""
MAX_RETURN_PX = 0.7
"""Maximum forward-backward error of a track, in pixels."""
MIN_TRACKED = 0.15
"""Minimum fraction of frame 0's corners that a frame must show for the test of stillness."""
MARGIN = 0.015
"""Width of the border around moving pixels that is not background, in image widths."""
MIN_SURVIVAL = 0.1
"""Minimum fraction of corners that a connected frame shows again."""
_CORNERS, _QUALITY, _APART_PX = 600, 0.003, 8
_WINDOW, _LEVELS = (21, 21), 4


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Background:
    """Gray frames of a video at working size, with masks of their static pixels."""

    gray: Sequence[UInt8[np.ndarray, "h w"]]
    """Gray frames with equalized contrast."""
    still: Sequence[UInt8[np.ndarray, "h w"]]
    """Masks: 255 at the background, 0 at hands, arms and a margin around them."""
    reduction: float
    """Input pixels per working pixel."""

    def corners(self, frame: int) -> Float32[np.ndarray, "n 2"]:
        """Return background corners of a frame: few if it is black, blurred or blank."""
        import cv2

        corners = cv2.goodFeaturesToTrack(
            self.gray[frame], _CORNERS, _QUALITY, _APART_PX, mask=self.still[frame]
        )
        if corners is None or float(self.gray[frame].std()) < 2:
            return np.zeros((0, 2), np.float32)
        return corners.reshape(-1, 2)

    def follow(
        self,
        first: int,
        second: int,
        points: Float32[np.ndarray, "n 2"],
        guess: Float[np.ndarray, "n 2"] | None = None,
    ) -> tuple[Float32[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
        """Return the places of one frame's points in another, and True for the points found."""
        import cv2

        if not len(points):
            return points, np.zeros(0, bool)
        options = {"winSize": _WINDOW, "maxLevel": _LEVELS}
        flags = 0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW
        start = np.array(points if guess is None else guess, np.float32)
        there, tracked, _ = cv2.calcOpticalFlowPyrLK(
            self.gray[first], self.gray[second], points, start, flags=flags, **options
        )
        back, returned, _ = cv2.calcOpticalFlowPyrLK(
            self.gray[second], self.gray[first], there, points.copy(),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW, **options,
        )  # fmt: skip
        good = (tracked[:, 0] > 0) & (returned[:, 0] > 0)
        good &= np.linalg.norm(back - points, axis=1) < MAX_RETURN_PX
        height, width = self.gray[second].shape
        column, row = np.rint(np.nan_to_num(there)).astype(int).T
        good &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
        good[good] = self.still[second][row[good], column[good]] > 0
        return there, good


def background(frames: Video, moving: Masks) -> Background:
    """Return a video's background, without moving pixels and a margin around them."""
    import cv2

    height, width = frames.shape[1:3]
    reduction = max(1.0, max(height, width) / WORKING_PX)
    size = round(width / reduction), round(height / reduction)
    equalize = cv2.createCLAHE(clipLimit=2.0, tileGridSize=(8, 8))
    wide = 2 * max(1, round(MARGIN * max(size))) + 1
    kernel = np.ones((wide, wide), np.uint8)
    gray, still = [], []
    for frame, mask in zip(frames, moving, strict=True):
        image = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
        mask = mask.astype(np.uint8)
        if reduction > 1:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            mask = cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
        gray.append(equalize.apply(image) if image.std() >= 2 else image)
        still.append(255 * (1 - cv2.dilate(mask, kernel)))
    return Background(gray=gray, still=still, reduction=max(frames.shape[1:3]) / max(size))


@dataclass(frozen=True)
class Breaks:
    """Frames of a video that are not connected to the frames before them."""

    blank: tuple[int, ...]
    """Frames without texture: black, blurred or covered."""
    cuts: tuple[int, ...]
    """Frames that share no background with the frames before them."""
    survival: tuple[float, ...]
    """Fraction of each frame's corners that the next frame shows, except for the last frame."""


def find_breaks(video: Background, *, bridge: int) -> Breaks:
    """Find blank frames and cuts. A gap of at most `bridge` bad frames is not a cut."""
    count = len(video.gray)
    corners = [video.corners(frame) for frame in range(count)]
    blank = [frame for frame in range(count) if len(corners[frame]) < MIN_CORNERS]

    def survival(first: int, second: int) -> float:
        if len(corners[first]) < MIN_CORNERS or len(corners[second]) < MIN_CORNERS:
            return 0.0
        return float(np.mean(video.follow(first, second, corners[first])[1]))

    fractions = [survival(frame, frame + 1) for frame in range(count - 1)]
    cuts: list[int] = []
    reached = 0
    for frame in range(1, count):
        if fractions[frame - 1] >= MIN_SURVIVAL and reached == frame - 1:
            reached = frame
            continue
        if survival(reached, frame) >= MIN_SURVIVAL:
            reached = frame
        elif frame - reached > bridge and frame not in blank:
            cuts.append(frame if reached + 1 in blank else reached + 1)
            reached = frame
    if after := [frame for frame in range(reached + 1, count) if frame not in blank]:
        cuts.append(after[0])
    return Breaks(tuple(blank), tuple(cuts), tuple(fractions))


def still_fraction(
    video: Background, *, max_shift_px: float, stop_below: float
) -> tuple[float, float]:
    """Return the fraction of still frames, and the median shift over frames in pixels.

    The shift of a frame is the median distance of the background's corners from their places in
    frame 0, at working size. A frame that shows too few corners is not still. Stops early once
    the fraction can no longer reach `stop_below`.
    """
    corners = video.corners(0)
    count = len(video.gray)
    if len(corners) < MIN_CORNERS:
        return 0.0, float("inf")
    shifts = [0.0]
    for frame in range(1, count):
        there, good = video.follow(0, frame, corners, corners)
        enough = good.sum() >= max(MIN_CORNERS / 2, MIN_TRACKED * len(corners))
        moved = np.linalg.norm((there - corners)[good], axis=1) if enough else [np.inf]
        shifts.append(float(np.median(moved)))
        failed = sum(shift >= max_shift_px for shift in shifts)
        if failed > (1 - stop_below) * count:
            break
    fraction = sum(shift < max_shift_px for shift in shifts) / count
    return fraction, float(np.median(shifts))
