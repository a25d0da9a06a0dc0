"""Grips: when a hand holds an object, read from the hand and the object's hull alone.

A grip needs evidence of three kinds. The fingers close, or the hand held the object before the
clip. The opening then stays although the hand moves. And the fingers stop at the object: both sides
touch its hull, with the pinch point inside. A fist that was closed before it came grips nothing.

The closing of a noisy hand may be smaller than its noise. Then the complete hold decides: fingers
that fit around an object and travel with a steady opening hold it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float

from egosim_jax.dynamics.hands import HandTrack
from egosim_jax.dynamics.solids import Solid
from egosim_jax.geometry import hinge_rotation, transform
from egosim_jax.types.arrays import Matrix, Points, Pose, Poses, Vector

STEADY_M = 0.0015
"""Maximum change of an exact hand's opening during a hold, in meters."""
SIGMAS = 2.5
"""Standard deviations of a noisy hand within which two values count as equal."""
CLOSING_FRAMES = 3
"""Number of frames before a hold in which a hand closes."""
FIT_M = 0.006
"""Maximum mean distance of fingers that fit around an object, in meters."""
TRAVEL_M = 0.03
"""Minimum distance that a noisy hand carries an object, in meters."""
CLOSING_M = 0.0015
"""Minimum closing of an exact hand before a hold, in meters."""
PAD_M = 0.012
"""Maximum distance of a touching fingertip from a hull, in meters: a finger's radius."""
DEEP_M = 0.012
"""Depth of the pinch point at which hulls may be too small by half of it, in meters.

The visible side of a ball is smaller than the ball."""
DENT_M = 0.018
"""Maximum depth of a fingertip in a hull, in meters; a fist that enters an object grips nothing."""
UNEVEN_M = 0.025
"""Maximum difference between the distances of both fingertips from a hull, in meters."""
INSIDE_M = 0.001
"""Maximum distance of the pinch point from a hull, in meters."""
SAME_WAY = 0.7
"""Minimum cosine between two steps of a hand that belong to one motion."""
MAX_ENDS = 9
"""Maximum number of frames at which a hold may begin or end if the fingers do not say when."""
MAX_TWIST_DEG, MAX_TILT_DEG = 60.0, 30.0
"""Largest turns about the vertical and away from it, in degrees, that noise may explain."""
PALM_WIDTH_M, PALM_LENGTH_M = 0.045, 0.08
"""Size of a palm, over which noise turns it, in meters."""
FIRST_FRAMES = 5
"""Number of frames at the beginning of a noisy hold; the most typical one is its direction."""
TURNED_SHARE = 0.8
"""Share of a hold's frames that are below its typical largest turn; the rest may be outliers."""
WIDE_M = 0.01
"""Minimum closing of a hand that holds what it closes on in the next clip, in meters."""
MIN_FRAMES = 2
"""Minimum number of frames of a hold after the first."""
MAX_ARC_DEG, MIN_ARC_DEG = 120.0, 25.0
"""Range of the angle of a hinge, in degrees; a shorter arc does not show its axis."""
MAX_ARC_ERROR = 0.05
"""Maximum distance of the pinch point from an arc, as a fraction of its radius."""
MIN_ARC_FRAMES = 8
"""Minimum number of frames of a noisy hand's arc."""
EDGE_M = 0.03
"""Maximum distance of a lid's or door's points from its hinge, in meters."""


@dataclass(frozen=True, kw_only=True)
class Hold:
    """Frames in which the opening of a hand is steady: it may hold an object."""

    begin: int
    """First frame."""
    steady: int
    """Last frame in which the opening is as at the beginning."""
    end: int
    """Last frame. A noisy hand holds on until it opens, although its opening may seem to close."""
    closes: bool
    """True if the hand closes just before."""
    opens: bool
    """True if the hand opens or is lost after the last frame, before the clip ends."""


