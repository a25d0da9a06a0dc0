"""Grasps read from hand joints: when a hand held an object, which one, and how it moved.

The distance of the fingertips gives the times (`find_holds`), and the points between them give the
object (`is_between`). The motion of a loose object is one of three couplings to the hand
(`couplings`): translation only, translation with rotation about the surface normal, or the full
motion of the palm. A lid or door turns about the axis of the fingertips' arc (`hinge_motion`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.geometry import hinge_rotation, transform, umeyama
from egosim_jax.perception.silhouettes import PALM
from egosim_jax.types import Kind

TIPS: dict[Kind, list[int]] = {"human": [4, 8, 12], "robot": [1, 2]}
"""Grasping joints: tips of thumb, index and middle finger; both jaws of a gripper."""
MIN_HELD = 2
"""Minimum number of frames between a grasp and a release."""
CLOSING_M = 0.001
"""Minimum change of the opening of a hand that closes, in meters per frame."""
MAX_NOISE = 0.1
"""Maximum noise of the opening: the 25th percentile of its bends, in tolerances of a hold."""
MIN_BENDS = 8
"""Minimum number of bends that show the noise of an opening."""
MAX_ENDS = 24
"""Maximum number of frames at which a hold may begin or end if the opening is no evidence."""
MAX_DEPTH_M = 0.06
"""Maximum distance of a grip behind the visible side of the gripped object, in meters."""
FIT_M = 0.01
"""Error of the width of a gripped object on either side, in meters."""
MAX_ARC_DEG = 120.0
"""Maximum angle of a hinge in degrees; jitter of a hand looks like a tighter arc."""
MIN_ARC_DEG = 25.0
"""Minimum angle of an arc, in degrees; a shorter arc does not determine its axis."""
MAX_ARC_ERROR = 0.05
"""Maximum distance of the fingertips from an arc, as a fraction of its radius."""
EDGE_M = 0.03
"""Maximum distance of a lid's or door's points from its hinge, in meters."""
FIRM_TOUCH_M = 0.015
"""Maximum distance of fingertips inside or outside the surface of an object that they hold."""
FIRM_TRAVEL_M = 0.03
"""Minimum distance that a hand carries what it holds firmly, in meters."""


@dataclass(frozen=True, kw_only=True)
class Grip:
    """Joints of one hand, and the times at which it may have held an object."""

    palm_m: Float[np.ndarray, "f j 3"]
    tips_m: Float[np.ndarray, "f t 3"]
    holds: list[tuple[int, int]]
    """Frames of the grasp and of the release of each possible hold."""
    sure: bool
    """True if the hand surely held something."""
    radius_m: float
    """Maximum distance of a gripped point from the line between the fingertips, in meters."""
    eyes_m: Float[np.ndarray, "f 3"]
    """Place of the camera in each frame."""
    carried: int | None = None
    """Object that the hand has held since the clip before, if it has one."""

    @classmethod
    def of(
        cls,
        joints_m: Float[np.ndarray, "f j 3"],
        kind: Kind,
        eyes_m: Float[np.ndarray, "f 3"],
        *,
        tolerance_m: float,
        radius_m: float,
        before: tuple[int, Float[np.ndarray, "n 3"]] | None = None,
    ) -> Grip:
        """Return the grip of a hand whose opening changes by at most a tolerance in a hold.

        Missing frames are completed (`complete_hand`), and a hold is within the frames in between.
        `before` is the object that the hand held at the end of the clip before, and its points. The
        hand still holds it if they are in its grip in the first frame.
        """
        seen = seen_frames(joints_m)
        joints_m = complete_hand(joints_m, seen)
        tips, palm = joints_m[:, TIPS[kind]], joints_m[:, PALM[kind]]
        first = int(seen[0])
        carried = None
        if before and first == 0 and in_grip(before[1], tips[0], eyes_m[0], radius_m):
            carried = before[0]
        holds, sure = find_holds(
            tips[first : int(seen[-1]) + 1], tolerance_m, holding=carried is not None
        )
        holds = [(grasped + first, released + first) for grasped, released in holds]
        return cls(
            palm_m=palm,
            tips_m=tips,
            holds=holds,
            sure=sure,
            radius_m=radius_m,
            eyes_m=eyes_m,
            carried=carried,
        )

    @property
    def grasps(self) -> list[int]:
        """Frames at which a possible hold begins."""
        return sorted({grasped for grasped, _ in self.holds})

    @cached_property
    def rigid(self) -> dict[int, Float[np.ndarray, "f 4 4"]]:
        """Motion of the palm since each grasp."""
        return {grasped: palm_motion(self.palm_m, grasped) for grasped in self.grasps}

    @cached_property
    def hinges(self) -> dict[tuple[int, int], Float[np.ndarray, "f 4 4"] | None]:
        """Motion about a hinge in each hold; None without a hinge."""
        return {hold: hinge_motion(self.tips_m, hold) for hold in self.holds}

    def has(self, points_m: Float[np.ndarray, "n 3"], grasped: int) -> bool:
        """Return True if the hand surely holds an object that has these points at a grasp."""
        tips, eye = self.tips_m[grasped], self.eyes_m[grasped]
        return self.sure and in_grip(points_m, tips, eye, self.radius_m)


def seen_frames(joints_m: Float[np.ndarray, "f j 3"]) -> Int[np.ndarray, " k"]:
    """Return the frames with a hand."""
    return np.flatnonzero(np.isfinite(joints_m).all(axis=(1, 2)))


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


def opening_of(tips_m: Float[np.ndarray, "f j 3"]) -> Float[np.ndarray, " f"]:
    """Return the distance between thumb and fingers in each frame, in meters."""
    return np.linalg.norm(tips_m[:, 0] - tips_m[:, 1:].mean(axis=1), axis=-1)


def find_holds(
    tips_m: Float[np.ndarray, "f j 3"], tolerance_m: float, *, holding: bool = False
) -> tuple[list[tuple[int, int]], bool]:
    """Return (grasp, release) frames of possible holds, and True if the hand surely held.

    A held object keeps the fingertips at a constant distance. A hold begins when the hand closes,
    or at the first frame, and ends when it opens, or at the last frame. A hand that never closes
    may have held an object while its opening was steady. If the opening is always or never steady,
    or has noise as in a video, it is no evidence, and any two frames may be a hold: any two of some
    frames of a long clip. A hand that is `holding` something in the first frame, and whose opening
    is always steady, holds it in all frames.
    """
    opening = opening_of(tips_m)
    pairs = [(g, r) for g, r in combinations(range(len(tips_m)), 2) if r - g >= MIN_HELD]
    bends = np.abs(np.diff(opening, 2))
    noise = np.percentile(bends, 25) if len(bends) >= MIN_BENDS else 0.0
    if holding and np.ptp(opening) <= tolerance_m:
        return [(0, len(tips_m) - 1)], True
    if np.ptp(opening) <= tolerance_m or noise > MAX_NOISE * tolerance_m:
        ends = set(np.linspace(0, len(opening) - 1, MAX_ENDS).astype(int).tolist())
        return [pair for pair in pairs if ends.issuperset(pair)], False
    steady = [(g, r) for g, r in pairs if np.ptp(opening[g : r + 1]) <= tolerance_m]
    longest = [(g, r) for g, r in steady if (g - 1, r) not in steady and (g, r + 1) not in steady]
    padded = np.pad(opening, 1, constant_values=np.inf)  # may hold from frame 0 on
    closed = [
        (g, r) for g, r in longest if min(padded[g], padded[r + 2]) > opening[g : r + 1].mean()
    ]
    if opening[-2] - opening[-1] > CLOSING_M:  # a hand that still closes has not held yet
        closed = [hold for hold in closed if hold[1] < len(opening) - 1]
    return closed or longest or pairs, bool(closed)


def in_grip(
    points_m: Float[np.ndarray, "n 3"],
    tips_m: Float[np.ndarray, "j 3"],
    eye_m: Float[np.ndarray, " 3"],
    radius_m: float,
) -> bool:
    """Return True if the fingertips are around an object that has these points."""
    between = is_between(points_m, tips_m, radius_m)
    return between or is_behind(points_m, tips_m, eye_m, radius_m)


def is_between(
    points_m: Float[np.ndarray, "n 3"], tips_m: Float[np.ndarray, "j 3"], radius_m: float
) -> bool:
    """Return True if some point is between the thumb and the fingers, within a radius in meters."""
    share, away = from_grip(points_m, tips_m)
    return bool(((share > 0) & (share < 1) & (away <= radius_m)).any())


def from_grip(
    points_m: Float[np.ndarray, "n 3"], tips_m: Float[np.ndarray, "j 3"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return points' places between thumb (0) and fingers (1), and distances from there in meters.

    Places outside of the grip are clipped to its ends.
    """
    thumb, fingers = tips_m[0], tips_m[1:].mean(axis=0)
    across = fingers - thumb
    share = np.clip((points_m - thumb) @ across / max(across @ across, 1e-12), 0, 1)
    return share, np.linalg.norm(points_m - thumb - share[:, None] * across, axis=1)


