"""Hand motion of a clip: reach, grasp, manipulate, release, retreat.

A hand moves through keyframes. Each has the position of the pinch point (between the grasping
fingertips), a yaw, a downward pitch and a closure. Between two keyframes the hand accelerates for a
quarter of the time and decelerates for a quarter. From grasp to release the body moves rigidly with
pinch point and yaw, so its ground-truth pose is exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from egosim_jax.geometry import rotation_z
from egosim_jax.rendering.mesh import Side
from egosim_jax.types import Kind
from egosim_jax.worlds.tabletop.bodies import Body, Part
from egosim_jax.worlds.tabletop.hands import closure_for, elbow_of, hand_meshes, joints_of, pinch
from egosim_jax.worlds.tabletop.scene import Scene, moving_part

Verb = Literal["carry", "lift", "turn", "stack", "open", "close"]
FLAT: tuple[str, ...] = ("box", "cylinder", "lidded box", "drawer")
"""Shapes that carry stacked bodies."""
REST_M = {"right": np.array([0.13, 0.12, 0.09]), "left": np.array([-0.13, 0.12, 0.09])}
"""Position of the pinch point of a resting hand by side, in meters."""
BEFORE_M = np.array([0.0, -0.09, 0.07])
"""Offset from a grasp to the hand in front of it, in meters."""
CARRY_M = (0.10, 0.20)
"""Minimum and maximum distance of a carry, in meters."""
CLOSE_SHARE = 0.04
"""Fraction of a clip in which a hand closes."""
NEAR_M = 0.26
"""Distance of preferred next targets from a hand, and of stacked bodies, in meters."""


@dataclass(frozen=True, kw_only=True)
class Grip:
    """Configuration of a hand at one moment."""

    point_m: Float[np.ndarray, " 3"]
    """Pinch point in meters."""
    yaw: float
    """Rotation about the vertical in radians; 0 points away from the wearer."""
    pitch: float
    """Downward pitch of the fingers in radians."""
    closure: float
    """Closure of the hand, from open (0) to closed (1)."""

    @property
    def rotation(self) -> Float[np.ndarray, "3 3"]:
        """World axes of the hand: y along the fingers, z out of its back."""
        cosine, sine = np.cos(self.pitch), np.sin(self.pitch)
        return rotation_z(self.yaw) @ np.array([[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]])

    def pose(self, kind: Kind, side: Side) -> tuple[np.ndarray, np.ndarray]:
        """Return the world joints in meters, and the unit vector out of the back of the hand."""
        rotation = self.rotation
        local = joints_of(kind, self.closure, side)
        return (local - pinch(local)[0]) @ rotation.T + self.point_m, rotation[:, 2]


@dataclass(frozen=True, kw_only=True)
class Hand:
    """One hand or gripper at one moment."""

    side: Side
    """Left or right."""
    grip: Grip
    """Configuration of the hand."""

    def with_closure(self, closure: float) -> Hand:
        """Return the hand with another closure."""
        return replace(self, grip=replace(self.grip, closure=closure))


@dataclass(frozen=True, kw_only=True)
class Intent:
    """Action of a clip and its target."""

    verb: Verb
    """Action of the hand."""
    name: str
    """Name of the grasped body."""
    goal_m: Float[np.ndarray, " 3"] | None = None
    """Final position of its origin in meters, for `carry` and `stack`."""
    turn: float = 0.0
    """Rotation about the vertical in radians, for `turn`."""
    caption: str = ""
    """Caption without its subject, such as "lifts the red box and puts it back."."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Scene and hands in one frame."""

    scene: Scene
    """All bodies and their poses."""
    hands: tuple[Hand, ...]
    """Hands; the first one acts."""


@dataclass(frozen=True, kw_only=True)
class _Key:
    time: float
    grip: Grip
    held: bool = False
    opening: float = 0.0


def smooth(time: float) -> float:
    """Ease from 0 to 1: accelerate for a quarter, keep the speed, decelerate for a quarter."""
    # The maximum speed is 4/3 of the mean; a minimum-jerk curve has 15/8. A video VAE with a
    # temporal stride of four blurs fast motion.
    s = min(max(time, 0.0), 1.0)
    if s < 0.25:
        return 8 / 3 * s * s
    return 4 / 3 * s - 1 / 6 if s < 0.75 else 1 - 8 / 3 * (1 - s) ** 2


