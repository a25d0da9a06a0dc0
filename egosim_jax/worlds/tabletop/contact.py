"""Contact of hands with bodies: grasp, carry, release and push.

Hands are kinematic: they follow the action, and bodies yield. Between two frames the joints move
in straight lines, in steps of a few millimeters.

- A closing hand grasps the body between its fingertips when both touch it. A loose body then moves
  rigidly with the hand; the handle of furniture follows the fingertips.
- A hand that opens by `OPEN_M` releases its body, which settles (`support.settle`).
- Joints and long bones have flesh. Where it enters a body from the side it pushes it out
  (`pushes`); from above it presses, and moves nothing. A hand pushes no body that it reaches
  around, and none that it has just released, until it has left it.
- A body in two hands moves with the first hand until that hand releases it.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.geometry import invert, transform
from egosim_jax.types import Kind
from egosim_jax.worlds.tabletop.bodies import LID_M, Body
from egosim_jax.worlds.tabletop.hands import FLESH_M, frame_of, opening_of, pinch, tips_of, touching
from egosim_jax.worlds.tabletop.pushes import push_out, yields
from egosim_jax.worlds.tabletop.scene import DRAWER_M, LID_DEGREES, Scene
from egosim_jax.worlds.tabletop.solids import bodies_near, surface_of
from egosim_jax.worlds.tabletop.support import (
    RANKS,
    min_opening,
    move,
    push_aside,
    riders,
    settle,
    support_below,
)

PAD_M = 0.012
"""Maximum distance of a touching fingertip in meters: a finger's radius and compliance."""
FIRM_M = 0.0005
"""Distance in meters at which fingertips hold a body, even while they still approach it."""
BETWEEN_M = 0.001
"""Minimum depth of the pinch point in a grasped body, in meters."""
OPEN_M = 0.002
"""Opening of the fingertips, from their closest, that releases a body, in meters."""
SLIP_M = 0.03
"""Distance from the held point at which fingertips slip off, in meters."""
LEAVE_M = (0.003, 0.010)
"""Distances of flesh and of the pinch point that end a press, in meters."""
STEP_M = 0.004
"""Maximum motion of a joint in one step, in meters."""
MAX_STEPS = 64
"""Maximum number of steps between two frames."""


@dataclass(frozen=True, kw_only=True)
class Grasp:
    """A body in a hand."""

    hand: int
    """Index of the hand."""
    name: str
    """Name of the body."""
    part_from_hand: Float[np.ndarray, "4 4"]
    """Pose of the hand in the frame of the body or its moving part."""
    gap_m: float
    """Minimum distance of the fingertips since the grasp, in meters."""


@dataclass(frozen=True, kw_only=True)
class Contact:
    """Scene, grasps and pressing joints at one moment."""

    scene: Scene
    """All bodies and their poses."""
    grasps: tuple[Grasp, ...] = ()
    """Bodies in hands; the first of two grasps of one body moves it."""
    pressing: frozenset[tuple[int, int, str]] = field(default_factory=frozenset)
    """Hand, touching point and body name of flesh inside a body that it does not push."""
    closing: frozenset[int] = field(default_factory=frozenset)
    """Hands that closed in the last step."""
    released: frozenset[tuple[int, str]] = field(default_factory=frozenset)
    """Hand and name of each released body that the hand has not left yet."""

    def holder(self, name: str) -> Grasp | None:
        """Return the grasp that moves a body."""
        return next((grasp for grasp in self.grasps if grasp.name == name), None)


def start(contact: Contact, joints_m: Float[np.ndarray, "n j 3"], kind: Kind) -> Contact:
    """Return the contact at the first frame of an action, where hands may have jumped."""
    kept = [
        grasp
        for grasp in contact.grasps
        if grasp.hand < len(joints_m)
        and np.isfinite(joints_m[grasp.hand]).all()
        and _slip_m(contact.scene, grasp, joints_m[grasp.hand]) <= SLIP_M
    ]
    contact = _release(contact, [grasp for grasp in contact.grasps if grasp not in kept])
    released = frozenset(pair for pair in contact.released if pair[0] < len(joints_m))
    contact = replace(contact, released=released)
    return _appear(contact, joints_m, _present(joints_m), kind)


