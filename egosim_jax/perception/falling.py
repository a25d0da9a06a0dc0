"""Fall of an object that a hand let go of above the surface that is to carry it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from egosim_jax.geometry import transform
from egosim_jax.perception.pose_refinement import ObjectMotion

GRAVITY = 9.81
"""Acceleration of a fall in m/s^2."""
LIFTED_M = 0.01
"""An object that was released less than this above its first height was not lifted, in meters."""
FOOTPRINT_M = 0.006
"""Points of the state within this horizontal distance of an object's are below it, in meters."""


def fall(motion: ObjectMotion, others_m: Float32[np.ndarray, "n 3"], fps: int) -> ObjectMotion:
    """Return the motion with a fall, after the release, to the height above ground it began at.

    `others_m` are the other points of the state. Only the visible side of an object has points, so
    its height above what is below it is compared with that before it was lifted. What was not
    lifted, is on a hinge, or is held to the end does not fall.
    """
    released, last = motion.released, len(motion.path) - 1
    normal, offset = motion.model.plane[:3], motion.model.plane[3]
    if motion.hinged or released == last or not np.isfinite(offset):
        return motion
    first = motion.model.points_m
    side = 1.0 if first.mean(axis=0) @ normal + offset > 0 else -1.0
    up, floor = side * normal, float(-side * offset)
    end = transform(motion.path[released], first)
    if ((end - first) @ up).mean() < LIFTED_M:
        return motion
    gap = _clearance(end, others_m, up, floor) - _clearance(first, others_m, up, floor)
    seconds = np.maximum(np.arange(last + 1) - released, 0) / fps
    drop = np.minimum(GRAVITY / 2 * seconds**2, max(gap, 0.0))
    path = motion.path.copy()
    path[:, :3, 3] -= drop[:, None] * up
    return replace(motion, path=path)


def _clearance(
    points_m: Float[np.ndarray, "n 3"],
    others_m: Float32[np.ndarray, "m 3"],
    up: Float[np.ndarray, " 3"],
    floor: float,
) -> float:
    """Return the height of an object's lowest points above the highest surface below it."""
    from scipy.spatial import KDTree

    heights, others = points_m @ up, others_m @ up
    level = np.eye(3) - np.outer(up, up)
    below = (others > floor) & (others < heights.mean())
    near, _ = KDTree(points_m @ level).query(
        others_m[below] @ level, distance_upper_bound=FOOTPRINT_M
    )
    support = others[below][np.isfinite(near)]
    return float(
        np.quantile(heights, 0.02) - (np.quantile(support, 0.95) if len(support) else floor)
    )