def is_behind(
    points_m: Float[np.ndarray, "n 3"],
    tips_m: Float[np.ndarray, "j 3"],
    eye_m: Float[np.ndarray, " 3"],
    radius_m: float,
) -> bool:
    """Return True if the line from the thumb to the fingers is inside an object behind its points.

    Only the side of an object that the camera sees has points. It must fill most of the space
    between the fingertips. It may be wider than that, as the base of a cone is, but not by much.
    """
    thumb, fingers = tips_m[0], tips_m[1:].mean(axis=0)
    opening = max(float(np.linalg.norm(fingers - thumb)), 1e-9)
    across = (fingers - thumb) / opening
    ray = eye_m - (thumb + fingers) / 2
    ray -= (ray @ across) * across
    ray /= max(float(np.linalg.norm(ray)), 1e-9)
    along = (points_m - thumb) @ across
    away = points_m - thumb - along[:, None] * across
    toward = away @ ray
    aside = np.linalg.norm(away - toward[:, None] * ray, axis=1)
    front = along[(aside <= radius_m) & (toward >= 0) & (toward <= MAX_DEPTH_M)]
    if not len(front):
        return False
    slack = opening / 2 + FIT_M
    fits = front.min() >= -slack and front.max() <= opening + slack
    return bool(fits and np.ptp(np.clip(front, 0, opening)) >= opening / 2)


