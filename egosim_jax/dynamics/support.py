"""Support: riders, releases, falls, and furniture, whose parts belong together."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Float

from egosim_jax.dynamics.grips import twist
from egosim_jax.dynamics.solids import Solid
from egosim_jax.dynamics.walk import SAME_POSE, Fall, Walk
from egosim_jax.geometry import transform
from egosim_jax.types.arrays import Pose

TOUCH_M = 0.010
"""Maximum vertical distance of an object from what it stands on, in meters."""
LEVEL_M = 0.012
"""Minimum vertical overlap of two objects that push each other, in meters."""
OVERLAP_M = 0.0005
"""Minimum depth of an overlap that pushes objects apart, in meters."""
FLUSH_M = 0.004
"""Maximum distance of a drawer from its case, in meters."""
FURNITURE_M = 0.015
"""Minimum depth at which two hulls are in each other if one is a part of the other, in meters."""
LID_M = 0.03
"""Maximum difference between the outlines of a lid and its chest, in meters."""
LIFTED_M = 0.01
"""Minimum height of a release above a support from which an object falls, in meters."""
GRAVITY = 9.81
"""Acceleration of a fall, in m/s^2."""

UNDER_M, MIN_UNDER = 0.015, 20
"""Distance from an object's middle of the points of no object that it stands on; their number."""
MAX_RAISE_M = 0.02
"""Maximum depth in its support from which a released object is raised, in meters: hulls err."""
FLAT_LANDING_DEG = 25.0
"""Maximum tilt of a released object that lands flat, in degrees."""
UP = np.array([0.0, 0.0, 1.0])


class Body:
    """A solid at a pose: heights, and its outline from above."""

    def __init__(self, solid: Solid, pose: Pose):
        """Move the corners of a solid."""
        self.solid = solid
        self.corners_m = transform(pose, solid.corners_m)
        self.low_m, self.high_m = (float(f(self.corners_m[:, 2])) for f in (np.min, np.max))
        self.center_m = transform(pose, solid.center_m[None])[0]

    @cached_property
    def outline_m(self) -> Float[np.ndarray, "k 2"]:
        """Corners of the convex outline from above, in order."""
        from scipy.spatial import ConvexHull

        flat = self.corners_m[:, :2]
        return flat[ConvexHull(flat).vertices]


def is_inside(outline_m: Float[np.ndarray, "k 2"], point_m: Float[np.ndarray, " 2"]) -> bool:
    """Return True if a point is inside a convex outline whose corners are counterclockwise."""
    edges, gaps = np.roll(outline_m, -1, axis=0) - outline_m, point_m - outline_m
    return bool((edges[:, 0] * gaps[:, 1] - edges[:, 1] * gaps[:, 0] >= 0).all())


def apart(a: Body, b: Body) -> Float[np.ndarray, " 2"] | None:
    """Return the shortest horizontal motion in meters of `a` out of `b`; None if they are apart."""
    if min(a.high_m, b.high_m) - max(a.low_m, b.low_m) < LEVEL_M:
        return None
    reach = a.solid.radius_m + b.solid.radius_m
    if np.linalg.norm((a.center_m - b.center_m)[:2]) > reach:
        return None
    first, second = a.outline_m, b.outline_m
    edges = np.concatenate([np.roll(o, -1, axis=0) - o for o in (first, second)])
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    one, other = first @ normals.T, second @ normals.T
    forward = other.max(axis=0) - one.min(axis=0)
    back = one.max(axis=0) - other.min(axis=0)
    depth = np.minimum(forward, back)
    best = int(depth.argmin())
    if depth[best] < OVERLAP_M:
        return None
    return normals[best] * (forward[best] if forward[best] <= back[best] else -back[best])


def _stands_on(top: Body, carrier: Body) -> bool:
    """Return True if the middle of an object is just above another one's top."""
    if abs(top.low_m - carrier.high_m) > TOUCH_M:
        return False
    return _is_above(top, carrier)


def _is_above(top: Body, carrier: Body) -> bool:
    """Return True if the middle of an object is inside another one's outline from above."""
    far = np.linalg.norm((top.center_m - carrier.center_m)[:2]) > carrier.solid.radius_m
    return not far and is_inside(carrier.outline_m, top.center_m[:2])


def carry_riders(walk: Walk, number: int, pose: Pose, hand: int | None) -> None:
    """Move the objects on an object, directly or on others, as it moves to a pose."""
    change = pose @ np.linalg.inv(walk.poses[number])
    if np.abs(change - np.eye(4)).max() < SAME_POSE:
        return
    chain = [number]
    for below in chain:
        carrier = Body(walk.solids[below], walk.poses[below])
        chain += [
            other
            for other, solid in walk.solids.items()
            if other not in chain
            and other not in walk.in_hands
            and _stands_on(Body(solid, walk.poses[other]), carrier)
        ]
    for rider in chain[1:]:
        walk.move(rider, change @ walk.poses[rider], "carried", hand)