def _present(joints_m: Float[np.ndarray, "n j 3"]) -> Bool[np.ndarray, " n"]:
    """Return which hands have all their joints."""
    return np.asarray(np.isfinite(joints_m).all(axis=(1, 2)))


def _appear(
    contact: Contact,
    joints_m: Float[np.ndarray, "n j 3"],
    hands: Bool[np.ndarray, " n"],
    kind: Kind,
) -> Contact:
    """Return the contact after hands appeared: flesh inside bodies presses and does not push."""
    inside = set()
    for hand in np.flatnonzero(hands).tolist():
        points, flesh = touching(joints_m[hand], kind), FLESH_M[kind]
        for body in bodies_near(contact.scene, points, flesh):
            touches = surface_of(contact.scene, body, points)[0] < flesh
            inside |= {(hand, int(point), body.name) for point in np.flatnonzero(touches)}
    return replace(contact, pressing=contact.pressing | inside)


def advance(
    contact: Contact,
    before_m: Float[np.ndarray, "n j 3"],
    after_m: Float[np.ndarray, "n j 3"],
    kind: Kind,
) -> Contact:
    """Return the contact after all hands moved in straight lines; a missing hand holds nothing."""
    before, after = _present(before_m), _present(after_m)
    present = before & after
    contact = _release(contact, [grasp for grasp in contact.grasps if not present[grasp.hand]])
    gone = set(np.flatnonzero(~present).tolist())
    contact = replace(
        contact,
        pressing=frozenset(key for key in contact.pressing if key[0] not in gone),
        closing=contact.closing - gone,
        released=frozenset(pair for pair in contact.released if pair[0] not in gone),
    )
    if (after & ~before).any():
        contact = _appear(contact, after_m, after & ~before, kind)
    if not present.any():
        return contact
    length = np.linalg.norm(after_m[present] - before_m[present], axis=-1).max()
    steps = int(np.clip(np.ceil(length / STEP_M), 1, MAX_STEPS))
    path = before_m + np.linspace(0, 1, steps + 1)[:, None, None, None] * (after_m - before_m)
    for start_m, end_m in pairwise(path):
        contact = _step(contact, start_m, end_m, np.flatnonzero(present), kind)
    return contact


def _step(
    contact: Contact, before_m: np.ndarray, after_m: np.ndarray, hands: np.ndarray, kind: Kind
) -> Contact:
    """Return the contact after one short step: release, carry, grasp, push, then separate."""
    opened = [
        grasp
        for grasp in contact.grasps
        if pinch(after_m[grasp.hand])[1] > grasp.gap_m + OPEN_M
        or _slip_m(contact.scene, grasp, before_m[grasp.hand]) > SLIP_M
    ]
    contact = _release(contact, opened)
    ranks: dict[str, int] = {}  # of the bodies that move in this step
    contact = _follow(contact, after_m, kind, ranks)
    for hand in hands:
        contact = _grasp(contact, int(hand), before_m[hand], after_m[hand], kind)
    for hand in hands:
        contact = _push(contact, int(hand), before_m[hand], after_m[hand], kind, ranks)
    if ranks:
        contact = _separate(contact, after_m, kind, ranks)
    return contact


def _slip_m(scene: Scene, grasp: Grasp, joints_m: Float[np.ndarray, "j 3"]) -> float:
    """Return the distance of the pinch point from the held point of the body in meters."""
    held = (scene.first_part_pose(grasp.name) @ grasp.part_from_hand)[:3, 3]
    return float(np.linalg.norm(held - pinch(joints_m)[0]))


def _release(contact: Contact, grasps: list[Grasp]) -> Contact:
    """Release bodies; they settle unless another hand holds them."""
    if not grasps:
        return contact
    kept = tuple(grasp for grasp in contact.grasps if grasp not in grasps)
    scene = contact.scene
    for grasp in grasps:
        body = scene.body(grasp.name)
        if any(other.name == grasp.name for other in kept):
            continue
        scene = _fall_shut(scene, body) if body.articulated else settle(scene, body.name)
    released = contact.released | {(grasp.hand, grasp.name) for grasp in grasps}
    return replace(contact, scene=scene, grasps=kept, released=released)


