"""Hands and grippers: joints by forward kinematics, and their meshes.

A right hand's local frame has the wrist at the origin, the fingers along y, the back of the hand
along z and the thumb on the side of -x; a left hand is its mirror image in x. A gripper's frame has
its wrist at the origin and its two fingers along y, opening along x.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.rendering.mesh import Side
from egosim_jax.rendering.skeleton import SKELETONS
from egosim_jax.types import JOINTS, Kind
from egosim_jax.worlds.tabletop.bodies import Part, join
from egosim_jax.worlds.tabletop.embree import Mesh, make_mesh

KNUCKLES_M = np.array([[-0.026, 0.090, 0.0], [-0.004, 0.094, 0.002], [0.017, 0.088, 0.0],
                       [0.036, 0.078, -0.004]])  # fmt: skip
"""Knuckles of index, middle, ring and little finger in the local frame, in meters."""
PHALANGES_M = np.array([[0.042, 0.025, 0.021], [0.046, 0.029, 0.022], [0.042, 0.027, 0.022],
                        [0.033, 0.020, 0.019]])  # fmt: skip
"""Lengths of the three phalanges of each finger in meters."""
SPREAD = np.radians([8.0, 1.0, -6.0, -14.0])
"""Angle of each open finger towards the thumb, in radians."""
THUMB_M = (np.array([-0.028, 0.026, -0.014]), (0.040, 0.031, 0.025))
"""First joint of the thumb, and the lengths of its three segments, in meters."""
KNUCKLES = [5, 9, 13, 17]
"""Keypoints of the four knuckles."""
GRIPPER_M = (0.12, 0.10)
"""Length of a gripper's fingers, and distance of its open tips, in meters."""
PALM_M = 0.045
"""Distance of a gripper's palm, where its jaws begin, from its wrist, in meters."""
FLESH_M: dict[Kind, float] = {"human": 0.008, "robot": 0.006}
"""Radius of the flesh around the bones of a hand, and of the jaws of a gripper, in meters."""
SPACING_M = 0.03
"""Maximum distance of touching points along a bone, in meters."""
SKIN, SLEEVE, ENAMEL, RUBBER = (216, 150, 118), (72, 88, 112), (40, 150, 160), (52, 52, 56)
"""RGB colors of hand, forearm, gripper body and gripper fingers."""


def human_joints(closure: float, side: Side) -> Float[np.ndarray, "21 3"]:
    """Return the 21 keypoints in the local frame in meters, from open (closure 0) to a fist (1)."""
    joints = [np.zeros(3)]
    base, lengths = THUMB_M
    aside, across = np.array([-0.62, 0.66, -0.42]), np.array([0.10, 0.72, -0.69])
    direction = aside + min(1.0, 1.4 * closure) * (across - aside)
    ends = [base]
    for number, length in enumerate(lengths):
        bent = direction + number * closure * np.array([0.25, 0.0, -0.10])
        ends.append(ends[-1] + length * bent / np.linalg.norm(bent))
    joints += ends
    for knuckle, phalanges, spread in zip(KNUCKLES_M, PHALANGES_M, SPREAD, strict=True):
        angles = np.cumsum(np.radians([8, 10, 6]) + closure * np.radians([68, 84, 52]))
        ends = [knuckle]
        away = spread * (1 - closure)
        for angle, length in zip(angles, phalanges, strict=True):
            flat = np.cos(angle)
            step = np.array([-np.sin(away) * flat, np.cos(away) * flat, -np.sin(angle)])
            ends.append(ends[-1] + length * step)
        joints += ends
    mirror = np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
    return np.array(joints) * mirror


def gripper_joints(closure: float) -> Float[np.ndarray, "3 3"]:
    """Return wrist and fingertips in the local frame in meters, from closure 0 (open) to 1."""
    length, opening = GRIPPER_M
    half = opening / 2 * (1 - closure)
    return np.array([[0, 0, 0], [-half, length, 0], [half, length, 0]])


def joints_of(kind: Kind, closure: float, side: Side) -> Float[np.ndarray, "j 3"]:
    """Return the joints of a hand or gripper in its local frame, in meters."""
    return human_joints(closure, side) if kind == "human" else gripper_joints(closure)