@dataclass(frozen=True, kw_only=True)
class Contact:
    """Fingers around an object at the beginning of a hold."""

    pinch_m: Float[np.ndarray, " 3"]
    """Point between the fingertips when the object begins to move."""
    depth_m: float
    """Depth of the pinch point in the hull."""
    gap_m: float
    """Mean distance of thumb and fingers from the hull; negative inside."""


def find_holds(track: HandTrack) -> list[Hold]:
    """Return the possible holds of a hand, in the order of their beginning.

    The holds of an exact hand follow each other. A hold of a noisy hand may begin in any frame.
    """
    holds: list[Hold] = []
    begin = 0
    while begin < len(track.present) - MIN_FRAMES:
        steady = _last_steady(track, begin)
        if not track.present[begin] or steady - begin < MIN_FRAMES:
            begin += 1
            continue
        opening = track.opening_m
        before = opening[max(0, begin - CLOSING_FRAMES) : begin]
        width = float(np.median(opening[begin : steady + 1]))
        closing = before.max() - width if len(before) else 0.0
        end = _last_closed(track, steady, width) if track.sigma_m else steady
        holds.append(
            Hold(
                begin=begin,
                steady=steady,
                end=end,
                closes=bool(closing > CLOSING_M + SIGMAS * track.sigma_m),
                opens=end + 1 < len(opening),
            )
        )
        begin = begin + 1 if track.sigma_m else end + 1
    return holds


def first_hold(track: HandTrack) -> Hold:
    """Return the hold of a noisy hand that holds something in the first frame."""
    width = float(np.median(track.opening_m[:CLOSING_FRAMES]))
    end = _last_closed(track, 0, width)
    return Hold(begin=0, steady=0, end=end, closes=True, opens=end + 1 < len(track.present))


def possible_holds(track: HandTrack) -> list[Hold]:
    """Return the holds of a hand whose fingers do not say what they hold.

    An exact hand that closes holds something, if anything, in the holds that follow. For others,
    any two of some frames may be a hold.
    """
    closing = [hold for hold in find_holds(track) if hold.closes]
    if closing and not track.sigma_m:
        return closing
    frames = np.flatnonzero(track.present)
    ends = frames[np.linspace(0, len(frames) - 1, min(len(frames), MAX_ENDS)).astype(int)]
    return [
        Hold(begin=begin, steady=end, end=end, closes=False, opens=end + 1 < len(track.present))
        for begin, end in combinations(ends.tolist(), 2)
        if end - begin >= MIN_FRAMES
    ]


def closes_on(track: HandTrack, solid: Solid, pose: Pose) -> bool:
    """Return True if a hand closes around a solid until the last frame: it has not held it yet."""
    opening, tips = track.opening_m, track.tips_m[-1]
    if not track.present[-1] or opening[-1] > opening.min():
        return False
    if opening[-1] > opening.max() - WIDE_M - SIGMAS * track.sigma_m:
        return False
    *gaps, middle = solid.distance(np.concatenate([tips, track.pinch_m[-1:]]), pose)
    return bool(max(gaps) <= PAD_M + DEEP_M / 2 and middle < 0)


def _last_steady(track: HandTrack, begin: int) -> int:
    """Return the last frame until which the opening stays as it is in a frame.

    An exact opening that still changes in the next frame is not steady yet. A noisy one ends when
    two openings in a row differ from the median so far.
    """
    opening, frames = track.opening_m, len(track.present)
    if not track.sigma_m:
        end = begin
        while end + 1 < frames and track.present[end + 1]:
            if np.ptp(opening[begin : end + 2]) > STEADY_M:
                break
            end += 1
        return end
    limit = CLOSING_M + SIGMAS * track.sigma_m
    for end in range(begin, frames - 1):
        middle = np.median(opening[begin : end + 1])
        differs = np.abs(opening[end + 1 : end + 3] - middle) > limit
        if not track.present[end + 1] or differs.all():
            return end
    return frames - 1


def _last_closed(track: HandTrack, steady: int, width_m: float) -> int:
    """Return the frame from `steady` on before the one in which a noisy hand opens or is lost."""
    wide = track.opening_m > width_m + CLOSING_M + SIGMAS * track.sigma_m
    wide &= np.append(wide[1:], wide[-2])  # one wide frame is noise
    ended = np.flatnonzero((wide | ~track.present)[steady + 1 :])
    return steady + int(ended[0]) if len(ended) else len(wide) - 1