def choose(scene: Scene, rng: np.random.Generator, *, hand: Hand | None = None) -> Intent:
    """Sample an action that the scene allows, preferably with a target near the hand."""
    options: list[Intent] = []
    for body in scene.bodies:
        if body.static or (_covered(scene, body) and body.shape != "drawer"):
            continue
        if body.articulated:
            options += [open_or_close(scene, body)] * 2
        else:
            options += _loose_actions(scene, body, rng)
    if hand is not None:
        start = hand.grip.point_m[:2]
        gaps = [np.linalg.norm(scene.body(o.name).world_from_body[:2, 3] - start) for o in options]
        near = [o for o, gap in zip(options, gaps, strict=True) if gap < NEAR_M]
        options = near or options
    return options[int(rng.integers(len(options)))]


def open_or_close(scene: Scene, body: Body) -> Intent:
    """Return the intent to open furniture, or to close it if it is open."""
    verb: Verb = "close" if scene.openings[body.name] > 0.5 else "open"
    part = "drawer of the" if body.shape == "drawer" else "lid of the"
    return Intent(verb=verb, name=body.name, caption=f"{verb}s the {part} {body.name}.")


def lift(body: Body) -> Intent:
    """Return the intent to lift a body and put it back."""
    return Intent(verb="lift", name=body.name, caption=f"lifts the {body.name} and puts it back.")


def carry(body: Body, place_m: Float[np.ndarray, " 2"]) -> Intent:
    """Return the intent to carry a body to a place on the table."""
    words = direction(np.asarray(place_m) - body.world_from_body[:2, 3])
    return Intent(
        verb="carry",
        name=body.name,
        goal_m=np.array([*place_m, 0.0]),
        caption=f"picks up the {body.name} and puts it down {words}.",
    )


def direction(way_m: Float[np.ndarray, " d"]) -> str:
    """Return the words for a horizontal motion, such as "to the left"."""
    if abs(way_m[0]) > abs(way_m[1]):
        return "to the right" if way_m[0] > 0 else "to the left"
    return "to the back" if way_m[1] > 0 else "to the front"


def _loose_actions(scene: Scene, body: Body, rng: np.random.Generator) -> list[Intent]:
    """Return the possible actions on a loose body; a repeated one is twice as likely."""
    name = body.name
    options = [lift(body)]
    angle = float(rng.choice([-1, 1]) * rng.uniform(np.radians(50), np.radians(80)))
    if body.shape == "box":
        way = "left" if angle > 0 else "right"
        caption = f"turns the {name} to the {way}."
        options.append(Intent(verb="turn", name=name, turn=angle, caption=caption))
    place = scene.free_place(body, rng, away_m=CARRY_M)
    if place is not None:
        options += [carry(body, place)] * 2
    below = [
        other
        for other in scene.bodies
        if other.shape in FLAT
        and other.name != name
        and not _covered(scene, other)
        and scene.openings.get(other.name, 0) < 0.5
        and other.world_from_body[2, 3] < 0.01
        and np.linalg.norm((other.world_from_body - body.world_from_body)[:2, 3]) < NEAR_M
    ]
    if below and body.world_from_body[2, 3] < 0.01:
        other = below[int(rng.integers(len(below)))]
        goal = other.world_from_body[:3, 3] + [0, 0, other.size_m[2]]
        caption = f"puts the {name} on the {other.name}."
        options += [Intent(verb="stack", name=name, goal_m=goal, caption=caption)] * 2
    return options


def _covered(scene: Scene, body: Body) -> bool:
    """Return whether another body is on top of a body."""
    x, y, z = body.world_from_body[:3, 3]
    return any(
        other.world_from_body[2, 3] > z + 0.01
        and np.hypot(*(other.world_from_body[:2, 3] - [x, y])) < max(body.size_m[:2])
        for other in scene.bodies
        if other.name != body.name
    )


def start_hand(scene: Scene, intent: Intent, kind: Kind, rng: np.random.Generator) -> Hand:
    """Return the acting hand at the start of the first clip, in front of its target."""
    grasp = grip_on(scene, intent, kind, "right")
    side: Side = "right" if grasp.point_m[0] + rng.normal(0, 0.04) > 0 else "left"
    before = grasp.point_m + BEFORE_M + rng.normal(0, 0.015, 3)
    share = rng.uniform(0.0, 0.3)
    point = before + share * (REST_M[side] - before)
    return Hand(side=side, grip=relaxed(point, side, kind))


def waiting_hand(other: Side, rng: np.random.Generator) -> Hand:
    """Return the resting hand of the other side."""
    side: Side = "left" if other == "right" else "right"
    point = REST_M[side] + rng.normal(0, 0.012, 3) + [0.06 if side == "right" else -0.06, 0, -0.03]
    return Hand(side=side, grip=relaxed(point, side, "human"))


