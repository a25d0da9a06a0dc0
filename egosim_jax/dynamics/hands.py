"""Hands over time: openings, pinch points, frames of the palm, and the noise of all of them.

The joints of a simulator are exact, and the joints of a video are off by millimeters and missing
from some frames. Both are read by the same rules; only `HandTrack.sigma_m` differs.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from egosim_jax.types import Kind

TIPS: dict[Kind, list[int]] = {"human": [4, 8, 12], "robot": [1, 2]}
"""Grasping joints: tips of thumb, index and middle finger; both jaws of a gripper."""
PALM: dict[Kind, list[int]] = {"human": [0, 1, 5, 9, 13, 17], "robot": [0, 1, 2]}
"""Joints that move as one rigid body: wrist and knuckles, or all of a gripper."""
MIN_ACROSS_M = 0.003
"""Minimum distance of a gripper's jaws that shows their direction, in meters."""
NOISY_M = 0.0008
"""Noise of an opening above which a track is smoothed, in meters."""
MIN_BENDS = 8
"""Minimum number of bends of an opening that show its noise."""
SMOOTHED = 0.55
"""Noise of a smoothed track, relative to the noise before."""
MAX_GAP = 4
"""Maximum number of consecutive missing frames over which a hand may hold an object."""


@dataclass(frozen=True, kw_only=True)
class HandTrack:
    """One hand in every frame of a clip."""

    kind: Kind
    joints_m: Float[np.ndarray, "f j 3"]
    """Joints; interpolated where the hand is missing."""
    present: Bool[np.ndarray, " f"]
    """Frames between the first and the last one with the hand, without long gaps."""
    tips_m: Float[np.ndarray, "f 2 3"]
    """Tip of the thumb, and mean of the grasping fingertips; or both jaws."""
    center_m: Float[np.ndarray, "f 3"]
    """Middle of the palm."""
    rotation: Float[np.ndarray, "f 3 3"]
    """World axes of the palm: across the fingers, along them, and out of the back."""
    sigma_m: float
    """Standard deviation of the opening's noise in meters, after smoothing; 0 for exact hands."""

    def grasping_m(self, begin: int, end: int) -> Float[np.ndarray, "2 3"]:
        """Return the grasping tips in a frame, with their mean places on the palm until another.

        A hand that holds an object keeps its fingers where they are, so the mean has less noise.
        """
        if not self.sigma_m:
            return self.tips_m[begin]
        some = slice(begin, end + 1)
        local = (self.tips_m[some] - self.center_m[some, None]) @ self.rotation[some]
        return local.mean(axis=0) @ self.rotation[begin].T + self.center_m[begin]

    @property
    def opening_m(self) -> Float[np.ndarray, " f"]:
        """Distance between thumb and fingers."""
        return np.linalg.norm(self.tips_m[:, 0] - self.tips_m[:, 1], axis=-1)

    @property
    def pinch_m(self) -> Float[np.ndarray, "f 3"]:
        """Point between thumb and fingers."""
        return self.tips_m.mean(axis=1)


def track_hand(joints_m: Float[np.ndarray, "f j 3"], kind: Kind) -> HandTrack | None:
    """Return the track of one hand; None if it is missing from all frames."""
    seen = np.flatnonzero(np.isfinite(joints_m).all(axis=(1, 2)))
    if not len(seen):
        return None
    complete = complete_hand(joints_m, seen)
    sigma = _noise(grasping_tips(complete, kind), seen)
    if sigma > NOISY_M:
        complete, sigma = _smooth(complete), SMOOTHED * sigma
    else:
        sigma = 0.0
    return HandTrack(
        kind=kind,
        joints_m=complete,
        present=_present(seen, len(joints_m)),
        tips_m=grasping_tips(complete, kind),
        center_m=complete[:, PALM[kind]].mean(axis=1),
        rotation=_axes(complete, kind),
        sigma_m=sigma,
    )