def contact_of(
    solid: Solid, pose: Pose, track: HandTrack, hold: Hold, *, slack_m: float = 0.0
) -> Contact | None:
    """Return the contact of the fingers around a solid in a hold; None if they do not grip it.

    `slack_m` is added to the distances that are allowed.

    A hand may close and begin to carry between two frames. So the pinch point of the frame before
    the hold counts too, first if the hand's motions before and after have one direction.
    """
    tips = track.grasping_m(hold.begin, hold.steady)
    pinch, slack = tips.mean(axis=0), slack_m + SIGMAS * track.sigma_m
    for point in _pinch_points(track, hold, pinch):
        around = tips - pinch + point
        *gaps, middle = solid.distance(np.concatenate([around, point[None]]), pose)
        depths = [
            0.0 if solid.is_open_at(tip, pose) else -gap
            for tip, gap in zip(around, gaps, strict=True)
        ]
        dented = max(depths) > min(DENT_M, UNEVEN_M - max(gaps)) + slack
        pad = PAD_M + min(max(-float(middle), 0.0), DEEP_M) / 2
        gap = float(np.mean(gaps))
        outside = gap > PAD_M + slack or middle > INSIDE_M + slack / 2
        if max(gaps) <= pad + slack and not (outside or dented):
            return Contact(pinch_m=point, depth_m=-float(middle), gap_m=gap)
    return None


def _pinch_points(track: HandTrack, hold: Hold, pinch_m: Vector) -> list[Vector]:
    """Return the places where the object may have begun to move, the most probable first."""
    if track.sigma_m or not 0 < hold.begin < hold.end:
        return [pinch_m]
    before, first, second = track.pinch_m[hold.begin - 1 : hold.begin + 2]
    come, go = first - before, second - first
    lengths = np.linalg.norm(come) * np.linalg.norm(go)
    one_motion = lengths > 0 and come @ go > SAME_WAY * lengths
    return [before, first] if one_motion else [first, before]


def is_grip(contact: Contact, track: HandTrack, hold: Hold) -> bool:
    """Return True if a contact of a hand that does not visibly close is a grip all the same.

    Only noise hides a closing. The fingers must fit around the object and carry it away.
    """
    if hold.closes:
        return True
    if not track.sigma_m:
        return False
    way = track.pinch_m[hold.begin : hold.end + 1] - track.pinch_m[hold.begin]
    return contact.gap_m <= FIT_M and np.linalg.norm(way, axis=1).max() >= TRAVEL_M


def hand_motion(track: HandTrack, hold: Hold, first_m: Vector, up: Vector) -> Poses:
    """Return the rigid motion of a hand since the beginning of a hold, constant after its end.

    `first_m` is the pinch point at the beginning (`Contact`). A noisy hand only moves, unless it
    clearly turns.
    """
    when = np.clip(np.arange(len(track.present)), hold.begin, hold.end)
    if track.sigma_m > 0:
        turn = _clear_turn(track.rotation[hold.begin : hold.end + 1], track.sigma_m, up)
        turn = turn[when - hold.begin]
    else:
        turn = track.rotation[when] @ track.rotation[hold.begin].T
    motion = np.repeat(np.eye(4)[None], len(when), axis=0)
    motion[:, :3, :3] = turn
    middle = track.center_m if track.sigma_m else track.pinch_m
    arm = first_m - middle[hold.begin] if track.sigma_m else np.zeros(3)
    motion[:, :3, 3] = middle[when] + turn @ arm - turn @ first_m
    motion[: hold.begin] = np.eye(4)
    return motion


