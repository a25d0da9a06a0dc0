"""Contact of hands with bodies: grasp, carry, release and push.

Hands are kinematic: they are where the action puts them, and bodies yield. Between two frames the
joints move in straight lines, in steps of a few millimeters.

- A closing hand grasps the body that is between its fingertips when both touch it. A loose body
  then moves rigidly with the hand; furniture opens and closes as its handle follows the fingertips.
- A hand that opens by `OPEN_M` releases it, and it comes to rest (`support.settle`).
- A joint that enters a body from the side pushes it, a joint that enters from above does not. A
  pushed body translates and turns as by friction under its footprint, the limit surface being an
  ellipsoid: a force f at r from its center gives the velocity v = f, w = (r x f) / c^2 (Goyal,
  Ruina and Papadopoulos 1991, with c the radius of gyration of the pressure).
- A body that two hands hold moves with the first one until that one releases it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.geometry import invert, rotation_z, transform
from egosim_jax.types import Kind
from egosim_jax.worlds.tabletop.bodies import Body
from egosim_jax.worlds.tabletop.hands import frame_of, pinch
from egosim_jax.worlds.tabletop.scene import DRAWER_M, LID_DEGREES, Scene, moving_part
from egosim_jax.worlds.tabletop.solids import surface_of
from egosim_jax.worlds.tabletop.support import (
    RANKS,
    min_opening,
    move,
    moves,
    push_aside,
    riders,
    settle,
    support_below,
)

PAD_M = 0.012
"""Fingertips touch a surface within this distance: the radius of a finger, and its compliance."""
FIRM_M = 0.0005
"""A closing hand holds a body when both fingertips are this near, or touch it and get no nearer."""
BETWEEN_M = (0.001, 0.003)
"""A body is between fingertips if their middle is so deep in it, or so much deeper than they."""
OPEN_M = 0.002
"""A hand releases what it holds when its fingertips are this much wider than at their closest."""
SLIP_M = 0.03
"""Fingertips farther than this from the handle they hold slip off it, in meters."""
LEAVE_M = (0.003, 0.010)
"""A joint that pressed a body has left it when it and the pinch point are this far, in meters."""
STEP_M = 0.004
"""Longest motion of a joint in one step, in meters."""
MAX_STEPS = 64
"""Most steps between two frames."""
FINGERS = [j for j in range(2, 21) if j % 4 != 1]
"""Keypoints of a human hand's fingers, which yield to what fits into the open hand."""
STEEP = 0.7
"""Vertical component of a surface's normal above which a joint presses instead of pushing."""
GYRATION = 0.6
"""Radius c of the limit surface, as a fraction of half of a body's width."""


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """A body in a hand."""

    hand: int
    """Index of the hand."""
    name: str
    """Name of the body."""
    part_from_hand: Float[np.ndarray, "4 4"]
    """Pose of the hand in the frame of the body, or of its moving part."""
    gap_m: float
    """Smallest distance of the fingertips since the grasp, in meters."""


@dataclass(frozen=True, kw_only=True)
class Contact:
    """Scene, grasps and pressing joints at one moment."""

    scene: Scene
    """Arrangement of all bodies."""
    grasps: tuple[Grasp, ...] = ()
    """Bodies in hands; of two hands on one body the first one moves it."""
    pressing: frozenset[tuple[int, int, str]] = field(default_factory=frozenset)
    """Hand, joint and body of joints inside bodies that they do not push."""
    closing: frozenset[int] = field(default_factory=frozenset)
    """Hands that closed in the last step."""
    released: frozenset[tuple[int, str]] = field(default_factory=frozenset)
    """Hand and name of bodies that a hand released and has not left yet."""

    def holder(self, name: str) -> Grasp | None:
        """Return the grasp that moves a body."""
        return next((grasp for grasp in self.grasps if grasp.name == name), None)


def start(contact: Contact, joints_m: Float[np.ndarray, "n j 3"]) -> Contact:
    """Return the contact at the first frame of an action: hands may be in bodies or have jumped."""
    kept = [
        grasp
        for grasp in contact.grasps
        if grasp.hand < len(joints_m)
        and np.isfinite(joints_m[grasp.hand]).all()
        and np.linalg.norm(_expected_pinch(contact.scene, grasp) - pinch(joints_m[grasp.hand])[0])
        <= SLIP_M
    ]
    contact = _let_go(contact, [grasp for grasp in contact.grasps if grasp not in kept])
    there = frozenset(pair for pair in contact.released if pair[0] < len(joints_m))
    contact = replace(contact, released=there)
    return _appear(contact, joints_m, _present(joints_m))