def _fall_shut(scene: Scene, body: Body) -> Scene:
    """Let gravity move a lid: shut, or open if it is beyond the vertical; a drawer stays."""
    if body.shape != "lidded box":
        return scene
    beyond = scene.openings[body.name] * LID_DEGREES >= 90
    return scene.with_opening(body.name, 1.0 if beyond else min_opening(scene, body))


def _follow(contact: Contact, after_m: np.ndarray, kind: Kind, ranks: dict[str, int]) -> Contact:
    """Move every held body with its hand, within the limits of its support and hinge."""
    scene, grasps = contact.scene, []
    for grasp in contact.grasps:
        world_from_hand = frame_of(after_m[grasp.hand], kind)
        body = scene.body(grasp.name)
        if contact.holder(grasp.name) is grasp:  # not the second of two hands
            if not body.articulated:
                pose = world_from_hand @ invert(grasp.part_from_hand)
                scene = move(scene, body.name, pose)
                lifted = _lift_out(scene, body.name)
                if lifted is not scene:  # pressed down, the body slips in the hand
                    scene = lifted
                    inverse = invert(scene.body(body.name).world_from_body)
                    grasp = replace(grasp, part_from_hand=inverse @ world_from_hand)
                ranks[body.name] = RANKS["held"]
            elif body.shape == "drawer" or not riders(scene, body.name):
                opening = _opening_at(scene, body, grasp, world_from_hand[:3, 3])
                scene = scene.with_opening(body.name, opening)
                ranks[body.name] = RANKS["furniture"]
        gap = min(grasp.gap_m, pinch(after_m[grasp.hand])[1])
        grasps.append(replace(grasp, gap_m=gap))
    return replace(contact, scene=scene, grasps=tuple(grasps))


def _lift_out(scene: Scene, name: str) -> Scene:
    """Lift a held body out of its support, the surface below its center."""
    body = scene.body(name)
    low = float(transform(body.world_from_body, body.parts[0].vertices_m)[:, 2].min())
    height, _ = support_below(scene, body)
    if low >= height:
        return scene
    pose = body.world_from_body.copy()
    pose[2, 3] += height - low
    return scene.with_pose(name, pose)


def _opening_at(scene: Scene, body: Body, grasp: Grasp, point_m: Float[np.ndarray, " 3"]) -> float:
    """Return the opening that brings the held point of the moving part nearest to a point."""
    held = grasp.part_from_hand[:3, 3]
    point = transform(invert(body.world_from_body), point_m[None])[0]
    if body.shape == "drawer":
        return float(np.clip((held[1] - point[1]) / DRAWER_M, 0, 1))
    hinge = np.array([body.size_m[1] / 2, body.size_m[2] - LID_M])
    angles = [np.arctan2(way[2] - hinge[1], hinge[0] - way[1]) for way in (held, point)]
    opening = np.degrees(angles[1] - angles[0]) / LID_DEGREES
    return float(np.clip(opening, min_opening(scene, body), 1))


def _grasp(
    contact: Contact, hand: int, before_m: np.ndarray, after_m: np.ndarray, kind: Kind
) -> Contact:
    """Grasp the body between the fingertips of a closing hand, if both touch it."""
    gap = pinch(after_m)[1]
    closing, closed = gap < pinch(before_m)[1] - 1e-7, hand in contact.closing
    others = contact.closing - {hand}
    contact = replace(contact, closing=others | {hand} if closing else others)
    if not (closing or closed) or any(grasp.hand == hand for grasp in contact.grasps):
        return contact
    deepest, chosen = -BETWEEN_M, None
    for body in bodies_near(contact.scene, pinch(after_m)[0][None], 0.0):
        last_tip, last_middle = _distances(contact.scene, body, before_m)
        tip, middle = _distances(contact.scene, body, after_m)
        # Fingers stop about their radius away from a surface: a hand that touches a body and gets
        # no nearer holds it too.
        firm = tip <= FIRM_M or (last_tip <= PAD_M and tip >= last_tip)
        # A hand that just released the body and moves away does not grasp it again.
        firm &= (hand, body.name) not in contact.released or middle <= last_middle
        if firm and min(last_middle, middle) < deepest:
            deepest, chosen = min(last_middle, middle), body.name
    if chosen is None:
        return contact
    pose = invert(contact.scene.first_part_pose(chosen)) @ frame_of(after_m, kind)
    grasp = Grasp(hand=hand, name=chosen, part_from_hand=pose, gap_m=gap)
    return replace(contact, grasps=(*contact.grasps, grasp))