def _clear_turn(
    rotation: Float[np.ndarray, "f 3 3"], sigma_m: float, up: Vector
) -> Float[np.ndarray, "f 3 3"]:
    """Return rotations of a noisy palm since its first frame, without what noise explains.

    Hands that a network lifts from a video turn back and forth by tens of degrees. The first
    direction is the most typical one of some frames, and single frames show no turn.
    """
    first = rotation[:FIRST_FRAMES]
    apart = np.linalg.norm(first[:, None] - first[None], axis=(2, 3)).sum(axis=1)
    turn = rotation @ first[apart.argmin()].T
    tilt = np.degrees(np.arccos(np.clip(np.einsum("i,fij,j->f", up, turn, up), -1, 1)))
    if _is_clear(tilt, sigma_m / PALM_LENGTH_M, MAX_TILT_DEG):
        return turn @ turn[0].T
    twists = np.stack([twist(matrix, up) for matrix in turn])
    cosines = (np.trace(twists, axis1=1, axis2=2) - 1) / 2
    if _is_clear(
        np.degrees(np.arccos(np.clip(cosines, -1, 1))), sigma_m / PALM_WIDTH_M, MAX_TWIST_DEG
    ):
        return twists @ twists[0].T
    return np.repeat(np.eye(3)[None], len(turn), axis=0)


def _is_clear(angles_deg: Float[np.ndarray, " f"], noise: float, largest_deg: float) -> bool:
    limit = min(largest_deg, np.degrees(6 * noise))
    return bool(np.quantile(angles_deg, TURNED_SHARE) > limit)


def twist(rotation: Matrix, axis: Vector) -> Matrix:
    """Return the component of a rotation about an axis (swing-twist decomposition)."""
    import cv2

    vector = cv2.Rodrigues(rotation)[0][:, 0]
    half = np.linalg.norm(vector) / 2
    along = np.sinc(half / np.pi) * (vector @ axis) / 2
    return cv2.Rodrigues(2 * np.arctan2(along, np.cos(half)) * axis)[0]


def hinge_motion(track: HandTrack, hold: Hold) -> Poses | None:
    """Return the motion of an object on a hinge; None unless the pinch point describes an arc.

    The motion is constant before and after the hold. A few noisy points always look like an arc.
    """
    if track.sigma_m and hold.end - hold.begin < MIN_ARC_FRAMES:
        return None
    path_m = track.pinch_m[hold.begin : hold.end + 1]
    middle = path_m.mean(axis=0)
    across, along, normal = np.linalg.svd(path_m - middle, full_matrices=False)[2]
    flat = (path_m - middle) @ np.stack([across, along], axis=1)
    # |p|^2 = 2 p . center + (radius^2 - |center|^2), linear in the center
    rows = np.concatenate([2 * flat, np.ones((len(flat), 1))], axis=1)
    (x, y, rest), *_ = np.linalg.lstsq(rows, (flat**2).sum(axis=1), rcond=None)
    radius = np.sqrt(max(rest + x * x + y * y, 0))
    spokes = flat - [x, y]
    angles = np.unwrap(np.arctan2(spokes[:, 1], spokes[:, 0]))
    off = np.hypot(np.linalg.norm(spokes, axis=1) - radius, (path_m - middle) @ normal)
    turned = np.degrees(np.ptp(angles))
    if not MIN_ARC_DEG <= turned <= MAX_ARC_DEG or off.max() > MAX_ARC_ERROR * radius:
        return None
    axis = np.cross(across, along)
    center = middle + x * across + y * along
    motion = np.stack([hinge_rotation(axis, center, float(a)) for a in angles - angles[0]])
    return motion[np.clip(np.arange(len(track.present)), hold.begin, hold.end) - hold.begin]


def is_along_edge(points_m: Points, hinged: Pose) -> bool:
    """Return True if the axis of a hinge's motion passes along an object that has these points.

    A point of a motion by an angle a, at a distance r from the axis, moves by 2 r sin(a / 2).
    """
    chord = np.sqrt(max(3.0 - float(np.trace(hinged[:3, :3])), 0.0))  # 2 sin(a / 2)
    moved = np.linalg.norm(transform(hinged, points_m) - points_m, axis=1)
    return bool(moved.min() <= EDGE_M * chord)
