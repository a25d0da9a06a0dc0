"""Times of frames, and the frame that belongs to a time.

A video is read at a constant rate: frame k is the one nearest to k / fps seconds after the first
frame, by presentation time stamps. Of two equally near frames, the later one is taken. So a frame
is repeated where one is missing. The rate follows from the stamps. The container's rate is used
only where it agrees with them, because a long last frame changes its average. Frames that share a
stamp with an earlier one are dropped. A pause of more than 0.2 s is a variable frame rate, which is
refused with the command that converts it. Tables with time stamps follow the same rules.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.types import InputError

logger = logging.getLogger(__name__)

MAX_DISTANCE_S = 0.1
"""Maximum time from a moment to its nearest frame in seconds, if one frame period is not longer."""
MAX_RATE_RATIO = Fraction(101, 100)
"""Maximum ratio of frame rates that count as equal, such as 30 and 29.97."""
CONVERT = "ffmpeg -i IN -vf fps={} OUT"
"""Command that writes a video at a constant frame rate."""
UNITS = {"milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}
"""Units that hardware gives time stamps in, and their number in a second."""
_EPSILON_S = 1e-6
_ROW_S = 1e-4
"""Precision of time stamps in tables in seconds, as in LeRobot."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Timeline:
    """Times of frames after the first one, and the constant rate to read them at."""

    times_s: Float[np.ndarray, " f"]
    """Increasing times of the frames in seconds, the first one at 0."""
    fps: Fraction
    """Rate in frames per second."""
    listed_s: Float[np.ndarray, " n"]
    """Times of all frames, including repeated ones."""

    @classmethod
    def of(
        cls, stamps: Sequence[float], unit_s: Fraction, rates: Sequence[Fraction | None]
    ) -> Timeline:
        """Return the timeline of at least one time stamp, in units of `unit_s` seconds.

        `rates` are declared rates, the most trusted first. Raises `InputError` if there is no rate.
        """
        ordered = sorted(stamps)
        # Python's integers: differences of hostile stamps overflow 64 bits.
        listed_s = np.array([stamp - ordered[0] for stamp in ordered], float) * float(unit_s)
        times_s = np.unique(listed_s)
        declared = [rate for rate in rates if rate]
        rate = _rate(times_s, float(unit_s), declared) if len(times_s) > 1 else (*declared, None)[0]
        if not rate:
            raise InputError("one frame without a frame rate")
        return cls(times_s=times_s, fps=rate, listed_s=listed_s)

    @classmethod
    def even(cls, count: int, fps: Fraction) -> Timeline:
        """Return the timeline of frames at a constant rate."""
        times_s = np.arange(count) / float(fps)
        return cls(times_s=times_s, fps=fps, listed_s=times_s)

    @property
    def count(self) -> int:
        """Number of frames at the constant rate."""
        return int(float(self.times_s[-1]) * self.fps + Fraction(1, 2)) + 1

    def nearest(self, wanted_s: Float[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
        """Return the frames nearest to times after the first frame."""
        between = (self.times_s[1:] + self.times_s[:-1]) / 2
        return np.searchsorted(between, np.asarray(wanted_s, float) + _EPSILON_S, side="right")

    def moments_s(self, start: int, stop: int) -> Float[np.ndarray, " m"]:
        """Return moments `start` to `stop` (exclusive) at the rate, in seconds."""
        return np.arange(start, stop) / float(self.fps)

    def at_rate(self, fps: float | Fraction) -> Int[np.ndarray, " m"]:
        """Return the frames nearest to moments at another rate, none of them after the last one."""
        count = int(float(self.times_s[-1]) * float(fps) + _EPSILON_S) + 1
        return self.nearest(np.arange(count) / float(fps))

    def check(
        self, name: str, wanted_s: Float[np.ndarray, " m"] | None = None, *, fix: str | None = None
    ) -> None:
        """Raise `InputError` for a time without a near frame; by default, for any long pause.

        `fix` replaces the advice to convert a video.
        """
        times_s = self.times_s
        if wanted_s is None:
            wanted_s = (times_s[1:] + times_s[:-1]) / 2
        limit_s = max(MAX_DISTANCE_S, 1 / float(self.fps))
        far = np.abs(times_s[self.nearest(wanted_s)] - wanted_s) > limit_s + _EPSILON_S
        if far.any():
            place = int(np.searchsorted(times_s, wanted_s[far.argmax()]))
            between = times_s[max(0, place - 1) : place + 1]
            raise InputError(
                f"{name} has a variable frame rate: it has no frame between "
                f"{between[0]:.2f} and {between[-1]:.2f} s, and a pause may last "
                f"{2 * limit_s:.2g} s. "
                + (fix or f"Convert it, for instance with `{convert(self.fps)}`.")
            )

    def report(self, name: str) -> None:
        """Log which frames are dropped or missing."""
        repeated = np.flatnonzero(np.diff(self.listed_s) == 0) + 1
        if len(repeated):
            logger.warning(
                "%s: %d of %d frames have the time stamp of another, the first one at %.3f s; they "
                "are dropped",
                name, len(repeated), len(self.listed_s), self.listed_s[repeated[0]],
            )  # fmt: skip
        missing = self.count - len(self.times_s)
        if missing > 0:
            logger.warning(
                "%s: %d of %d frames are missing at %.4g fps; the nearest in time are repeated",
                name, missing, self.count, float(self.fps),
            )  # fmt: skip


@no_type_check
def row_times(
    stamps: Sequence[Any], rates: Sequence[Fraction | None], name: str
) -> tuple[Int[np.ndarray, " f"], float, Timeline]:
    """Return the rows of a table in order of time, the first time in seconds, and their timeline.

    `stamps` are the values of a column, in seconds, and `rates` are declared rates. Rows without a
    time stamp or with a repeated one are dropped, and a warning names them. If no two rows have
    different ones, the declared rate gives the times. Raises `InputError` if it is unknown, too,
    and for time stamps in another unit.
    """
    numbers = np.array([_seconds(stamp) for stamp in stamps], float)
    stamped = np.flatnonzero(np.isfinite(numbers))
    rate = next(filter(None, rates), None)
    if rate and len(numbers) > 1 and len(np.unique(numbers[stamped])) < 2:
        logger.warning(
            "%s does not separate %d rows: row k is at k / %g s", name, len(numbers), float(rate)
        )
        return np.arange(len(numbers)), 0.0, Timeline.even(len(numbers), rate)
    if not len(stamped):
        raise InputError(
            f"{name} has no time stamps: a row must have a finite number of seconds. Write them, "
            "or remove the column."
        )
    ordered, first = np.unique(numbers[stamped], return_index=True)
    if len(ordered) < len(numbers):
        dropped = np.setdiff1d(np.arange(len(numbers)), stamped[first])
        logger.warning(
            "%s: %d of %d rows have no time stamp, or a repeated one; they are dropped, the first "
            "one is row %d", name, len(dropped), len(numbers), dropped[0],
        )  # fmt: skip
    timeline = Timeline.of((ordered / _ROW_S).tolist(), Fraction(_ROW_S), rates)
    for unit, count in UNITS.items():
        if rate and count / 2 < rate / timeline.fps < 2 * count:
            raise InputError(
                f"{name} seems to be in {unit}: its rows are {float(1 / timeline.fps):.4g} apart, "
                f"at {float(rate):g} frames per second. It must be in seconds: divide it by "
                f"{count:,}."
            )
    timeline.check(name, fix="Cut it there, and use the parts.")
    timeline.report(name)
    return stamped[first], float(ordered[0]), timeline


def _seconds(value: Any) -> float:
    if isinstance(value, list) and len(value) == 1:
        (value,) = value
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e19:
        return float("nan")
    return float(value)


def convert(fps: Fraction) -> str:
    """Return the command that writes a video at the whole rate nearest to `fps`."""
    return CONVERT.format(max(1, round(fps)))


def _rate(times_s: np.ndarray, unit_s: float, declared: Sequence[Fraction]) -> Fraction:
    """Return the rate at which most frames are equally spaced, or else the average rate."""
    steps, span_s = np.diff(times_s), float(times_s[-1])
    usual_s = float(np.percentile(steps, 50, method="lower"))
    even = (len(times_s) - 1) / span_s
    full = float(np.maximum(np.rint(steps / usual_s), 1).sum()) / span_s
    usual = [rate for exact in (even, full) for rate in _usual(exact)]
    estimates = [_fraction(exact) for exact in (even, full)]
    for rate in (*declared, *usual, *estimates):
        places = times_s * float(rate)
        rounded = np.rint(places)
        jumps = np.diff(rounded)
        tolerance = min(float(rate) * unit_s + 1e-6, 0.25)
        if np.abs(places - rounded).max() <= tolerance and jumps.min() == np.median(jumps) == 1:
            return rate
    for rate in (*usual, *declared, *estimates):
        if np.abs(times_s * float(rate) - np.arange(len(times_s))).max() <= 0.5:
            return rate
    return estimates[1]


def _fraction(exact: float) -> Fraction:
    return Fraction(exact).limit_denominator(1001) or Fraction(exact)


def _usual(exact: float) -> list[Fraction]:
    """Return the whole rate and the rate of 1000/1001 (NTSC) nearest to a rate."""
    whole, ntsc = round(exact), Fraction(1000 * round(exact * 1.001), 1001)
    return [rate for rate in (Fraction(whole), ntsc) if rate > 0]
