"""Motion of a released object: it falls to the surface below it, or is put down on it.

A perceived height is off by millimeters. So the height above its support that the object had before
it was taken is restored where it is put down (`snap`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Float32

from egosim_jax.geometry import transform
from egosim_jax.perception.pose_refinement import ObjectMotion

GRAVITY = 9.81
"""Acceleration of a fall in m/s^2."""
MIN_LIFT_M = 0.01
"""Minimum height of a release above the first height, in meters; below it nothing falls."""
FOOTPRINT_M = 0.006
"""Horizontal distance within which the state's points are below an object, in meters."""
MIN_SUPPORT = 20
"""Minimum number of points of a surface below an object; fewer may be its own, which it lacks."""
SNAP_M = 0.02
"""Maximum height error of a released object, above or below its support, in meters."""


def fall(motion: ObjectMotion, others_m: Float32[np.ndarray, "n 3"], fps: int) -> ObjectMotion:
    """Return the motion with a fall, after the release, to its height at rest above the ground.

    `others_m` are the other points of the state. An object does not fall if it was not lifted, if
    it is on a hinge, or if a hand holds it to the end.
    """
    if not motion.lands:
        return motion
    up, gap = _gap_below(motion, others_m)
    if _rises(motion, up)[motion.released] < MIN_LIFT_M:
        return motion
    seconds = np.maximum(np.arange(len(motion.path)) - motion.released, 0) / fps
    drop = np.minimum(GRAVITY / 2 * seconds**2, max(gap, 0.0))
    path = motion.path.copy()
    path[:, :3, 3] -= drop[:, None] * up
    return replace(motion, path=path)


def snap(motion: ObjectMotion, others_m: Float32[np.ndarray, "n 3"]) -> ObjectMotion:
    """Return the motion with a released object at its height at rest above the surface below it.

    An object that was never lifted may also keep its height: a drawer hangs in its case, and what
    is below it is not what it rests on. The smaller correction is made. It grows from the grasp to
    the release. Objects that do not `fall` are not snapped, and none whose height differs by more
    than `SNAP_M`.
    """
    if not motion.lands:
        return motion
    up, gap = _gap_below(motion, others_m)
    rises = _rises(motion, up)
    if rises.max() < MIN_LIFT_M:
        gap = min(gap, float(rises[-1]), key=abs)
    if abs(gap) > SNAP_M:
        return motion
    path = motion.path.copy()
    path[:, :3, 3] -= motion.carried[:, None] * gap * up
    return replace(motion, path=path)


def _gap_below(
    motion: ObjectMotion, others_m: Float32[np.ndarray, "n 3"]
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Return the direction up, and how much higher above its support the object ends, in meters."""
    normal, offset = motion.model.plane[:3], motion.model.plane[3]
    first, end = motion.model.rested_m, transform(motion.path[-1], motion.model.points_m)
    side = 1.0 if first.mean(axis=0) @ normal + offset > 0 else -1.0
    up, floor = side * normal, float(-side * offset)
    # Not the clearance alone: only the visible side has points, so it is not 0 on the ground.
    # Before the grasp, points above the object's lowest ones are next to it, or left of it.
    under = others_m[others_m @ up < np.quantile(first @ up, 0.02) + FOOTPRINT_M]
    return up, _clearance(end, others_m, up, floor) - _clearance(first, under, up, floor)


def _rises(motion: ObjectMotion, up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " f"]:
    """Return how much higher than at rest an object's center is in each frame, in meters."""
    center = motion.model.points_m.mean(axis=0, keepdims=True)
    rested = motion.model.rested_m.mean(axis=0)
    return (transform(motion.path, center) - rested)[:, 0] @ up


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
    is_surface = len(support) >= MIN_SUPPORT
    return float(np.quantile(heights, 0.02) - (np.quantile(support, 0.95) if is_surface else floor))
