"""Clips of contacts that scripts lack, executed by the true world.

In a script one hand grasps one body, and everything else rests. Here hands push bodies, two hands
act, bodies carry others, grasps fail, and hands are fast.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from egosim_jax.rendering.mesh import Side
from egosim_jax.types import Action, Kind, VideoSpec
from egosim_jax.worlds.tabletop import hand_motion
from egosim_jax.worlds.tabletop.bodies import Body
from egosim_jax.worlds.tabletop.clips import TabletopClip
from egosim_jax.worlds.tabletop.hand_motion import FLAT, REST_M, Grip, Hand, Intent
from egosim_jax.worlds.tabletop.hands import FLESH_M, touching
from egosim_jax.worlds.tabletop.scene import Scene
from egosim_jax.worlds.tabletop.sequence import make_scripts, make_sequence
from egosim_jax.worlds.tabletop.support import supporters
from egosim_jax.worlds.tabletop.world import World

MAX_TRIES = 10
"""Maximum number of encounters that are drawn until a scene allows one."""
PUSH_M = (0.03, 0.12)
"""Minimum and maximum distance of a push, in meters."""
BEFORE_M = (0.02, 0.05)
"""Minimum and maximum distance of a hand before it pushes, in meters."""
FINE = 401
"""Number of moments of a script from which the frames of a fast hand are taken."""
CHAIN = 0.3
"""Probability that a push aims at the next body."""
BOTH_M = 0.015
"""Distance from the middle of a body to each of two hands that hold it, in meters."""
MISS_M = (0.01, 0.04)
"""Minimum and maximum error of a grasp that misses, in meters."""


@dataclass(frozen=True, kw_only=True)
class Encounter:
    """A planned encounter: the scene before it, and what the hands do."""

    scene: Scene
    """Scene before the clip."""
    hands: list[list[Hand]]
    """Path of each hand: its configuration at every frame."""
    prompt: str
    """Prompt that describes the intention."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """The moment at which an encounter is planned."""

    scene: Scene
    """All bodies and their poses."""
    hands: tuple[Hand, ...]
    """Hands at the end of the clip before; none before the first clip."""
    kind: Kind
    """Human hands or a robot gripper."""
    frames: int
    """Number of frames of the clip."""
    rng: np.random.Generator
    """Random numbers of the sequence."""

    @property
    def loose(self) -> list[Body]:
        """Bodies that hands manipulate."""
        return [b for b in self.scene.bodies if not (b.static or b.articulated)]

    def pick(self, bodies: list[Body]) -> Body:
        """Draw a body."""
        return bodies[int(self.rng.integers(len(bodies)))]

    def chance(self, probability: float) -> bool:
        """Draw a yes or no."""
        return bool(self.rng.random() < probability)

    def side_for(self, x_m: float) -> Side:
        """Return the side of the hand that acts at a place: the one of the clip before, if any."""
        if self.hands:
            return self.hands[0].side
        return "right" if x_m + self.rng.normal(0, 0.04) > 0 else "left"

    def hand_at(self, side: Side, point_m: Float[np.ndarray, " 3"]) -> Hand:
        """Return the hand of a side where the clip before left it, else relaxed near a point."""
        kept = [hand for hand in self.hands if hand.side == side]
        if kept:
            return kept[0]
        point = point_m + self.rng.uniform(0, 0.3) * (REST_M[side] - point_m)
        return Hand(side=side, grip=hand_motion.relaxed(point, side, self.kind))

    def act(self, intent: Intent, side: Side | None = None) -> list[Hand]:
        """Return the path of the hand that carries out an intent."""
        x = float(self.scene.body(intent.name).world_from_body[0, 3])
        side = side or self.side_for(x)
        grip = hand_motion.grip_on(self.scene, intent, self.kind, side)
        hand = self.hand_at(side, grip.point_m + hand_motion.BEFORE_M)
        moments = hand_motion.act(self.scene, (hand,), intent, self.kind, frames=self.frames)
        return [moment.hands[0] for moment in moments]

    def lift_or_carry(self, body: Body) -> Intent:
        """Return the intent to carry a body to a free place, or to lift it."""
        place = self.scene.free_place(body, self.rng, away_m=hand_motion.CARRY_M)
        if place is None or self.chance(0.4):
            return hand_motion.lift(body)
        return hand_motion.carry(body, place)

    def says(self, side: Side, words: str) -> str:
        """Return a prompt of one hand."""
        return f"The {side} hand {words}" if self.kind == "human" else f"The gripper {words}"

    def by_one_hand(self, path: list[Hand], words: str) -> Encounter:
        """Return the encounter of one hand."""
        return Encounter(scene=self.scene, hands=[path], prompt=self.says(path[0].side, words))


def make_encounters(
    seed: int,
    *,
    spec: VideoSpec,
    clips: int = 1,
    kind: Kind = "human",
    black_cloths: int = 0,
) -> Iterator[TabletopClip]:
    """Yield the clips of a scene with an encounter in each, drawn from `ENCOUNTERS`.

    Hands continue where they were. If the scene allows no encounter, the clips are the scripted
    ones of `make_sequence`; a later clip then has resting hands.
    """
    settings = {"spec": spec, "kind": kind, "clips": clips, "black_cloths": black_cloths}
    rng = np.random.default_rng([seed, 0 if kind == "human" else 1, 5])
    world, hands = None, ()
    for script in make_scripts(seed, **settings):
        scene = world.scene if world else script.scene
        start = Start(scene=scene, hands=hands, kind=kind, frames=spec.frames, rng=rng)
        encounter = draw(start)
        if encounter is None and world is None:
            yield from make_sequence(seed, **settings)
            return
        if encounter is None:
            encounter = Encounter(scene=scene, hands=[], prompt="The hand rests.")
        acting = [path[0].side for path in encounter.hands]
        resting = [[hand] * spec.frames for hand in hands if hand.side not in acting]
        paths = [*encounter.hands, *resting]
        joints = [[h.grip.pose(kind, h.side)[0] for h in path] for path in paths]
        world = replace(world or World(scene=scene, seed=seed), scene=encounter.scene)
        action = Action(
            cameras=script.cameras,
            joints_m=np.stack(joints, axis=1),
            kind=kind,
            prompt=encounter.prompt,
        )
        clip, world = world.execute(action)
        hands = tuple(path[-1] for path in paths)
        yield clip


def draw(start: Start) -> Encounter | None:
    """Draw encounters until the scene allows one; None after `MAX_TRIES`."""
    for _ in range(MAX_TRIES):
        encounter = ENCOUNTERS[int(start.rng.integers(len(ENCOUNTERS)))](start)
        if encounter is not None:
            return encounter
    return None


def push(start: Start) -> Encounter | None:
    """Sweep an open hand, a fist or a closed gripper through a body, perhaps into the next one."""
    if not start.loose:
        return None
    rng, body = start.rng, start.pick(start.loose)
    center = body.world_from_body[:3, 3]
    angle = rng.uniform(-np.pi, np.pi)
    others = [other for other in start.scene.bodies if other.name != body.name]
    if others and start.chance(CHAIN):
        gap = min((o.world_from_body[:2, 3] - center[:2] for o in others), key=np.linalg.norm)
        angle = float(np.arctan2(gap[1], gap[0]))
    way = np.array([np.cos(angle), np.sin(angle), 0.0])
    side = start.side_for(float(center[0]))
    fist = start.kind == "robot" or start.chance(0.4)
    grip = Grip(
        point_m=center,
        yaw=(0.5 if side == "right" else -0.5) + rng.uniform(-0.4, 0.4),
        pitch=np.radians(rng.uniform(35, 60)),
        closure=rng.uniform(0.85, 1.0) if fist else rng.uniform(0.0, 0.3),
    )
    # A random point of the hand, at the height of the body, goes through its center.
    points = touching(grip.pose(start.kind, side)[0] - center, start.kind)
    flesh = FLESH_M[start.kind]
    lift = max(0.5 * body.size_m[2], flesh - float(points[:, 2].min()))
    low = points[points[:, 2] + lift < 0.8 * body.size_m[2]]
    if not len(low):
        return None
    across = np.array([-way[1], way[0], 0.0])
    point = low[int(rng.integers(len(low)))]
    aim = rng.uniform(-0.25, 0.25) * body.size_m[0] - float(point @ across)
    ahead = float((low @ way).max()) + flesh + body.size_m[0] / 2
    line = center + aim * across + [0, 0, lift]
    before = line - (ahead + rng.uniform(*BEFORE_M)) * way
    end = line - (ahead - rng.uniform(*PUSH_M)) * way
    hand = start.hand_at(side, before + [0, -0.06, 0.08])
    top = body.size_m[2] + 0.02
    keys = [
        (0.0, hand.grip),
        (0.25, replace(grip, point_m=before + [0, 0, top])),
        (0.4, replace(grip, point_m=before)),
        (0.8, replace(grip, point_m=end)),
        (1.0, replace(grip, point_m=end - 0.05 * way + [0, 0, top])),
    ]
    words = f"pushes the {body.name} {hand_motion.direction(way)}."
    return start.by_one_hand(through(keys, side, start.frames), words)


def two_hands(start: Start) -> Encounter | None:
    """Lift or carry a body with each hand, or one body with both."""
    if start.kind == "robot" or len(start.hands) == 1:
        return None
    if not start.hands and start.loose and start.chance(0.3):
        body = start.pick(start.loose)
        intent = start.lift_or_carry(body)
        paths = _both(start, intent)
        words = intent.caption  # "lifts ... and puts ...": here of two hands
        for verb in ("lift", "pick", "put"):
            words = words.replace(f"{verb}s ", f"{verb} ")
        return Encounter(scene=start.scene, hands=paths, prompt=f"Both hands {words}")
    sides: dict[Side, list[Body]] = {
        "right": [b for b in start.loose if b.world_from_body[0, 3] > 0.02],
        "left": [b for b in start.loose if b.world_from_body[0, 3] < -0.02],
    }
    if not all(sides.values()):
        return None
    paths, words = [], []
    for side, bodies in sides.items():
        body = start.pick(bodies)
        intent = start.lift_or_carry(body)
        paths.append(start.act(intent, side))
        words.append(start.says(side, intent.caption))
    return Encounter(scene=start.scene, hands=paths, prompt=" ".join(words))


def rider(start: Start) -> Encounter | None:
    """Lift or carry a body together with another one on it."""
    stacked = _stack(start)
    if stacked is None:
        return None
    start, top, below = stacked
    intent = start.lift_or_carry(below)
    path = start.act(intent)
    words = intent.caption.replace(below.name, f"{below.name} with the {top.name} on it")
    return start.by_one_hand(path, words)


def take_off(start: Start) -> Encounter | None:
    """Take a body off another one."""
    stacked = _stack(start)
    if stacked is None:
        return None
    start, top, below = stacked
    place = start.scene.free_place(top, start.rng, away_m=hand_motion.CARRY_M)
    if place is None:
        return None
    intent = hand_motion.carry(top, place)
    path = start.act(intent)
    old = f"picks up the {top.name}"
    words = intent.caption.replace(old, f"takes the {top.name} off the {below.name}")
    return start.by_one_hand(path, words)


def fast(start: Start) -> Encounter | None:
    """Act at twice the speed of a script, then rest."""
    intent = hand_motion.choose(start.scene, start.rng)
    path = replace(start, frames=FINE).act(intent)
    begin, end = _holding(start, intent, path[0])
    half = (start.frames + 1) // 2
    before, after = half // 3, half // 4
    # A hand opens and closes in less than a frame: some frames must be right before and after.
    times = [
        *np.linspace(0, begin - hand_motion.CLOSE_SHARE, before),
        *np.linspace(begin + 1 / FINE, end, half - before - after),
        *np.linspace(1 - (1 - end) / 2, 1, after),
    ]
    path = [path[round(time * (FINE - 1))] for time in times]
    path += path[-1:] * (start.frames - half)
    return start.by_one_hand(path, intent.caption)


def miss(start: Start) -> Encounter | None:
    """Miss a body with a grasp that is off by 1 to 4 cm, or with a fist next to it."""
    rng, intent = start.rng, hand_motion.choose(start.scene, start.rng)
    body, angle = start.scene.body(intent.name), start.rng.uniform(-np.pi, np.pi)
    fist = start.kind == "human" and start.chance(0.3)
    error = body.size_m[0] / 2 + rng.uniform(*MISS_M) if fist else rng.uniform(*MISS_M)
    pose = body.world_from_body.copy()
    pose[:2, 3] += error * np.array([np.cos(angle), np.sin(angle)])
    path = replace(start, scene=start.scene.with_pose(body.name, pose)).act(intent)
    if fist:
        begin, end = _holding(start, intent, path[0])
        path = [
            hand.with_closure(1.0) if begin < time < end else hand
            for hand, time in zip(path, np.linspace(0, 1, start.frames), strict=True)
        ]
    return start.by_one_hand(path, intent.caption)


def slip(start: Start) -> Encounter | None:
    """Close the hand too late, or open it too early."""
    intent = hand_motion.choose(start.scene, start.rng)
    path = start.act(intent)
    begin, end = _holding(start, intent, path[0])
    moment, late = begin + start.rng.uniform(0.15, 0.7) * (end - begin), start.chance(0.5)
    wide = hand_motion.opened(start.kind)
    path = [
        hand.with_closure(min(hand.grip.closure, wide))
        if begin - hand_motion.CLOSE_SHARE < time < end and late == (time < moment)
        else hand
        for hand, time in zip(path, np.linspace(0, 1, start.frames), strict=True)
    ]
    return start.by_one_hand(path, intent.caption)


ENCOUNTERS: tuple[Callable[[Start], Encounter | None], ...] = (
    push, push, push, two_hands, two_hands, rider, take_off, fast, miss, slip,
)  # fmt: skip
"""Encounters; a repeated one is more likely."""


def through(keys: list[tuple[float, Grip]], side: Side, frames: int) -> list[Hand]:
    """Return the path of a hand through grips at times in [0, 1], each reached smoothly."""
    times, grips = zip(*keys, strict=True)
    path = []
    for time in np.linspace(0, 1, frames):
        index = min(int(np.searchsorted(times, time, side="right")), len(times) - 1) - 1
        share = hand_motion.smooth((time - times[index]) / (times[index + 1] - times[index]))
        a, b = vars(grips[index]), vars(grips[index + 1])
        path.append(Hand(side=side, grip=Grip(**{n: a[n] + share * (b[n] - a[n]) for n in a})))
    return path


def _both(start: Start, intent: Intent) -> list[list[Hand]]:
    """Return the paths of two hands that move one body; the left hand mirrors the right one."""
    right = start.act(intent, "right")
    begin, end = _holding(start, intent, right[0])
    times = np.linspace(0, 1, start.frames)
    held = [hand.grip.point_m[0] for hand, t in zip(right, times, strict=True) if begin <= t <= end]
    left = []
    for hand, time in zip(right, times, strict=True):
        x = hand.grip.point_m[0]
        other = 2 * held[0] - x if time < begin else 2 * held[-1] - x if time > end else x
        left.append(_moved(hand, other - x - BOTH_M, yaw=-hand.grip.yaw, side="left"))
    return [[_moved(hand, BOTH_M, yaw=hand.grip.yaw, side="right") for hand in right], left]


def _moved(hand: Hand, x_m: float, *, yaw: float, side: Side) -> Hand:
    point = hand.grip.point_m + [x_m, 0, 0]
    return Hand(side=side, grip=replace(hand.grip, point_m=point, yaw=yaw))


def _stack(start: Start) -> tuple[Start, Body, Body] | None:
    """Return a start in which a body stands on another one, and the upper and the lower body.

    Before the first clip a body is put there. Later it must have got there.
    """
    if start.hands:
        pairs = [
            (start.scene.body(a), start.scene.body(b)) for a, b in supporters(start.scene).items()
        ]
        pairs = [pair for pair in pairs if not (pair[0].static or pair[1].articulated)]
        return (start, *pairs[int(start.rng.integers(len(pairs)))]) if pairs else None
    lower = [body for body in start.loose if body.shape in FLAT]
    if not lower:
        return None
    below = start.pick(lower)
    upper = [b for b in start.loose if b.name != below.name and b.shape != "ball"]
    if not upper:
        return None
    top = start.pick(upper)
    pose = top.world_from_body.copy()
    pose[:3, 3] = below.world_from_body[:3, 3] + [0, 0, below.size_m[2]]
    scene = start.scene.with_pose(top.name, pose)
    return replace(start, scene=scene), scene.body(top.name), below


def _holding(start: Start, intent: Intent, hand: Hand) -> tuple[float, float]:
    return hand_motion.holding(start.scene, hand, intent, start.kind)