def is_firm(
    faces: Float[np.ndarray, "m 4"], tips_m: Float[np.ndarray, "f j 3"], hold: tuple[int, int]
) -> bool:
    """Return True if the fingertips close on two sides of an object, and then carry it away.

    `faces` are the outward planes of the object's convex hull at the grasp. Both thumb and fingers
    must touch the hull, with the middle between them inside it.
    """
    grasped, released = hold
    middle = (tips_m[:, 0] + tips_m[:, 1:].mean(axis=1)) / 2
    carried = middle[grasped : released + 1] - middle[grasped]
    far = np.linalg.norm(carried, axis=1).max() >= FIRM_TRAVEL_M
    return bool(far and touches(faces, tips_m[grasped]))


def touches(faces: Float[np.ndarray, "m 4"], tips_m: Float[np.ndarray, "j 3"]) -> bool:
    """Return True if thumb and fingers touch a hull of these outward planes from two sides."""
    outside = _outside(faces, tips_m)
    return bool(np.abs(outside[:2]).max() <= FIRM_TOUCH_M and outside[2] < 0)


def encloses(faces: Float[np.ndarray, "m 4"], tips_m: Float[np.ndarray, "j 3"]) -> bool:
    """Return True if thumb and fingers touch a hull from two sides, or are inside it."""
    outside = _outside(faces, tips_m)
    return bool(outside[:2].max() <= FIRM_TOUCH_M and outside[2] < 0)


