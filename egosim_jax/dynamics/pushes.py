"""Pushes: a hand or an object that enters an object from the side moves it.

A pushed object slides on its support, and turns by the friction under it. The limit surface is an
ellipsoid: a force f at r from the center gives the velocity v = f and the turn w = (r x f) / c^2,
with c the radius of gyration of the pressure (Goyal, Ruina and Papadopoulos 1991). An object that
was pushed pushes the next one.

Not every part of a hand that is inside an object pushes it: fingers come from above, close around
an object, or open or rise in it. A point of the hand that once did not push an object only presses
on it until it leaves it.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.dynamics.grips import contact_of
from egosim_jax.dynamics.hands import HandTrack
from egosim_jax.dynamics.solids import Solid
from egosim_jax.dynamics.support import Body, apart, carry_riders
from egosim_jax.dynamics.walk import Walk
from egosim_jax.geometry import rotation_z, transform
from egosim_jax.rendering.skeleton import SKELETONS
from egosim_jax.types import Kind
from egosim_jax.types.arrays import Pose, Vector

FLESH_M: dict[Kind, float] = {"human": 0.008, "robot": 0.006}
"""Radius of flesh around joints and bones, in meters."""
JAW_SHARES = (0.2, 0.4, 0.6)
"""Places of touching points along a jaw, from its tip, as fractions of the way to the wrist."""
RIM_M = 0.003
"""Depth below the top of an object up to which a point glances off it, in meters."""
STEEP = 0.7
"""Vertical component of a normal above which a point presses on an object."""
STEEPNESS = 0.15
"""Vertical per horizontal motion from which an open hand comes down on an object, or leaves it."""
FACING = 0.4
"""Component of a normal along the opening of a hand from which a side of an object faces a tip."""
RESTS_M = 0.001
"""Motion between two frames below which a hand rests, and pushes nothing, in meters."""
STEP_M = 0.006
"""Maximum motion of a joint between two contacts, in meters."""
MAX_STEPS = 16
"""Maximum number of contacts between two frames."""
MAX_PUSHES = 8
"""Maximum number of pushes of one object in one contact: two fingers may squeeze it."""
LEAVE_M = (0.003, 0.010)
"""Distances of flesh and of the pinch point at which a hand has left an object, in meters."""
MISS_M = 0.01
"""Distance of a near miss of fingers that close on an object, in meters."""
CLOSES_M = 0.0001
"""Change of the opening of a hand that closes, in meters a frame."""
FITS_M = 0.012
"""Excess width of an object that still fits in an open hand, in meters: hulls err."""
OVERLAP_M = 0.004
"""Maximum overlap of two hulls before a push, in meters; deeper ones are errors of the hulls."""


def push(walk: Walk) -> None:
    """Push objects out of the hands, and out of the objects that moved."""
    for hand, track in walk.tracks.items():
        if not track.present[walk.frame - 1 : walk.frame + 1].all():
            continue
        before, after = track.joints_m[walk.frame - 1 : walk.frame + 1]
        if walk.frame == 1 or not track.present[walk.frame - 2]:
            _appear(walk, hand, before)
        length = float(np.linalg.norm(after - before, axis=-1).max())
        if length < RESTS_M:  # what another hand brings to it, it lets in
            _appear(walk, hand, after)
            continue
        steps = int(np.clip(np.ceil(length / STEP_M), 1, MAX_STEPS))
        for number in walk.solids:
            if _may_push(walk, hand, number, length):
                for share in np.arange(1, steps + 1) / steps:
                    joints = before + share * (after - before)
                    _push_one(walk, hand, number, joints, (after - before) / steps)
    _push_on(walk)


def _flesh_m(track: HandTrack) -> float:
    """Return the radius of a hand's flesh; a noisy hand must be surely inside an object."""
    return FLESH_M[track.kind] - 2 * track.sigma_m