def _present(joints_m: Float[np.ndarray, "n j 3"]) -> Bool[np.ndarray, " n"]:
    """Return which hands have all their joints."""
    return np.asarray(np.isfinite(joints_m).all(axis=(1, 2)))


def _appear(
    contact: Contact, joints_m: Float[np.ndarray, "n j 3"], hands: Bool[np.ndarray, " n"]
) -> Contact:
    """Return the contact after some hands appeared: those inside bodies do not push them."""
    inside = {
        (int(hand), int(joint), body.name)
        for hand in np.flatnonzero(hands)
        for body in contact.scene.bodies
        for joint in np.flatnonzero(surface_of(contact.scene, body, joints_m[hand])[0] < 0)
    }
    return replace(contact, pressing=contact.pressing | inside)


def advance(
    contact: Contact,
    before_m: Float[np.ndarray, "n j 3"],
    after_m: Float[np.ndarray, "n j 3"],
    kind: Kind,
) -> Contact:
    """Return the contact after all hands moved in straight lines; a missing hand holds nothing."""
    there, here = _present(before_m), _present(after_m)
    seen = there & here
    contact = _let_go(contact, [grasp for grasp in contact.grasps if not seen[grasp.hand]])
    gone = set(np.flatnonzero(~seen).tolist())
    contact = replace(
        contact,
        pressing=frozenset(key for key in contact.pressing if key[0] not in gone),
        closing=contact.closing - gone,
        released=frozenset(pair for pair in contact.released if pair[0] not in gone),
    )
    if (here & ~there).any():
        contact = _appear(contact, after_m, here & ~there)
    if not seen.any():
        return contact
    length = np.linalg.norm(after_m[seen] - before_m[seen], axis=-1).max()
    steps = int(np.clip(np.ceil(length / STEP_M), 1, MAX_STEPS))
    path = before_m + np.linspace(0, 1, steps + 1)[:, None, None, None] * (after_m - before_m)
    for last, here in pairwise(path):
        contact = _step(contact, last, here, np.flatnonzero(seen), kind)
    return contact


def _step(
    contact: Contact, last_m: np.ndarray, here_m: np.ndarray, hands: np.ndarray, kind: Kind
) -> Contact:
    opened = []
    for grasp in contact.grasps:
        gap = pinch(here_m[grasp.hand])[1]
        slipped = np.linalg.norm(
            _expected_pinch(contact.scene, grasp) - pinch(last_m[grasp.hand])[0]
        )
        if gap > grasp.gap_m + OPEN_M or slipped > SLIP_M:
            opened.append(grasp)
    contact = _let_go(contact, opened, here_m)
    ranks: dict[str, int] = {}
    contact = _follow(contact, here_m, kind, ranks)
    for hand in hands:
        contact = _grasp(contact, int(hand), last_m[hand], here_m[hand], kind)
    released = {
        (hand, name)
        for hand, name in contact.released
        if _contact(contact.scene, contact.scene.body(name), here_m[hand])[1] <= LEAVE_M[1]
    }
    contact = replace(contact, released=frozenset(released))
    for hand in hands:
        contact = _push(contact, int(hand), here_m[hand], kind, ranks)
    if ranks:
        contact = _yield(contact, here_m, kind, ranks)
    return contact


def _expected_pinch(scene: Scene, grasp: Grasp) -> Float[np.ndarray, " 3"]:
    """Return where the fingertips hold a body, in the world."""
    return (scene.first_part_pose(grasp.name) @ grasp.part_from_hand)[:3, 3]


def _let_go(contact: Contact, grasps: list[Grasp], joints_m: np.ndarray | None = None) -> Contact:
    """Release bodies; they come to rest unless another hand holds them."""
    if not grasps:
        return contact
    kept = tuple(grasp for grasp in contact.grasps if grasp not in grasps)
    scene, pressing = contact.scene, set(contact.pressing)
    for grasp in grasps:
        body = scene.body(grasp.name)
        if joints_m is not None:
            pressing |= {(grasp.hand, joint, body.name) for joint in range(joints_m.shape[1])}
        if any(other.name == grasp.name for other in kept):
            continue
        scene = settle(scene, body.name) if moves(body) else _rest(scene, body)
    left = contact.released | {(grasp.hand, grasp.name) for grasp in grasps}
    return replace(contact, scene=scene, grasps=kept, pressing=frozenset(pressing), released=left)