def relaxed(point: np.ndarray, side: Side, kind: Kind) -> Grip:
    """Return the configuration of a relaxed hand at a point."""
    inward = 0.5 if side == "right" else -0.5
    closure = 0.25 if kind == "human" else 0.0
    return Grip(point_m=point, yaw=inward, pitch=np.radians(30), closure=closure)


def grip_on(scene: Scene, intent: Intent, kind: Kind, side: Side) -> Grip:
    """Return the configuration of the hand that grasps the target."""
    body = scene.body(intent.name)
    inward, closure = 0.5 if side == "right" else -0.5, closure_for(kind, body.grip_m)
    if body.articulated:
        _, y, z = body.size_m
        handle = (
            [0, -y / 2 - 0.016, z / 2] if body.shape == "drawer" else [0, -y / 2 - 0.007, z - 0.006]
        )
        local = moving_part(body, scene.openings[body.name]) @ [*handle, 1.0]
        point = (body.world_from_body @ local)[:3]
        return Grip(point_m=point, yaw=0.0, pitch=np.radians(40), closure=closure)
    height, offset = (0.45 if body.shape == "cone" else 0.62) * body.size_m[2], np.zeros(3)
    if body.shape == "ring":  # the hand grasps its near rim
        offset = np.array([0, -(body.size_m[0] - body.size_m[2]) / 2, 0])
    point = body.world_from_body[:3, 3] + offset + [0, 0, height]
    return Grip(point_m=point, yaw=inward, pitch=np.radians(52), closure=closure)


def act(
    scene: Scene,
    hands: tuple[Hand, ...],
    intent: Intent,
    kind: Kind,
    *,
    frames: int,
    rises: bool = False,
) -> list[Moment]:
    """Return scene and hands at every frame of a clip; the first hand acts, the others rest.

    The first moment has the scene and hands of the arguments. The next clip starts from the last
    moment. A hand that `rises` comes down on its target from above, wherever it starts; it would
    push a tall body if it came from the side.
    """
    hand = hands[0]
    keys = _keys(scene, hand, intent, kind, rises=rises)
    grasp = next(key.grip for key in keys if key.held)
    moments = []
    for time in np.linspace(0, 1, frames):
        grip, held_grip, opening = _between(keys, float(time))
        now = scene
        if held_grip is not None:
            body = scene.body(intent.name)
            if body.articulated:
                now = scene.with_opening(intent.name, opening)
            else:
                now = scene.with_pose(intent.name, _carry(body.world_from_body, grasp, held_grip))
        acting = Hand(side=hand.side, grip=grip)
        moments.append(Moment(scene=now, hands=(acting, *hands[1:])))
    return moments


def _carry(world_from_body: np.ndarray, grasp: Grip, grip: Grip) -> np.ndarray:
    """Return the pose of a body, grasped at `grasp`, with the hand at `grip`."""
    turn = rotation_z(grip.yaw - grasp.yaw)
    pose = np.eye(4)
    pose[:3, :3] = turn @ world_from_body[:3, :3]
    pose[:3, 3] = turn @ (world_from_body[:3, 3] - grasp.point_m) + grip.point_m
    return pose


def holding(scene: Scene, hand: Hand, intent: Intent, kind: Kind) -> tuple[float, float]:
    """Return the times in [0, 1] at which the hand grasps its target and releases it."""
    held = [key.time for key in _keys(scene, hand, intent, kind) if key.held]
    return held[0], held[-1]


def opened(kind: Kind) -> float:
    """Return the closure of a reaching hand."""
    return closure_for(kind, 0.085) if kind == "robot" else 0.12