@cache
def _touching(kind: Kind) -> Float[np.ndarray, "p j"]:
    """Return the weights of the joints in each touching point: joints, and points between them."""
    joints = np.eye(len(SKELETONS[kind].colors))
    if kind == "robot":  # the jaws are parallel
        back = joints[0] - joints[1:].mean(axis=0)
        between = [tip + share * back for tip in joints[1:] for share in JAW_SHARES]
    else:
        between = [joints[bone].mean(axis=0) for bone in SKELETONS[kind].bones]
    return np.concatenate([joints, between])


@cache
def _fingers(kind: Kind) -> Bool[np.ndarray, " p"]:
    """Return which touching points are on fingers or jaws, and not on the palm."""
    palm = [0, 1, 5, 9, 13, 17] if kind == "human" else [0]
    return _touching(kind)[:, palm].sum(axis=1) < 1


def _appear(walk: Walk, hand: int, joints_m: Float[np.ndarray, "j 3"]) -> None:
    """Note the points that are inside objects when a hand appears.

    A hand that is around an object in the first frame may have released it before.
    """
    track = walk.tracks[hand]
    points = _touching(track.kind) @ joints_m
    for number, solid in walk.solids.items():
        pinch, *gaps = solid.distance(
            np.concatenate([track.pinch_m[walk.frame - 1][None], points]), walk.poses[number]
        )
        inside = np.flatnonzero(np.array(gaps) < _flesh_m(track))
        walk.pressing |= {(hand, int(point), number) for point in inside}
        if walk.frame == 1 and pinch < LEAVE_M[1]:
            walk.around.add((hand, number))


def _may_push(walk: Walk, hand: int, number: int, length_m: float) -> bool:
    """Return True if a hand is near an object that it neither holds nor will hold where it is.

    Fingers that close on an object where it is now, or miss it by a little, have not pushed it away
    before.
    """
    if number in walk.furniture or number in walk.in_hands:
        return False
    track, solid, pose = walk.tracks[hand], walk.solids[number], walk.poses[number]
    center = transform(pose, solid.center_m[None])[0]
    gaps = np.linalg.norm(track.joints_m[walk.frame] - center, axis=1)
    if gaps.min() > solid.radius_m + length_m + LEAVE_M[1]:
        return False
    holds = [hold for hold in walk.holds[hand] if hold.begin >= walk.frame]
    if walk.given.get(hand) == number and walk.holds[hand][0] in holds:
        return False
    return not any(
        hold.closes and contact_of(solid, pose, track, hold, slack_m=MISS_M) for hold in holds
    )


def _push_one(
    walk: Walk,
    hand: int,
    number: int,
    joints_m: Float[np.ndarray, "j 3"],
    way_m: Float[np.ndarray, "j 3"],
) -> None:
    """Push an object out of the flesh of a hand that enters it from the side."""
    solid, track, pose = walk.solids[number], walk.tracks[hand], walk.poses[number]
    weights, flesh = _touching(track.kind), _flesh_m(track)
    points = weights @ joints_m
    distances = solid.distance(points, pose)
    inside = distances < flesh
    if solid.distance(track.pinch_m[walk.frame][None], pose)[0] > LEAVE_M[1]:
        for point in np.flatnonzero(distances > flesh + LEAVE_M[0]):
            walk.pressing.discard((hand, int(point), number))
        if not inside.any():
            walk.left.discard((hand, number))
            walk.around.discard((hand, number))
    entering = [
        int(point)
        for point in np.flatnonzero(inside)
        if (hand, int(point), number) not in walk.pressing
    ]
    if not entering:
        return
    if (hand, number) in walk.left | walk.around:
        presses = set(entering)
    else:
        yields = _yields(walk, hand, number, weights @ way_m)
        presses = {point for point in entering if yields[point]}
        rest = [point for point in entering if not yields[point]]
        motion, pressing = push_out(solid, pose, points[rest], flesh)
        presses |= {rest[index] for index in np.flatnonzero(pressing)}
        if motion is not None:
            carry_riders(walk, number, motion @ pose, hand)
            walk.move(number, motion @ pose, "pushed", hand)
    walk.pressing |= {(hand, point, number) for point in presses}