def tips_of(joints_m: Float[np.ndarray, "j 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the grasping tips: thumb, and the middle of index and middle fingertip."""
    if len(joints_m) == 3:
        return joints_m[1], joints_m[2]
    return joints_m[4], (joints_m[8] + joints_m[12]) / 2


def pinch(joints_m: Float[np.ndarray, "j 3"]) -> tuple[Float[np.ndarray, " 3"], float]:
    """Return the point between the grasping fingertips, and their distance, in meters."""
    thumb, fingers = tips_of(joints_m)
    return (thumb + fingers) / 2, float(np.linalg.norm(thumb - fingers))


def opening_of(joints_m: Float[np.ndarray, "j 3"]) -> Float[np.ndarray, " 3"]:
    """Return the vector from the thumb or first jaw to the fingers, in meters; 0 in a fist."""
    thumb, fingers = tips_of(joints_m)
    way = fingers - thumb
    if len(joints_m) == JOINTS["human"]:  # the fingertips of a fist are behind the thumb's
        way = way * float(way @ (joints_m[KNUCKLES].mean(axis=0) - joints_m[0]) > 0)
    return way


def touching(joints_m: Float[np.ndarray, "j 3"], kind: Kind) -> Float[np.ndarray, "p 3"]:
    """Return the points of a hand that touch bodies: its joints, then points along long bones."""
    return _along_bones(kind) @ joints_m


@cache
def fingers_of(kind: Kind) -> Bool[np.ndarray, " p"]:
    """Return which touching points are on fingers or jaws, and not on the palm."""
    palm = [0, 1, *KNUCKLES] if kind == "human" else [0]
    return _along_bones(kind)[:, palm].sum(axis=1) < 1 - 1e-9


@cache
def _along_bones(kind: Kind) -> Float[np.ndarray, "p j"]:
    """Return the weights of the joints in each touching point."""
    joints, rows = joints_of(kind, 0.0, "right"), np.eye(JOINTS[kind])
    if kind == "human":
        ends = [(rows[a], rows[b]) for a, b in SKELETONS["human"].bones]
    else:  # the jaws are parallel, from the palm to the tips
        palm = (1 - PALM_M / GRIPPER_M[0]) * (rows[0] - (rows[1] + rows[2]) / 2)
        ends = [(tip + palm, tip) for tip in rows[1:]]
    points = list(rows)
    for first, last in ends:
        length = float(np.linalg.norm((last - first) @ joints))
        shares = np.linspace(0, 1, int(np.ceil(length / SPACING_M)) + 1)[1:-1]
        points += [first + share * (last - first) for share in shares]
    return np.array(points)


def frame_of(joints_m: Float[np.ndarray, "j 3"], kind: Kind) -> Float[np.ndarray, "4 4"]:
    """Return the world pose of a hand: axes of its local frame, origin at the pinch point.

    The axes of a human hand follow the palm.
    """
    # A left hand is a mirror image, with left-handed axes. Its x and z are therefore reversed here.
    if kind == "robot":
        along, across = (joints_m[1] + joints_m[2]) / 2 - joints_m[0], joints_m[2] - joints_m[1]
        if np.linalg.norm(across) < 1e-6:  # closed: assume that the jaws open horizontally
            vertical = np.linalg.norm(along[:2]) < 1e-6
            across = np.cross(along, [0.0, 1.0, 0.0] if vertical else [0.0, 0.0, 1.0])
    else:
        along, across = joints_m[KNUCKLES].mean(axis=0) - joints_m[0], joints_m[17] - joints_m[5]
    along = along / max(float(np.linalg.norm(along)), 1e-9)
    across = across - (across @ along) * along
    across = across / max(float(np.linalg.norm(across)), 1e-9)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([across, along, np.cross(across, along)], axis=1)
    pose[:3, 3] = pinch(joints_m)[0]
    return pose


def side_of(joints_m: Float[np.ndarray, "j 3"]) -> Side:
    """Return the side of a human hand, from the direction in which its fingers flex."""
    axes = frame_of(joints_m, "human")[:3, :3]
    bend = (joints_m[[4, 8, 12, 16, 20]] - joints_m[[1, *KNUCKLES]]).mean(axis=0)
    return "right" if bend @ axes[:, 2] <= 0 else "left"


def closure_for(kind: Kind, width_m: float) -> float:
    """Return the closure at which the fingertips are `width_m` apart, by bisection."""
    # The fingertips of a human hand pass each other at 0.6, 11 mm apart. From [0, 0.8], bisection
    # for a larger width stays below 0.6.
    low, high = 0.0, 1.0 if kind == "robot" else 0.8
    for _ in range(30):
        middle = (low + high) / 2
        gap = pinch(joints_of(kind, middle, "right"))[1]
        low, high = (middle, high) if gap > width_m else (low, middle)
    return (low + high) / 2


def elbow_of(joints_m: Float[np.ndarray, "j 3"], side: Side) -> Float[np.ndarray, " 3"]:
    """Return the position of the wearer's elbow in meters, given the position of the wrist."""
    outward = 0.24 if side == "right" else -0.24
    return np.array([0.5 * joints_m[0][0] + outward, -0.20, 0.5 * joints_m[0][2]])


def arm_of(joints_m: Float[np.ndarray, "j 3"], kind: Kind, side: Side) -> tuple[Part, ...]:
    """Return the meshes of a hand and its forearm, which starts at the wearer's elbow."""
    up = frame_of(joints_m, kind)[:3, 2]
    return hand_meshes(joints_m, elbow_of(joints_m, side), kind, up if side == "right" else -up)


def hand_meshes(
    joints_m: Float[np.ndarray, "j 3"],
    elbow_m: Float[np.ndarray, " 3"],
    kind: Kind,
    back: Float[np.ndarray, " 3"],
) -> tuple[Part, ...]:
    """Return the meshes of hand and forearm, or of gripper and wrist, in the frame of the joints.

    `back` is the unit vector out of the back of the hand.
    """
    if kind == "robot":
        wrist, left, right = joints_m
        across = right - left
        across = across / max(np.linalg.norm(across), 1e-9)
        along = (left + right) / 2 - wrist
        along = along / np.linalg.norm(along)
        knuckle = wrist + PALM_M * along
        fingers = [
            _limb(knuckle + across * ((tip - knuckle) @ across), tip, 0.012, 0.010)
            for tip in (left, right)
        ]
        palm = _limb(knuckle - 0.055 * across, knuckle + 0.055 * across, 0.020, 0.020)
        arm = join(
            _limb(wrist - 0.02 * along, knuckle, 0.026, 0.026), _limb(wrist, elbow_m, 0.027, 0.034)
        )
        return (
            Part.plain("gripper", join(*fingers), RUBBER, smooth=True),
            Part.plain("wrist", join(palm, arm), ENAMEL, smooth=True),
        )
    radii = np.array([0.026, 0.016, 0.0125, 0.0115, 0.0095] + [0.0105, 0.0095, 0.0085, 0.0075] * 4)
    pieces = [
        _limb(joints_m[a], joints_m[b], float(radii[a]), float(radii[b]))
        for a, b in SKELETONS["human"].bones
        if a
    ]
    wrist, knuckles = joints_m[0], joints_m[KNUCKLES]
    # The palm: thick capsules from the wrist to each knuckle, and between neighbors.
    inward = -0.004 * back
    pieces += [_limb(wrist + inward, knuckle + inward, 0.021, 0.0135) for knuckle in knuckles]
    pieces += [_limb(a + inward, b + inward, 0.012, 0.012) for a, b in pairwise(knuckles)]
    pieces += [_limb(wrist + inward, joints_m[1], 0.021, 0.016)]
    pieces += [_limb(joints_m[1], knuckles[0] + inward, 0.014, 0.012)]
    towards = (elbow_m - wrist) / np.linalg.norm(elbow_m - wrist)
    cuff = wrist + 0.07 * towards
    pieces += [_limb(wrist, cuff, 0.023, 0.025)]
    return (
        Part.plain("hand", join(*pieces), SKIN, smooth=True),
        Part.plain("forearm", _limb(cuff, elbow_m, 0.029, 0.038), SLEEVE, smooth=True),
    )


def _limb(start: np.ndarray, end: np.ndarray, first: float, last: float) -> Mesh:
    """Return the mesh of a capsule between two points with a radius at each end."""
    ball, faces = _unit_ball()
    along = end - start
    length = np.linalg.norm(along)
    axis = along / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    helper = np.array([1.0, 0, 0]) if abs(axis[0]) < 0.9 else np.array([0, 1.0, 0])
    x = _cross(helper, axis)
    x = x / np.linalg.norm(x)
    aligned = ball @ np.stack([x, _cross(axis, x), axis])
    upper = ball[:, 2:] > 1e-6
    return np.where(upper, end + aligned * last, start + aligned * first), faces


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product, 10 times faster than np.cross on single vectors."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


@cache
def _unit_ball() -> Mesh:
    return make_mesh("sphere", 1.0, 8)