def _distances(scene: Scene, body: Body, joints_m: Float[np.ndarray, "j 3"]) -> tuple[float, float]:
    """Return the distances of the farther fingertip and of the pinch point to a body in meters."""
    points = np.stack([*tips_of(joints_m), pinch(joints_m)[0]])
    distance, *_ = surface_of(scene, body, points, handle=True)
    return float(distance[:2].max()), float(distance[2])


def _push(
    contact: Contact,
    hand: int,
    before_m: np.ndarray,
    joints_m: np.ndarray,
    kind: Kind,
    ranks: dict[str, int],
) -> Contact:
    """Move bodies out of the flesh that enters them from the side."""
    points, flesh = touching(joints_m, kind), FLESH_M[kind]
    way = points - touching(before_m, kind)
    grasping, opening = np.stack([*tips_of(joints_m), pinch(joints_m)[0]]), opening_of(joints_m)
    near = bodies_near(contact.scene, points, flesh + LEAVE_M[1])
    names = {body.name for body in near}
    scene = contact.scene
    pressing = {key for key in contact.pressing if key[0] != hand or key[2] in names}
    released = {pair for pair in contact.released if pair[0] != hand or pair[1] in names}
    for body in near:
        distance, normal, _ = surface_of(scene, body, np.concatenate([points, grasping]))
        depth, distance = distance[-1], distance[:-3]
        inside = distance < flesh
        if depth > LEAVE_M[1]:
            gone = np.flatnonzero(distance > flesh + LEAVE_M[0])
            pressing -= {(hand, int(point), body.name) for point in gone}
            if not inside.any():
                released.discard((hand, body.name))
        entering = [
            int(point)
            for point in np.flatnonzero(inside)
            if (hand, int(point), body.name) not in pressing
        ]
        if not entering:
            continue
        pushed = scene
        if (hand, body.name) in released or contact.holder(body.name) is not None:
            presses = np.ones(len(entering), bool)
        else:
            closing, faces = hand in contact.closing, normal[-3:-1]
            presses = yields(body, way, opening, faces, kind, closing=closing)[entering]
            rest = np.flatnonzero(~presses)
            pushed, presses[rest] = push_out(
                scene, body.name, points[np.array(entering)[rest]], flesh
            )
        pressing |= {(hand, entering[index], body.name) for index in np.flatnonzero(presses)}
        if pushed is not scene:
            scene, ranks[body.name] = pushed, RANKS["pushed"]
    return replace(contact, scene=scene, pressing=frozenset(pressing), released=frozenset(released))


def _separate(contact: Contact, after_m: np.ndarray, kind: Kind, ranks: dict[str, int]) -> Contact:
    """Separate overlapping bodies, settle the unsupported ones, and let held ones slip."""
    scene, moved = push_aside(contact.scene, ranks)
    held = {grasp.name for grasp in contact.grasps}
    free = [scene.body(name) for name in (moved | set(ranks)) - held]
    # From the lowest to the highest: a body settles on supports that are already at rest.
    for body in sorted(free, key=lambda body: (body.world_from_body[2, 3], body.name)):
        if not body.articulated:
            scene = settle(scene, body.name)
    slipped = moved & held
    grasps = tuple(
        replace(
            grasp,
            part_from_hand=invert(scene.first_part_pose(grasp.name))
            @ frame_of(after_m[grasp.hand], kind),
        )
        if grasp.name in slipped or contact.holder(grasp.name) is not grasp
        else grasp
        for grasp in contact.grasps
    )
    return replace(contact, scene=scene, grasps=grasps)