def height_below(walk: Walk, number: int) -> float:
    """Return the height of the highest support under the middle of an object, in meters."""
    body = Body(walk.solids[number], walk.poses[number])
    tops = [
        other.high_m
        for other in (Body(walk.solids[n], walk.poses[n]) for n in walk.solids if n != number)
        if other.high_m <= body.low_m + MAX_RAISE_M and _is_above(body, other)
    ]
    ground = walk.ground_m
    under = ground[np.linalg.norm(ground[:, :2] - body.center_m[:2], axis=1) < UNDER_M, 2]
    under = under[under <= body.low_m + MAX_RAISE_M]
    if len(under) >= MIN_UNDER:
        tops.append(float(np.median(under)))
    return max(tops, default=0.0)


def next_to(walk: Walk, number: int) -> list[int]:
    """Return the objects that an object touches, such as the chest of a lid."""
    points = transform(walk.poses[number], walk.solids[number].points_m)
    return [
        other
        for other, solid in walk.solids.items()
        if other != number and solid.distance(points, walk.poses[other]).min() < TOUCH_M
    ]


def raised(walk: Walk, number: int, pose: Pose) -> Pose:
    """Return a pose above the main support: an object that is pressed down slips in its hand."""
    solid = walk.solids[number]
    low = float(transform(pose, solid.corners_m)[:, 2].min())
    if low >= min(0.0, solid.base_m):
        return pose
    pose = pose.copy()
    pose[2, 3] -= low
    return pose


def release(walk: Walk, number: int) -> None:
    """Begin the fall of a released object to the surface below it; it lands flat.

    An object that was never lifted keeps its height, as a drawer in its case does.
    """
    solid, pose = walk.solids[number], walk.poses[number]
    center = transform(pose, solid.center_m[None])[0]
    tilt = np.degrees(np.arccos(np.clip(pose[2, 2], -1, 1)))
    if 0 < tilt < FLAT_LANDING_DEG:
        flat = pose.copy()
        flat[:3, :3] = twist(pose[:3, :3], UP)
        flat[:3, 3] = center - flat[:3, :3] @ solid.center_m
        walk.poses[number] = pose = flat
    rise = float(center[2] - solid.center_m[2]) + solid.lifted_m
    gap = Body(solid, pose).low_m - height_below(walk, number)
    if abs(rise) < LIFTED_M:
        gap = min(gap, rise, key=abs)
    if gap > -MAX_RAISE_M:
        walk.falls[number] = Fall(begin=walk.frame, height_m=gap)


def fall(walk: Walk, fps: int) -> None:
    """Let released objects fall until they reach their support."""
    for number, falling in list(walk.falls.items()):
        height = falling.height_m
        fallen, before = (
            min(GRAVITY / 2 * ((frame - falling.begin) / fps) ** 2, height)
            for frame in (walk.frame, walk.frame - 1)
        )
        drop = fallen - before if height > 0 else height
        pose = walk.poses[number].copy()
        pose[2, 3] -= drop
        carry_riders(walk, number, pose, None)
        how = "dropped" if height > LIFTED_M else "held"
        hand = None if height > LIFTED_M else walk.causes[number][-1].hand
        walk.move(number, pose, how, hand)
        if fallen >= height:
            del walk.falls[number]


def furniture(solids: Mapping[int, Solid]) -> set[int]:
    """Return the ids of objects that are parts of one piece of furniture: they are not pushed.

    A drawer is flush with its case, and a lid has the outline of its chest.
    """
    bodies = {number: Body(solid, np.eye(4)) for number, solid in solids.items()}
    return {
        number
        for first, second in combinations(bodies, 2)
        if _are_joined(bodies[first], bodies[second])
        for number in (first, second)
    }


def _are_joined(a: Body, b: Body) -> bool:
    if np.linalg.norm((a.center_m - b.center_m)[:2]) > a.solid.radius_m + b.solid.radius_m:
        return False
    first, second = (
        (c.corners_m[:, :2].min(axis=0), c.corners_m[:, :2].max(axis=0)) for c in (a, b)
    )
    gap = np.maximum(first[0], second[0]) - np.minimum(first[1], second[1])
    size = np.minimum(first[1] - first[0], second[1] - second[0])
    level = min(a.high_m, b.high_m) - max(a.low_m, b.low_m)
    next_to = level > 0.5 * min(a.high_m - a.low_m, b.high_m - b.low_m)
    inside = apart(a, b)
    if inside is not None and np.linalg.norm(inside) > FURNITURE_M:
        return True  # an open drawer
    if next_to:
        return bool(gap.max() < FLUSH_M and (-gap > 0.8 * size).sum() >= 1 and size.min() < 0.05)
    above = level > -TOUCH_M
    same = max(np.abs(first[0] - second[0]).max(), np.abs(first[1] - second[1]).max()) < LID_M
    return bool(above and same)
