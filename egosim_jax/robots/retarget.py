"""Grips: the pose of a gripper that replaces a hand, and how far it must open.

A grip's frame has its origin at the pinch point, halfway between thumb and fingers. Its z axis is
the approach, from the wrist to the pinch point; its x axis points from the thumb to the fingers,
across the approach.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

SMOOTHING_S = 0.04
"""Standard deviation of the filter of places over time, in seconds: estimated hands tremble."""
GRADUAL_S = 0.08
"""The same for directions and openings: both change at once when fingers close, no gripper does."""
WRIST_M = 0.12
"""Distance of a gripper's wrist from its tips in its keypoints."""
MIN_ACROSS_M = 1e-3
"""Distance of the fingertips below which they give no direction."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Grips:
    """Path of one hand as a gripper's."""

    world_from_grip: Float[np.ndarray, "f 4 4"]
    """Pose of the grip; the pose of the nearest frame where the hand is missing."""
    opening_m: Float[np.ndarray, " f"]
    """Distance between the fingertips in meters."""
    seen: Bool[np.ndarray, " f"]
    """Frames in which the hand is given."""
    pinch_m: Float[np.ndarray, "f 3"]
    """Pinch point as given, not smoothed; NaN where the hand is missing."""


def tips_of(joints_m: Float[np.ndarray, "*f j 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip of the thumb, and of the fingers opposite to it.

    These are the middle of index and middle finger of a hand, and the two tips of a gripper.
    """
    if joints_m.shape[-2] == 3:
        return joints_m[..., 1, :], joints_m[..., 2, :]
    return joints_m[..., 4, :], joints_m[..., [8, 12], :].mean(axis=-2)


def keypoints_of(
    world_from_grip: Float[np.ndarray, "f 4 4"], opening_m: Float[np.ndarray, " f"]
) -> Float[np.ndarray, "f 3 3"]:
    """Return the three keypoints of a gripper: its wrist and both tips."""
    place, across, along = (world_from_grip[:, :3, n] for n in (3, 0, 2))
    half = opening_m[:, None] / 2
    return np.stack([place - WRIST_M * along, place - half * across, place + half * across], 1)


def grips_of(joints_m: Float[np.ndarray, "f j 3"], *, fps: int | float) -> Grips:
    """Return the grips of one hand; a missing hand has joints of NaN, but not in all frames."""
    seen = np.asarray(np.isfinite(joints_m).all(axis=(1, 2)))
    (known,) = np.nonzero(seen)
    thumb, fingers = tips_of(joints_m[known])
    pinch = (thumb + fingers) / 2
    turns = _turns(pinch - joints_m[known, 0], fingers - thumb)
    opening = np.linalg.norm(fingers - thumb, axis=1)
    sigma = SMOOTHING_S * fps
    place = _smooth(pinch, known, sigma)
    turns = Rotation.from_matrix(turns)
    quaternions = continuous(turns.as_quat())
    turns = Rotation.from_quat(_smooth(quaternions, known, GRADUAL_S * fps))
    poses = np.tile(np.eye(4), (len(known), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns.as_matrix(), place
    nearest = _nearest(known, len(joints_m))
    raw = np.full((len(joints_m), 3), np.nan)
    raw[known] = pinch
    return Grips(
        world_from_grip=poses[nearest],
        opening_m=_smooth(opening[:, None], known, sigma)[nearest, 0],
        seen=seen,
        pinch_m=raw,
    )


def _turns(along: np.ndarray, across: np.ndarray) -> Float[np.ndarray, "f 3 3"]:
    """Return the axes of grips; a closed grip keeps the direction across of the frame before."""
    z = along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    x, last = np.zeros_like(z), None
    flat = across - (across * z).sum(axis=1, keepdims=True) * z
    sizes = np.linalg.norm(flat, axis=1)
    for frame, size in enumerate(sizes):
        if size >= MIN_ACROSS_M:
            last = flat[frame]
        elif last is None:
            open_ones = np.flatnonzero(sizes >= MIN_ACROSS_M)
            last = flat[open_ones[0]] if len(open_ones) else np.cross(z[frame], [0.0, 0.3, 0.95])
        x[frame] = last - (last @ z[frame]) * z[frame]
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-9)
    return np.stack([x, np.cross(z, x), z], axis=2)


def continuous(quaternions: np.ndarray) -> np.ndarray:
    """Return the quaternions with signs that make neighbors similar."""
    signs = np.where((quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0, -1.0, 1.0)
    return quaternions * np.cumprod([1.0, *signs])[:, None]


def _smooth(values: np.ndarray, frames: np.ndarray, sigma: float) -> np.ndarray:
    """Return the values smoothed over time, within stretches of consecutive frames."""
    stretches = np.split(np.arange(len(frames)), np.flatnonzero(np.diff(frames) > 1) + 1)
    return np.concatenate(
        [gaussian_filter1d(values[part], sigma, axis=0, mode="nearest") for part in stretches]
    )


def _nearest(known: np.ndarray, count: int) -> np.ndarray:
    """Return for each frame the index of the nearest known one."""
    gaps = np.abs(np.arange(count)[:, None] - known[None])
    return gaps.argmin(axis=1)