def _keys(
    scene: Scene, hand: Hand, intent: Intent, kind: Kind, *, rises: bool = False
) -> list[_Key]:
    """Return the keyframes of the acting hand."""
    start, grasp = hand.grip, grip_on(scene, intent, kind, hand.side)
    body, wide = scene.body(intent.name), opened(kind)
    above = replace(_shift(grasp, [0, -0.02, 0.03]), closure=wide)
    # A farther target takes longer to reach, so that no reach is much faster than others.
    reach_m, rise_m = float(np.linalg.norm(start.point_m - grasp.point_m)), 0.0
    ready = relaxed(grasp.point_m + BEFORE_M, hand.side, kind)
    if rises and start.point_m[2] < ready.point_m[2]:
        rise_m = float(np.linalg.norm(start.point_m - ready.point_m))
        reach_m = rise_m + float(np.linalg.norm(BEFORE_M))
    reach = 0.10 + 0.6 * min(0.4, reach_m)
    begin, end = reach + 0.10, 0.76
    first = scene.openings.get(intent.name, 0.0)
    keys = [
        _Key(time=0.0, grip=start, opening=first),
        *([_Key(time=reach * rise_m / reach_m, grip=ready, opening=first)] if rise_m else []),
        _Key(time=reach, grip=above, opening=first),
        _Key(time=begin - CLOSE_SHARE, grip=replace(grasp, closure=wide), opening=first),
        _Key(time=begin, grip=grasp, held=True, opening=first),
    ]
    if body.articulated:
        last = 1.0 - first
        for share in (0.25, 0.5, 0.75, 1.0):
            opening = first + smooth(share) * (last - first)
            moved = grip_on(scene.with_opening(intent.name, opening), intent, kind, hand.side)
            time = begin + share * (end - begin)
            keys.append(_Key(time=time, grip=moved, held=True, opening=opening))
        final = keys[-1].grip
    elif intent.verb == "lift":
        final = grasp
        for share, height in ((0.35, 0.07), (0.5, 0.075), (0.65, 0.07), (1.0, 0.0)):
            time = begin + share * (end - begin)
            keys.append(_Key(time=time, grip=_shift(grasp, [0, 0, height]), held=True))
    elif intent.verb == "turn":
        final = replace(grasp, yaw=grasp.yaw + intent.turn)
        keys.append(_Key(time=end, grip=final, held=True))
    else:
        way = intent.goal_m - body.world_from_body[:3, 3]
        final = _shift(grasp, way)
        clear = 0.03 + 0.15 * float(np.linalg.norm(way[:2])) + max(0.0, way[2])
        rise, sink = [*(0.2 * way[:2]), clear * 0.8], [*(0.8 * way[:2]), clear]
        keys += [
            _Key(time=begin + 0.3 * (end - begin), grip=_shift(grasp, rise), held=True),
            _Key(time=begin + 0.72 * (end - begin), grip=_shift(grasp, sink), held=True),
            _Key(time=end, grip=final, held=True),
        ]
    last_opening = keys[-1].opening
    away = replace(_shift(final, [0, -0.015, 0.02]), closure=wide)
    rest = relaxed(_retreat(final.point_m, hand.side), hand.side, kind)
    keys += [
        _Key(time=end + 0.05, grip=away, opening=last_opening),
        _Key(time=1.0, grip=rest, opening=last_opening),
    ]
    return keys


def _retreat(point_m: np.ndarray, side: Side) -> np.ndarray:
    """Return a point above and towards rest, where the hand does not occlude the target."""
    up = point_m + [0, -0.06, 0.05]
    return up + 0.3 * (REST_M[side] - up)


def _shift(grip: Grip, way_m: ArrayLike) -> Grip:
    return replace(grip, point_m=grip.point_m + np.asarray(way_m, float))


def _between(keys: list[_Key], time: float) -> tuple[Grip, Grip | None, float]:
    """Interpolate keyframes: return the grip, the grip that carries the body, and the opening."""
    held = [key for key in keys if key.held]
    begin, end = held[0].time, held[-1].time
    if begin < time < end:  # one motion from grasp to release: no stop at the keyframes between
        time = begin + smooth((time - begin) / (end - begin)) * (end - begin)
    index = max(i for i, key in enumerate(keys) if key.time <= time + 1e-9)
    if index == len(keys) - 1:
        grip, opening = keys[-1].grip, keys[-1].opening
    else:
        before, after = keys[index], keys[index + 1]
        share = (time - before.time) / (after.time - before.time)
        s = share if before.held and after.held else smooth(share)
        a, b = vars(before.grip), vars(after.grip)
        grip = Grip(**{name: a[name] + s * (b[name] - a[name]) for name in a})
        opening = before.opening + s * (after.opening - before.opening)
    if time < begin:
        return grip, None, opening
    return grip, grip if time <= end else held[-1].grip, opening


def hand_parts(hand: Hand, kind: Kind) -> tuple[Float[np.ndarray, "j 3"], tuple[Part, ...]]:
    """Return the world joints and meshes of a hand; the forearm starts at the wearer's elbow."""
    joints, back = hand.grip.pose(kind, hand.side)
    return joints, hand_meshes(joints, elbow_of(joints, hand.side), kind, back)