def _yields(
    walk: Walk, hand: int, number: int, way_m: Float[np.ndarray, "p 3"]
) -> Bool[np.ndarray, " p"]:
    """Return which points of a hand yield to an object, because the hand reaches around it.

    The object must fit in the hand. Fingers that close on it yield while it is between thumb and
    fingers. All points yield that come down on it or rise from it. A noisy hand may close unseen.
    """
    track, solid, pose = walk.tracks[hand], walk.solids[number], walk.poses[number]
    thumb, fingers = track.tips_m[walk.frame]
    opening = fingers - thumb
    size = max(float(np.linalg.norm(opening)), 1e-9)
    level = opening * [1, 1, 0] / max(float(np.hypot(*opening[:2])), 1e-9)
    if size < solid.width_along(level, pose) - FITS_M:
        return np.zeros(len(way_m), bool)
    vertical = np.abs(way_m[:, 2]) > STEEPNESS * np.linalg.norm(way_m[:, :2], axis=1)
    first, second = (solid.normal(tip, pose)[1] @ opening / size for tip in (thumb, fingers))
    around = first < -FACING and second > FACING
    change_m = float(np.diff(track.opening_m[walk.frame - 1 : walk.frame + 1])[0])
    closes = track.sigma_m > 0 or change_m < -CLOSES_M
    return vertical | _fingers(track.kind) if around and closes else vertical


def push_out(
    solid: Solid, pose: Pose, points_m: Float[np.ndarray, "p 3"], flesh_m: float
) -> tuple[Pose | None, Bool[np.ndarray, " p"]]:
    """Return the motion of a solid out of the flesh around points, the deepest one first.

    Also returns which points press instead, because they are above or below it. A push may turn the
    solid under the next point, so that this is decided before each push. None without a push.
    """
    motion, pressing = None, np.zeros(len(points_m), bool)
    for _ in range(MAX_PUSHES + len(points_m) if len(points_m) else 0):
        now = pose if motion is None else motion @ pose
        distances = solid.distance(points_m, now)
        distances[pressing] = np.inf
        deepest = int(distances.argmin())
        if distances[deepest] >= flesh_m - 1e-6:
            break
        distance, normal = solid.normal(points_m[deepest], now)
        top = float(transform(now, solid.corners_m)[:, 2].max())
        if abs(normal[2]) > STEEP or points_m[deepest, 2] > top - RIM_M:  # it glances off
            pressing[deepest] = True
            continue
        step = _slide(solid, now, points_m[deepest], normal, flesh_m - distance)
        motion = step if motion is None else step @ motion
    return motion, pressing


def _slide(solid: Solid, pose: Pose, point_m: Vector, normal: Vector, depth_m: float) -> Pose:
    """Return the motion of a solid by the depth of a point in it; the normal is not vertical."""
    level = float(np.hypot(normal[0], normal[1]))
    force = -np.array([normal[0], normal[1], 0.0]) / level
    center = transform(pose, solid.center_m[None])[0]
    lever = point_m - center
    torque = float(lever[0] * force[1] - lever[1] * force[0])
    square = solid.gyration_m**2
    amount = depth_m / level / (1 + torque**2 / square)
    motion = np.eye(4)
    motion[:3, :3] = rotation_z(amount * torque / square)
    motion[:3, 3] = center + amount * force - motion[:3, :3] @ center
    return motion


def _push_on(walk: Walk) -> None:
    """Push resting objects out of the objects that moved in this frame."""
    moved = [
        number
        for number, pose in walk.poses.items()
        if np.abs(pose - walk.before(number)).max() > 1e-5
    ]
    for number in moved:
        hand = walk.causes[number][-1].hand
        solid = walk.solids[number]
        body, body_before = Body(solid, walk.poses[number]), Body(solid, walk.before(number))
        for other, resting in walk.solids.items():
            if other in moved or other in walk.furniture or other in walk.in_hands:
                continue
            way = apart(Body(resting, walk.poses[other]), body)
            if way is None:
                continue
            overlap = apart(Body(resting, walk.before(other)), body_before)
            if overlap is not None and np.linalg.norm(overlap) > OVERLAP_M:
                continue
            pose = walk.poses[other].copy()
            pose[:2, 3] += way
            carry_riders(walk, other, pose, hand)
            walk.move(other, pose, "pushed", hand)