def _outside(
    faces: Float[np.ndarray, "m 4"], tips_m: Float[np.ndarray, "j 3"]
) -> Float[np.ndarray, " 3"]:
    """Return how far thumb, fingers and their middle are outside a hull; negative inside."""
    thumb, fingers = tips_m[0], tips_m[1:].mean(axis=0)
    places = np.stack([thumb, fingers, (thumb + fingers) / 2])
    return (places @ faces[:, :3].T + faces[:, 3]).max(axis=1)


def closes_to_end(tips_m: Float[np.ndarray, "f j 3"], tolerance_m: float) -> bool:
    """Return True if a hand closes, by more than a tolerance, until the last frame."""
    opening = opening_of(tips_m)
    return bool(opening[-1] <= opening.min() and opening[-1] < opening.max() - tolerance_m)


def palm_motion(palm_m: Float[np.ndarray, "f j 3"], grasped: int) -> Float[np.ndarray, "f 4 4"]:
    """Return the rigid motion of the palm from the frame of a grasp to each frame."""
    return np.stack([umeyama(palm_m[grasped], frame) for frame in palm_m])


def couplings(
    palm_m: Float[np.ndarray, "f j 3"],
    rigid: Float[np.ndarray, "f 4 4"],
    normal: Float[np.ndarray, " 3"],
    hold: tuple[int, int],
) -> Iterator[Float[np.ndarray, "f 4 4"]]:
    """Yield the world motion of a held loose object for each coupling to the hand.

    `rigid` is the `palm_motion` since the grasp. Each motion is relative to the first frame, and
    constant before the grasp and after the release.
    """
    grasped, released = hold
    when = np.clip(np.arange(len(palm_m)), grasped, released)
    center = palm_m.mean(axis=1)
    upright, sliding = rigid.copy(), rigid.copy()
    for frame, motion in enumerate(rigid):
        upright[frame, :3, :3] = _twist(motion[:3, :3], normal)
        sliding[frame, :3, :3] = np.eye(3)
        for other in (upright, sliding):
            other[frame, :3, 3] = center[frame] - other[frame, :3, :3] @ center[grasped]
    for motion in (sliding, upright, rigid):
        yield motion[when]


def hinge_motion(
    tips_m: Float[np.ndarray, "f j 3"], hold: tuple[int, int]
) -> Float[np.ndarray, "f 4 4"] | None:
    """Return the motion of an object on a hinge; None unless the fingertips describe an arc.

    The motion is constant before the grasp and after the release.
    """
    grasped, released = hold
    path_m = (tips_m[:, 0] + tips_m[:, 1:].mean(axis=1))[grasped : released + 1] / 2
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
    return motion[np.clip(np.arange(len(tips_m)), grasped, released) - grasped]


def is_along_edge(points_m: Float[np.ndarray, "n 3"], hinged: Float[np.ndarray, "f 4 4"]) -> bool:
    """Return True if the axis of a `hinge_motion` passes along an object that has these points.

    A point of a motion by an angle a, at a distance r from the axis, moves by 2 r sin(a / 2).
    """
    turned = hinged[-1][:3, :3]
    chord = np.sqrt(max(3.0 - float(np.trace(turned)), 0.0))  # 2 sin(a / 2)
    moved = np.linalg.norm(transform(hinged[-1], points_m) - points_m, axis=1)
    return bool(moved.min() <= EDGE_M * chord)


def _twist(
    rotation: Float[np.ndarray, "3 3"], axis: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the component of a rotation about an axis (swing-twist decomposition)."""
    import cv2

    vector = cv2.Rodrigues(rotation)[0][:, 0]
    half = np.linalg.norm(vector) / 2
    along = np.sinc(half / np.pi) * (vector @ axis) / 2
    return cv2.Rodrigues(2 * np.arctan2(along, np.cos(half)) * axis)[0]