def complete_hand(
    joints_m: Float[np.ndarray, "f j 3"], seen: Int[np.ndarray, " k"]
) -> Float[np.ndarray, "f j 3"]:
    """Return a hand that is interpolated between the frames in which it is seen.

    Before it enters and after it leaves the view, it rests where it was seen.
    """
    if len(seen) == len(joints_m):
        return joints_m
    flat, frames = joints_m.reshape(len(joints_m), -1), np.arange(len(joints_m))
    complete = [np.interp(frames, seen, values) for values in flat[seen].T]
    return np.stack(complete, axis=1).reshape(joints_m.shape)


def grasping_tips(joints_m: Float[np.ndarray, "f j 3"], kind: Kind) -> Float[np.ndarray, "f 2 3"]:
    """Return the tip of the thumb and the mean of the grasping fingertips, or both jaws."""
    tips = joints_m[:, TIPS[kind]]
    return np.stack([tips[:, 0], tips[:, 1:].mean(axis=1)], axis=1)


def _present(seen: Int[np.ndarray, " k"], frames: int) -> Bool[np.ndarray, " f"]:
    present = np.zeros(frames, bool)
    present[seen] = True
    for before, after in pairwise(seen):
        if after - before <= MAX_GAP + 1:
            present[before:after] = True
    return present


def _noise(tips_m: Float[np.ndarray, "f 2 3"], seen: Int[np.ndarray, " k"]) -> float:
    """Return the noise of an opening, from its second differences.

    The second difference of white noise has the variance 6 sigma^2. A quarter of the absolute
    values of a normal distribution are below .319 sigma. In at least a quarter of a clip's frames
    the hand neither closes nor opens.
    """
    opening = np.linalg.norm(tips_m[:, 0] - tips_m[:, 1], axis=-1)[seen]
    bends = np.abs(np.diff(opening, 2))
    if len(bends) < MIN_BENDS:
        return 0.0
    return float(np.percentile(bends, 25) / 0.319 / np.sqrt(6))


def _smooth(joints_m: Float[np.ndarray, "f j 3"]) -> Float[np.ndarray, "f j 3"]:
    """Return the medians of three frames, and then their means with weights 1, 2 and 1."""
    padded = np.pad(joints_m, [(1, 1), (0, 0), (0, 0)], mode="edge")
    middle = np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0)
    padded = np.pad(middle, [(1, 1), (0, 0), (0, 0)], mode="edge")
    return (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4


def _axes(joints_m: Float[np.ndarray, "f j 3"], kind: Kind) -> Float[np.ndarray, "f 3 3"]:
    """Return the axes of the palm. A closed gripper keeps the direction of its jaws."""
    if kind == "robot":
        along = joints_m[:, 1:].mean(axis=1) - joints_m[:, 0]
        across = _continued(joints_m[:, 2] - joints_m[:, 1], along)
    else:
        along = joints_m[:, [5, 9, 13, 17]].mean(axis=1) - joints_m[:, 0]
        across = joints_m[:, 17] - joints_m[:, 5]
    along = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    across = across - (across * along).sum(axis=1, keepdims=True) * along
    across = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    return np.stack([across, along, np.cross(across, along)], axis=2)


def _continued(
    across: Float[np.ndarray, "f 3"], along: Float[np.ndarray, "f 3"]
) -> Float[np.ndarray, "f 3"]:
    """Return the jaws' direction in each frame; where they touch, the nearest frame's direction."""
    wide = np.flatnonzero(np.linalg.norm(across, axis=1) >= MIN_ACROSS_M)
    if not len(wide):  # always closed: any direction across the fingers that turns with them
        helper = np.eye(3)[np.abs(along[0]).argmin()]
        return np.cross(along, helper)
    nearest = wide[np.abs(np.arange(len(across))[:, None] - wide).argmin(axis=1)]
    return across[nearest]