def _rest(scene: Scene, body: Body) -> Scene:
    """Return the scene in which gravity moved a lid: shut, or open beyond the vertical."""
    if body.shape != "lidded box":
        return scene
    beyond = scene.openings[body.name] * LID_DEGREES >= 90
    return scene.with_opening(body.name, 1.0 if beyond else min_opening(scene, body))


def _follow(
    contact: Contact,
    here_m: np.ndarray,
    kind: Kind,
    ranks: dict[str, int],
) -> Contact:
    """Move every held body with its hand, as far as its support and its hinge allow."""
    scene, grasps = contact.scene, []
    for grasp in contact.grasps:
        world_from_hand = frame_of(here_m[grasp.hand], kind)
        body = scene.body(grasp.name)
        if contact.holder(grasp.name) is grasp:  # the first of two
            if moves(body):
                pose = world_from_hand @ invert(grasp.part_from_hand)
                scene = move(scene, body.name, pose)
                lifted = _lift_out(scene, body.name)
                if lifted is not scene:  # it slips in the hand
                    scene = lifted
                    inverse = invert(scene.body(body.name).world_from_body)
                    grasp = replace(grasp, part_from_hand=inverse @ world_from_hand)
                ranks[body.name] = RANKS["held"]
            elif body.shape == "drawer" or not riders(scene, body.name):
                opening = _opening_at(scene, body, grasp, world_from_hand[:3, 3])
                scene = scene.with_opening(body.name, opening)
                ranks[body.name] = RANKS["furniture"]
        gap = min(grasp.gap_m, pinch(here_m[grasp.hand])[1])
        grasps.append(replace(grasp, gap_m=gap))
    return replace(contact, scene=scene, grasps=tuple(grasps))


def _lift_out(scene: Scene, name: str) -> Scene:
    """Return the scene in which a held body was lifted out of what is below its center."""
    body = scene.body(name)
    low = float(transform(body.world_from_body, body.parts[0].vertices_m)[:, 2].min())
    height, _ = support_below(scene, body)
    if low >= height:
        return scene
    pose = body.world_from_body.copy()
    pose[2, 3] += height - low
    return scene.with_pose(name, pose)


def _opening_at(scene: Scene, body: Body, grasp: Grasp, point_m: Float[np.ndarray, " 3"]) -> float:
    """Return the opening at which the held point of the moving part is nearest to a point."""
    held = grasp.part_from_hand[:3, 3]
    point = transform(invert(body.world_from_body), point_m[None])[0]
    if body.shape == "drawer":
        return float(np.clip((held[1] - point[1]) / DRAWER_M, 0, 1))
    hinge = np.array([body.size_m[1] / 2, body.size_m[2] - 0.012])
    angles = [np.arctan2(way[2] - hinge[1], hinge[0] - way[1]) for way in (held, point)]
    opening = np.degrees(angles[1] - angles[0]) / LID_DEGREES
    return float(np.clip(opening, min_opening(scene, body), 1))


def _grasp(
    contact: Contact, hand: int, last_m: np.ndarray, here_m: np.ndarray, kind: Kind
) -> Contact:
    """Grasp the body that is between the fingertips of a closing hand, if both touch it."""
    gap = pinch(here_m)[1]
    closing, closed = gap < pinch(last_m)[1] - 1e-7, hand in contact.closing
    others = contact.closing - {hand}
    contact = replace(contact, closing=others | {hand} if closing else others)
    if not (closing or closed) or any(grasp.hand == hand for grasp in contact.grasps):
        return contact
    deepest, chosen = -BETWEEN_M[0], None
    for body in contact.scene.bodies:
        before, deep = _contact(contact.scene, body, last_m)
        here, depth = _contact(contact.scene, body, here_m)
        firm = here <= FIRM_M or (before <= PAD_M and here >= before)
        firm &= (hand, body.name) not in contact.released or depth <= deep  # not if it leaves
        if firm and min(deep, depth) < deepest:
            deepest, chosen = min(deep, depth), body.name
    if chosen is None:
        return contact
    pose = invert(contact.scene.first_part_pose(chosen)) @ frame_of(here_m, kind)
    grasp = Grasp(hand=hand, name=chosen, part_from_hand=pose, gap_m=gap)
    return replace(contact, grasps=(*contact.grasps, grasp))


def _contact(scene: Scene, body: Body, joints_m: Float[np.ndarray, "j 3"]) -> tuple[float, float]:
    """Return the distance of the farther fingertip from a body, and that of the pinch point."""
    points = np.stack([*tips_of(joints_m), pinch(joints_m)[0]])
    distance, *_ = surface_of(scene, body, points, handle=True)
    return float(distance[:2].max()), float(distance[2])


