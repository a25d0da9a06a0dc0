"""Frame rate, size and length of the clips of a recorded video, and its frames at that size.

- Frame rate: by default the video's. Above 60 fps, every second, third, ... frame is taken, for at
  most 60 fps. A given rate takes the frames nearest in time, as EgoSim does. Videos are
  read at a constant rate (`io/timing.py`), and a variable one is refused.
- Size: by default the video's, reduced to at most 832 pixels on the longer side and cropped to
  multiples of 16. A given size crops the image to its aspect ratio. A crop that loses more than
  40 % of the image, such as landscape from portrait, is refused.
- Length: all frames, cut to 4k+1. More than 601 frames need `--clips` or `--num-frames`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from math import ceil
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int, UInt8

from egosim_jax.data.crop import Crop, plan_crop
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import quote_path
from egosim_jax.types import WAN_GRID, InputError, check_counts
from egosim_jax.types.arrays import RgbImage, Video

MAX_FPS = 60
"""Maximum frame rate of clips in frames per second."""
MAX_CLIP_FRAMES, MIN_CLIP_FRAMES = 601, 9
"""Maximum and minimum length of a clip in frames."""
MAX_SIDE_PX = 832
"""Maximum longer side in pixels of clips without a given size."""
CHUNK = 300
"""Number of frames that are decoded at a time."""
SEARCHED_SIDE_PX = 1280
"""Maximum longer side in pixels of the frames in which hands are searched."""
SEARCHED_BYTES = 768 << 20
"""Maximum memory of the frames in which hands are searched, in bytes."""


@dataclass(frozen=True, kw_only=True)
class Sampling:
    """Size, frame rate and length of clips; None: as in the video."""

    size: tuple[int, int] | None = None
    """Height and width in pixels, multiples of 16."""
    fps: float | None = None
    """Frame rate of the clips in frames per second."""
    num_frames: int | None = None
    """Number of frames in a clip, 4k + 1."""

    def __post_init__(self) -> None:
        """Check that a model can encode such clips."""
        check_counts({"--num-frames": self.num_frames})
        if self.num_frames is not None:
            WAN_GRID.check_frames(self.num_frames, what="a clip")
        for name, size in zip(("--size height", "--size width"), self.size or (), strict=False):
            WAN_GRID.check_size(size, name=name)
        if self.fps is not None and not 1 <= self.fps <= MAX_FPS:
            raise InputError(f"--fps must be from 1 to {MAX_FPS}, not {self.fps:g}.")


@dataclass(frozen=True, kw_only=True)
class Plan(Crop):
    """Frames to take from one video, and their scale and crop."""

    source_size: tuple[int, int]
    """Height and width of the video in pixels."""
    source_fps: Fraction
    """Frame rate of the video in frames per second."""
    fps: Fraction
    """Frame rate of the clips in frames per second."""
    count: int
    """Number of frames of the whole video at the clips' frame rate."""

    @no_type_check
    def indices(self, start: int, stop: int) -> Int[np.ndarray, " f"]:
        """Return the frames of the video nearest in time to frames `start` to `stop` of the clip.

        Of two equally near frames, the later one is taken.
        """
        # Fractions: with floats, frame rates such as 30000/1001 would round ties at random.
        times = [Fraction(k) * self.source_fps / self.fps for k in range(start, stop)]
        return np.array([int(time + Fraction(1, 2)) for time in times])

    @no_type_check
    def fit(self, frame: RgbImage) -> UInt8[np.ndarray, "height width 3"]:
        """Return a frame of the video, resized (by area if smaller) and cropped."""
        import cv2

        return self._fit(frame, cv2.INTER_AREA if self.scale < 1 else cv2.INTER_CUBIC)

    @no_type_check
    def fit_depth(self, depth: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "height width"]:
        """Return the depth of a frame of the video, resized by nearest neighbor and cropped."""
        import cv2

        return self._fit(depth, cv2.INTER_NEAREST)

    @no_type_check
    def pixels(
        self, source_px: Float[np.ndarray, "*n 2"], size: tuple[int, int]
    ) -> Float[np.ndarray, "*n 2"]:
        """Return where columns and rows of a frame of the video are in the clip, as `fit` does.

        `size` has the height and width of the frames that the pixels are from: the video's, or of
        frames resized from it without a crop.
        """
        resized = np.array(self._resized(self.source_size))
        return (source_px + 0.5) * resized / size[::-1] - 0.5 - np.array(self.offset_px)

    def _resized(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return width and height of a resized frame, before the crop."""
        return round(size[1] * self.scale), round(size[0] * self.scale)

    def _fit(self, image: np.ndarray, how: int) -> np.ndarray:
        import cv2

        rows, columns = image.shape[:2]
        size = self._resized((rows, columns))
        resized = image if size == (columns, rows) else cv2.resize(image, size, interpolation=how)
        left, top = (round(offset) for offset in self.offset_px)
        return resized[top : top + self.height, left : left + self.width]


def plan(recording: Recording, sampling: Sampling, *, cut: bool) -> Plan:
    """Return frame rate, size and crop of a recording's clips.

    Without `cut`, the whole recording is one clip. Raises `InputError` if the recording is too
    short or too long, or if the size has too different an aspect ratio.
    """
    name = quote_path(recording.video)
    fps = recording.fps / ceil(recording.fps / MAX_FPS)
    if sampling.fps is not None:
        fps = Fraction(sampling.fps).limit_denominator(1001)
    half = Fraction(1, 2)
    count = int((recording.frames - 1) * fps / recording.fps + half) + 1
    count = min(count, ceil((recording.frames - half) * fps / recording.fps))  # has a frame
    wanted = sampling.num_frames or MIN_CLIP_FRAMES
    if count < wanted:
        raise InputError(
            f"{name} has {count} frames at {float(fps):.4g} fps: a clip needs {wanted}. "
            "(--num-frames, --fps)"
        )
    if not cut and sampling.num_frames is None and count > MAX_CLIP_FRAMES:
        raise InputError(
            f"{name} has {count} frames at {float(fps):.4g} fps: a clip has at most "
            f"{MAX_CLIP_FRAMES}. Cut it into clips (--clips), or take its first frames "
            "(--num-frames)."
        )
    source = recording.height, recording.width
    size = _own_size(recording)
    fix = f"Choose a size of a similar shape, for instance {' '.join(map(str, size))}. (--size)"
    crop = plan_crop(source, sampling.size or size, name=name, fix=fix)
    left, top = (
        float((round(length * crop.scale) - kept) // 2)
        for length, kept in ((recording.width, crop.width), (recording.height, crop.height))
    )
    return Plan(
        **{**vars(crop), "offset_px": (left, top)},
        source_size=source,
        source_fps=recording.fps,
        fps=fps,
        count=count,
    )


def _own_size(info: Recording) -> tuple[int, int]:
    """Return the largest size on the grid with a video's aspect ratio and at most 832 pixels."""
    scale = min(1.0, MAX_SIDE_PX / max(info.height, info.width))
    unit = WAN_GRID.spatial_stride * WAN_GRID.patch
    height, width = (
        max(unit, int(size * scale + 1e-6) // unit * unit) for size in (info.height, info.width)
    )
    return height, width


def read_frames(recording: Recording, fitted: Plan, start: int, stop: int) -> Video:
    """Return frames `start` to `stop` at the clips' frame rate and size.

    Raises `InputError` if the video is damaged.
    """
    wanted = fitted.indices(start, stop)
    return _read(recording, wanted[wanted < recording.frames], fitted.fit)


def read_searched_frames(
    recording: Recording, wanted: Int[np.ndarray, " f"], fitted: Plan
) -> Video | None:
    """Return some frames of the video without a crop, for a search of hands.

    They are reduced to 1280 pixels on the longer side, and to 768 MiB in all. Return None if they
    would be no larger than the clip's frames.
    """
    import cv2

    height, width = fitted.source_size
    most = SEARCHED_BYTES / (3 * len(wanted) * height * width)
    scale = min(1.0, SEARCHED_SIDE_PX / max(height, width), most**0.5)
    if scale <= fitted.scale:
        return None
    size = round(width * scale), round(height * scale)

    def reduce(frame: np.ndarray) -> np.ndarray:
        return cv2.resize(frame, size, interpolation=cv2.INTER_AREA) if scale < 1 else frame

    return _read(recording, wanted, reduce)


def _read(
    recording: Recording, wanted: np.ndarray, each: Callable[[np.ndarray], np.ndarray]
) -> Video:
    """Return frames of a recording, each changed by a function, decoded in parts."""
    frames = np.empty((len(wanted), 0, 0, 3), np.uint8)
    for first in range(wanted[0], wanted[-1] + 1, CHUNK):
        here = np.flatnonzero((wanted >= first) & (wanted < first + CHUNK))
        low, high = wanted[here[0]], wanted[here[-1]]
        chunk = recording.read_frames(int(low), int(high) + 1, each=each).frames
        if not frames.size:
            frames = np.empty((len(wanted), *chunk.shape[1:]), np.uint8)
        frames[here] = chunk[wanted[here] - low]
    return frames
