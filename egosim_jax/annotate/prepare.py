"""Shots, windows and quality of a recorded video, measured on thumbnails in one pass.

A shot ends where the image changes by more than `cut_difference` gray levels and by more than three
times the change in the frames around (adaptive content detection, as in PySceneDetect). Black
frames belong to no shot. A clip is a window of one shot. Black, blurred, still or shaken clips are
refused, with the decisive figure. Motion is measured in image widths, which makes the limits
independent of the size. Noise is no motion: it changes the image as much between two frames as over
half a second. The first stage checks if hands are visible (`stages`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, cast, no_type_check

import numpy as np
from jaxtyping import Bool, Float, UInt8

from egosim_jax.annotate.frames import CHUNK, MAX_CLIP_FRAMES, Plan
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import unlike
from egosim_jax.types import WAN_GRID, InputError
from egosim_jax.types.arrays import RgbImage

THUMB_PX = 160
"""Width in pixels of the thumbnails for changes and motion."""
CELL_PX = 5
"""Width in pixels of a thumbnail's cells, whose mean colors have little noise."""
LAG_S = 0.5
"""Time in seconds over which motion must change the image more than noise does."""
MIN_CHANGE, SURE_CHANGE = 1.0, 6.0
"""Change of cells that may be motion, and change that noise never causes, in gray levels."""
MIN_GROWTH = 1.5
"""Minimum ratio of the change over half a second to the change between two frames."""
SHARP_PX = 320
"""Width in pixels at which sharpness is measured."""


class RefusedError(InputError):
    """A rule refuses a clip; has the name of the rule and the decisive figures."""

    def __init__(self, rule: str, reason: str, figures: Mapping[str, float] | None = None):
        super().__init__(reason)
        self.rule, self.figures = rule, dict(figures or {})


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Rules for a clip; 0 or infinity switches a rule off."""

    min_hands: float = 0.5
    """Minimum fraction of frames in which a hand is visible."""
    min_sharpness: float = 15.0
    """Minimum variance of the Laplacian in squared gray levels, median over frames."""
    max_black: float = 0.0
    """Maximum fraction of black frames (mean gray level below 16 of 255)."""
    min_motion: float = 0.005
    """Minimum speed of the fastest motion (95th percentile), in image widths per second."""
    max_motion: float = 1.5
    """Maximum speed of the camera motion (median), in image widths per second."""
    min_prior_gain_db: float = -2.0
    """Minimum PSNR of the prior minus PSNR of the repeated first frame, in decibels."""

    def __post_init__(self) -> None:
        """Check that fractions are from 0 to 1, and other limits numbers that can be reached."""
        for name, most in (
            ("min_hands", 1.0), ("max_black", 1.0), ("min_sharpness", np.inf),
            ("min_motion", np.inf), ("max_motion", np.inf),
        ):  # fmt: skip
            if not 0 <= (value := getattr(self, name)) <= most:
                option = "--" + name.replace("_", "-")
                bound = "at least 0" if np.isinf(most) else f"a fraction from 0 to {most:g}"
                raise InputError(f"{option} is {value:g}: it must be {bound}. ({option})")
        if np.isnan(self.min_prior_gain_db):
            raise InputError("--min-prior-gain is nan: it must be a number. (--min-prior-gain)")

    def check(self, figures: Mapping[str, float]) -> None:
        """Raise `RefusedError` for the first rule that a clip breaks."""
        for rule, name, sign, option, fix in (
            ("black", "black", 1, "--max-black", "Annotate the other parts, or allow it"),
            ("blur", "sharpness", -1, "--min-sharpness", "Take a sharper video, or allow it"),
            ("still", "motion", -1, "--min-motion", "Annotate parts with motion, or allow it"),
            ("shaken", "camera_motion", 1, "--max-motion", "Annotate calmer parts, or allow it"),
        ):
            limit = getattr(self, option[2:].replace("-", "_"))
            if sign * figures[name] > sign * limit:
                raise RefusedError(
                    rule,
                    f"{rule}: {name} is {unlike(figures[name], limit)}, beyond {limit:g}. "
                    f"{fix}. ({option})",
                    figures,
                )


@dataclass(frozen=True, kw_only=True)
class Cutting:
    """Rules for shots and windows."""

    clips: bool = False
    """Cut videos into clips; otherwise a video is one clip and must have no cut."""
    cut_difference: float = 15.0
    """Minimum change of the image at a cut, in gray levels."""
    quality: Quality = field(default_factory=Quality)
    """Quality rules for clips."""

    def advice(self, parts: str) -> str:
        """Return the advice to annotate parts of a video; empty if videos are cut already."""
        return "" if self.clips else f"Annotate the parts {parts} (--clips). "


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Scan:
    """Measurements of every frame of a video, at the clips' frame rate."""

    difference: Float[np.ndarray, " f"]
    """Mean absolute color change from the previous frame, in gray levels."""
    luminance: Float[np.ndarray, " f"]
    """Mean brightness in gray levels."""
    sharpness: Float[np.ndarray, " f"]
    """Variance of the Laplacian in squared gray levels."""
    motion: Float[np.ndarray, "f 2"]
    """Optical flow from the previous frame, median and 95 %, in image widths per second."""

    @property
    def black(self) -> Bool[np.ndarray, " f"]:
        """True for black frames."""
        return self.luminance < 16

    def cuts(self, min_difference: float) -> list[int]:
        """Return the first frame of every shot except the first shot."""
        around = np.pad(self.difference, 3, mode="edge")
        near = np.stack([around[k : k + len(self.difference)] for k in (0, 1, 2, 4, 5, 6)])
        sudden = (self.difference > min_difference) & (
            self.difference > 3 * np.median(near, axis=0)
        )
        return np.flatnonzero(sudden).tolist()

    def figures(self, start: int, stop: int) -> dict[str, float]:
        """Return the figures of a clip for `Quality.check`."""
        inner = self.motion[start + 1 : stop]
        return {
            "black": float(self.black[start:stop].mean()),
            "sharpness": float(np.median(self.sharpness[start:stop])),
            "motion": float(np.median(inner[:, 1])),
            "camera_motion": float(np.median(inner[:, 0])),
        }