def tips_of(joints_m: Float[np.ndarray, "j 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the tip of the thumb and the middle of those of index and middle finger."""
    if len(joints_m) == 3:
        return joints_m[1], joints_m[2]
    return joints_m[4], (joints_m[8] + joints_m[12]) / 2


def _push(
    contact: Contact,
    hand: int,
    joints_m: np.ndarray,
    kind: Kind,
    ranks: dict[str, int],
) -> Contact:
    """Move bodies out of the joints that enter them from the side."""
    middle, gap = pinch(joints_m)
    scene, pressing = contact.scene, set(contact.pressing)
    for body in scene.bodies:
        gaps = np.linalg.norm(joints_m - body.world_from_body[:3, 3], axis=1)
        if gaps.min() > np.linalg.norm(body.size_m) + DRAWER_M * body.articulated:
            pressing = {key for key in pressing if key[0] != hand or key[2] != body.name}
            continue
        distance, normal, moving = surface_of(scene, body, joints_m)
        *tips, depth = surface_of(scene, body, np.stack([*tips_of(joints_m), middle]))[0]
        for joint in np.flatnonzero(distance > LEAVE_M[0]) if depth > LEAVE_M[1] else ():
            pressing.discard((hand, int(joint), body.name))
        between = depth < min(tips) - BETWEEN_M[1] or contact.holder(body.name) is not None
        supple = FINGERS if kind == "human" and gap > body.size_m[0] else ()
        for joint in np.flatnonzero(distance < 0):
            key = (hand, int(joint), body.name)
            if key in pressing:
                continue
            steep = abs(normal[joint, 2]) > STEEP
            if between or steep or joint in supple or not moving[joint]:
                pressing.add(key)
                continue
            scene = _yield_to(scene, body.name, joints_m[joint])
            ranks[body.name] = RANKS["pushed"]
    return replace(contact, scene=scene, pressing=frozenset(pressing))


def _yield_to(scene: Scene, name: str, point_m: Float[np.ndarray, " 3"]) -> Scene:
    """Return the scene in which a body or its moving part moved out of a point."""
    body = scene.body(name)
    (distance,), (normal,), _ = surface_of(scene, body, point_m[None])
    if distance >= 0:
        return scene
    if not moves(body):
        step = 1e-3
        local = invert(scene.first_part_pose(name)) @ [*point_m, 1.0]
        ahead = moving_part(body, scene.openings[name] + step) @ local
        speed = float(normal @ ((body.world_from_body @ ahead)[:3] - point_m)) / step
        if abs(speed) < 1e-3:
            return scene
        opening = scene.openings[name] + distance / speed
        return scene.with_opening(name, float(np.clip(opening, min_opening(scene, body), 1)))
    force = -normal * [1, 1, 0] / max(float(np.linalg.norm(normal[:2])), 1e-9)
    depth = -distance / max(float(np.linalg.norm(normal[:2])), 1e-9)
    center = body.world_from_body[:3, 3]
    lever = point_m - center
    torque = float(lever[0] * force[1] - lever[1] * force[0])
    square = (GYRATION * body.size_m[0] / 2) ** 2
    amount = depth / (1 + torque**2 / square)
    motion = np.eye(4)
    motion[:3, :3] = rotation_z(amount * torque / square)
    motion[:3, 3] = center + amount * force - motion[:3, :3] @ center
    return move(scene, name, motion @ body.world_from_body)


def _yield(
    contact: Contact,
    here_m: np.ndarray,
    kind: Kind,
    ranks: dict[str, int],
) -> Contact:
    """Separate bodies that met, let fall what lost its support, and let held bodies slip."""
    scene, moved = push_aside(contact.scene, ranks)
    held = {grasp.name for grasp in contact.grasps}
    for name in resting_order(scene, (moved | set(ranks)) - held):
        if moves(scene.body(name)) and name not in held:
            scene = settle(scene, name)
    slipped = moved & held
    grasps = tuple(
        replace(
            grasp,
            part_from_hand=invert(scene.first_part_pose(grasp.name))
            @ frame_of(here_m[grasp.hand], kind),
        )
        if grasp.name in slipped or contact.holder(grasp.name) is not grasp
        else grasp
        for grasp in contact.grasps
    )
    return replace(contact, scene=scene, grasps=grasps)


def resting_order(scene: Scene, names: set[str]) -> list[str]:
    """Return names from the lowest body to the highest."""
    return sorted(names, key=lambda name: (scene.body(name).world_from_body[2, 3], name))
