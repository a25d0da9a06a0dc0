"""Joints, bones, colors and sizes of drawn hands, and the tone curve of the original renderer.

A hand has 21 joints: the wrist, then four from knuckle to tip of thumb, index, middle, ring and
little finger. A gripper has three: the wrist and the tips of thumb and index, whose angle is the
gripper's opening.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from egosim_jax.types import Kind

JOINT_RADIUS_M = 0.0055
"""Radius of the sphere at a joint in meters: measured on the published videos, +-20 %."""
BONE_RADIUS_M = 0.00275
"""Radius of the tube along a bone in meters."""
NEAR_M, FAR_M = 0.01, 100.0
"""Near and far plane in meters: nothing outside them is drawn."""

GAMMA = np.round(255 * (np.arange(256) / 255) ** (1 / 2.2)).astype(np.uint8)
"""Tone curve of the original renderer: c -> c^(1/2.2), applied to nonlinear values."""

THUMB, INDEX, MIDDLE = (238, 130, 238), (255, 99, 71), (230, 245, 250)
RING, LITTLE = (173, 255, 47), (0, 152, 191)


@dataclass(frozen=True)
class Skeleton:
    """Colors and bones of one drawn hand."""

    colors: np.ndarray
    """RGB of each joint, uint8 `j 3`. A bone has the color of its outer joint."""
    bones: np.ndarray
    """Inner and outer joint of each bone, `k 2`."""


def _human() -> Skeleton:
    fingers = [THUMB, INDEX, MIDDLE, RING, LITTLE]
    colors = [MIDDLE, *(color for color in fingers for _ in range(4))]
    outer = np.arange(1, 21)
    inner = np.where(outer % 4 == 1, 0, outer - 1)
    return Skeleton(GAMMA[np.array(colors)], np.stack([inner, outer], axis=1))


def _robot() -> Skeleton:
    return Skeleton(np.array([MIDDLE, THUMB, INDEX], np.uint8), np.array([[0, 1], [0, 2]]))


SKELETONS: dict[Kind, Skeleton] = {"human": _human(), "robot": _robot()}
"""Skeleton of each kind of hand; only human hands have the original's tone curve."""