def scan(recording: Recording, fitted: Plan) -> Scan:
    """Decode a video once and measure every frame. Raises `InputError` if it is damaged."""
    import cv2

    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST)
    fps, before, rows = float(fitted.fps), None, []
    cells: deque[np.ndarray] = deque(maxlen=max(4, round(LAG_S * fps) + 1))
    height = max(16, round(SHARP_PX * fitted.height / fitted.width))

    def thumb(frame: RgbImage) -> UInt8[np.ndarray, "_ _ 3"]:
        return cv2.resize(frame, (SHARP_PX, height), interpolation=cv2.INTER_AREA)

    for first in range(0, fitted.count, CHUNK):
        wanted = fitted.indices(first, min(first + CHUNK, fitted.count))
        low, high = int(wanted[0]), min(int(wanted[-1]), recording.frames - 1)
        for frame in recording.read_frames(low, high + 1, each=thumb).frames[
            np.minimum(wanted, high) - low
        ]:
            gray = cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)
            small = cv2.resize(frame, (THUMB_PX, height // 2), interpolation=cv2.INTER_AREA)
            small_gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
            change, speed = 0.0, np.zeros(1)
            cells.append(_cells(small_gray))
            if before is not None:
                change = float(np.abs(small.astype(int) - before[0]).mean())
                moved = flow.calc(before[1], small_gray, cast(Any, None))
                speed = np.linalg.norm(moved, axis=-1) * fps / THUMB_PX
                speed = speed if differs(cells[0], cells[-2], cells[-1]) else np.zeros(1)
            low_high = np.percentile(speed, (50, 95))
            sharpness = cv2.Laplacian(gray, cv2.CV_32F).var()
            rows.append((change, gray.mean(), sharpness, *low_high))
            before = small.astype(int), small_gray
    table = np.array(rows)
    return Scan(
        difference=table[:, 0],
        luminance=table[:, 1],
        sharpness=table[:, 2],
        motion=table[:, 3:],
    )


def _cells(gray: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, "r c"]:
    import cv2

    size = THUMB_PX // CELL_PX, max(1, gray.shape[0] // CELL_PX)
    return cv2.resize(gray.astype(np.float32), size, interpolation=cv2.INTER_AREA)


def differs(
    earlier: Float[np.ndarray, "r c"], last: Float[np.ndarray, "r c"], now: Float[np.ndarray, "r c"]
) -> bool:
    """Return True if an image moves: it differs from an earlier one by more than noise.

    The images are means over cells. Noise changes an image as much since the last frame as since an
    earlier one, and motion changes it more.
    """
    change = float(np.percentile(np.abs(now - earlier), 95))
    noise = float(np.percentile(np.abs(now - last), 95))
    return change >= MIN_CHANGE and (change >= SURE_CHANGE or change >= MIN_GROWTH * noise)


@dataclass(frozen=True, kw_only=True)
class Window:
    """A clip to annotate: a range of frames of a recording, at the clips' frame rate."""

    video_id: str
    """Unique id of the clip."""
    start: int
    """First frame of the clip."""
    stop: int
    """End frame, exclusive."""
    figures: Mapping[str, float]
    """Figures for `Quality.check`."""
    refused: tuple[str, str] | None = None
    """Rule and reason of a refusal; None for an accepted clip."""


def windows(
    recording: Recording, scanned: Scan, length: int | None, rules: Cutting
) -> list[Window]:
    """Return the clips of a recording, including refused clips."""
    count = len(scanned.difference)
    cuts = scanned.cuts(rules.cut_difference)
    name = recording.recording_id
    if not rules.clips:
        stop = length or min((count - 1) // 4 * 4 + 1, MAX_CLIP_FRAMES)
        inside = [cut for cut in cuts if cut < stop]
        refusal = None
        if inside:
            reason = f"the shot changes at frame {inside[0]}: a clip is one shot. (--clips)"
            refusal = "cut", reason
        return [_judge(name, scanned, 0, stop, rules, refusal)]
    check_length(length, cut=True)
    windows, length = [], length or count
    for first, last in _shots(scanned, cuts):
        for start in range(first, last - length + 1, length):
            here = f"{name}_{start}_{start + length - 1}"
            windows.append(_judge(here, scanned, start, start + length, rules))
    return windows


def _shots(scanned: Scan, cuts: Sequence[int]) -> list[tuple[int, int]]:
    """Return first frame and end of every run of non-black frames in one shot."""
    bounds = np.zeros(len(scanned.black) + 1, bool)
    bounds[[0, *cuts, -1]] = True
    changes = np.flatnonzero(np.diff(scanned.black.astype(int))) + 1
    bounds[changes] = True
    edges = np.flatnonzero(bounds).tolist()
    return [(start, stop) for start, stop in pairwise(edges) if not scanned.black[start]]


def _judge(
    video_id: str,
    scanned: Scan,
    start: int,
    stop: int,
    rules: Cutting,
    refusal: tuple[str, str] | None = None,
) -> Window:
    figures = scanned.figures(start, stop)
    try:
        if refusal is None:
            rules.quality.check(figures)
    except RefusedError as refused:
        refusal = refused.rule, str(refused)
    return Window(video_id=video_id, start=start, stop=stop, figures=figures, refused=refusal)


def check_length(length: int | None, *, cut: bool) -> None:
    """Raise `InputError` if clips are cut without a length, or are too long."""
    if cut and length is None:
        raise InputError("--clips needs the length of the clips: --num-frames, or --config.")
    if length is not None and length > MAX_CLIP_FRAMES:
        WAN_GRID.check_frames(length, what="a clip")
        raise InputError(f"--num-frames {length}: a clip has at most {MAX_CLIP_FRAMES} frames.")
