"""Tasks as text, whose success follows from the state alone.

    red box moved by 10 cm          its center is at least so far from where it was
    red box moved by 0,0.1,0        it is moved so, in meters in the world, within 2 cm
    red box lifted by 10 cm         its center is at least so much higher
    red box onto white box          it rests on the other object, in no hand
    green chest open by 30 deg      turned, or with a length moved, relative to its case
    red cone untouched              moved by at most 1 cm; else the trial ends
    carry                           the object that a tabletop scene's script moves is at its goal

    MODULE:NAME                     a reward function of your own (`rewards.RewardFn`), such as a
                                    judge that looks at the clip

Conditions are joined by " and ". An object is a name or an id of the state. "any" is each object
that can be picked up, one task for each. An instruction for the policy may come first: "pick up the
box: red box lifted by 10 cm".
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float

from egosim_jax.geometry import invert, rotation_angles_deg
from egosim_jax.interactive.env.rewards import (
    Outcome,
    Reward,
    RewardFn,
    check_reward,
    displacement_m,
    judge,
    reward_of,
)
from egosim_jax.io.bounded import quote, quote_text
from egosim_jax.simulation.start import Start
from egosim_jax.state.planes import vertical
from egosim_jax.types import InputError, SceneState

NAMED = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")
"""Name of a reward function."""
CARRY, ANY = "carry", "any"
GOAL_M = 0.02
"""Maximum distance to the goal of an object, in meters."""
TOUCHED_M = 0.01
"""Motion above which an object counts as touched, in meters."""
GAP_M = 0.025
"""Maximum vertical distance of an object from the object on which it rests, in meters."""
NUMBER = r"-?\d+(?:\.\d+)?"
AMOUNT = rf"(?P<amount>{NUMBER})\s*(?P<unit>m|cm|mm|deg)?"
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "deg": np.pi / 180}
FORMS = {
    "moved to": re.compile(
        rf"(?P<object>.+) moved by (?P<offset>{NUMBER}(?:\s*,\s*{NUMBER}){{2}})"
    ),
    "moved": re.compile(rf"(?P<object>.+) moved by {AMOUNT}"),
    "lifted": re.compile(rf"(?P<object>.+) lifted by {AMOUNT}"),
    "open": re.compile(rf"(?P<object>.+) open by {AMOUNT}"),
    "onto": re.compile(r"(?P<object>.+) onto (?P<other>.+)"),
    "untouched": re.compile(r"(?P<object>.+) untouched"),
    CARRY: re.compile(CARRY),
}  # the order decides: "moved by 0,1,0" is no amount
INSTRUCTIONS = {
    "moved to": "Move the {object}.",
    "moved": "Move the {object}.",
    "lifted": "Lift the {object}.",
    "open": "Open the {object}.",
    "onto": "Put the {object} onto the {other}.",
    "untouched": "Do not touch the {object}.",
}


class Judged(NamedTuple):
    """Judgment of a condition in a state."""

    met: bool
    """True if the state meets the condition."""
    missing: float
    """Missing part of the minimum, in meters or radians."""
    broken: bool = False
    """True if the condition can no longer be met."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Condition:
    """Condition on the state, such as "red box lifted by 10 cm"."""

    kind: str
    """Name of its form."""
    object: str = ""
    """Name or id of the object; empty for `carry`."""
    other: str = ""
    """Name or id of the other object, of `onto`."""
    amount: float = 0.0
    """Minimum in meters or radians."""
    angle: bool = False
    """True if the minimum is an angle."""
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Displacement of the goal, in meters."""


@dataclass(frozen=True, kw_only=True)
class Goal:
    """Task in one scene: a reward function (`rewards.RewardFn`)."""

    instruction: str
    """Instruction for a policy."""
    conditions: tuple[Callable[[SceneState, SceneState], Judged], ...]
    """Judgment of each condition from the first and the present state."""
    waits: bool
    """True if success is known only after the last clip, because all conditions are to keep."""
    judge_of: RewardFn | None = None
    """Reward function in place of conditions; it may look at the clip."""

    def __call__(self, outcome: Outcome) -> Reward:
        """Return minus the missing parts; success and a broken condition end the episode."""
        if self.judge_of is not None:
            return judge(self.judge_of, outcome)
        return self.judge(outcome.first, outcome.step.state)

    def judge(self, first: SceneState, now: SceneState) -> Reward:
        """Return the reward of a state, by the conditions."""
        judged = [condition(first, now) for condition in self.conditions]
        success = all(judgment.met for judgment in judged)
        broken = any(judgment.broken for judgment in judged)
        return Reward(
            reward=-float(sum(judgment.missing for judgment in judged)),
            terminated=broken or (success and not self.waits),
            success=success,
        )


@dataclass(frozen=True, kw_only=True)
class Task:
    """Conditions by the names of objects, for any scene that has them."""

    text: str
    """Text of the task, without an instruction."""
    conditions: tuple[Condition, ...]
    """Conditions that must be met together."""
    instruction: str = ""
    """Instruction for a policy; empty: made of the conditions."""
    judge_of: RewardFn | None = None
    """Reward function in place of conditions."""

    @property
    def _names_any(self) -> bool:
        return any(condition.object == ANY for condition in self.conditions)

    def goals(
        self, start: Start, *, loose: Sequence[str] = (), carried: Condition | None = None
    ) -> dict[str, Goal]:
        """Return the goal of the task in a scene by its text; with `any`, of each loose object.

        It is empty if the scene has not all objects, or no script that carries one (`carried`).
        """
        if self.judge_of is not None:
            check_reward(self.judge_of, start)
            instruction = self.instruction or self.text
            seen = Goal(instruction=instruction, conditions=(), waits=False, judge_of=self.judge_of)
            return {self.text: seen}
        if not self._names_any:
            goal = self._goal(start, self.conditions, carried)
            return {} if goal is None else {self.text: goal}
        goals = {}
        for name in loose:
            if name in {condition.object for condition in self.conditions}:
                continue
            named = tuple(
                replace(condition, object=name) if condition.object == ANY else condition
                for condition in self.conditions
            )
            if (goal := self._goal(start, named, carried)) is not None:
                goals[
                    re.sub(rf"\b{ANY}\b(?= (?:moved|lifted|open|onto|untouched))", name, self.text)
                ] = goal
        return goals

    def _goal(
        self, start: Start, conditions: Sequence[Condition], carried: Condition | None
    ) -> Goal | None:
        """Return the goal of conditions in a scene; None if the scene lacks an object."""
        state, judges, words = start.state, [], []
        up = vertical(state, start.camera.world_from_camera[0])
        if state.provenance.get("world") == "tabletop":
            up = np.array([0.0, 0.0, 1.0])
        for condition in conditions:
            if condition.kind == CARRY:
                if carried is None:
                    return None
                condition = carried
            numbers = [_number(state, name) for name in (condition.object, condition.other) if name]
            present = [number for number in numbers if number is not None]
            if len(present) < len(numbers):
                return None
            judges.append(_judge_of(condition, present, state, up))
            texts = [objects_of(state)[number] for number in present]
            names = dict(zip(("object", "other"), texts, strict=False))
            words.append(INSTRUCTIONS[condition.kind].format(**names))
        named = {condition.object for condition in conditions} - {""}
        instruction = self.instruction.replace("{object}", " and ".join(sorted(named)))
        return Goal(
            instruction=instruction or " ".join(words),
            conditions=tuple(judges),
            waits=all(condition.kind == "untouched" for condition in conditions),
        )


def parse(text: str) -> Task:
    """Return the task of a text. Raises `InputError` with the forms if it is not one."""
    instruction, _, conditions = text.rpartition(": ")
    if NAMED.fullmatch(conditions.strip()):
        name = conditions.strip()
        return Task(
            text=name, conditions=(), instruction=instruction.strip(), judge_of=reward_of(name)
        )
    parts = [part.strip() for part in re.split(r"\s+and\s+", conditions.strip())]
    return Task(
        text=" and ".join(parts),
        conditions=tuple(_condition(part) for part in parts),
        instruction=instruction.strip(),
    )


def _condition(text: str) -> Condition:
    for kind, form in FORMS.items():
        if (match := form.fullmatch(text)) is None:
            continue
        fields = match.groupdict()
        unit = fields.get("unit") or "m"
        amount = float(fields.get("amount") or 0) * UNITS[unit]
        if "amount" in fields and (amount <= 0 or (unit == "deg" and kind != "open")):
            raise InputError(
                f"The task {quote(text)} has the amount {fields['amount']} {unit}: it must be "
                "above 0, in m, cm or mm, and only `open by` may be in deg. (--tasks)"
            )
        offset = [float(number) for number in (fields.get("offset") or "0,0,0").split(",")]
        return Condition(
            kind=kind,
            object=fields.get("object") or "",
            other=fields.get("other") or "",
            amount=amount,
            angle=unit == "deg",
            offset_m=(offset[0], offset[1], offset[2]),
        )
    raise InputError(
        f"There is no task {quote(text)}: it must be carry, MODULE:NAME, or an object "
        "followed by `moved by 10 cm`, `moved by X,Y,Z`, `lifted by 10 cm`, `onto OTHER`, `open by "
        "30 deg` or `untouched`, such as 'red box lifted by 10 cm'. Join several by ' and '. "
        "(--tasks)"
    )


def objects_of(state: SceneState) -> dict[int, str]:
    """Return the name of each object that has points, by id; an object without one has its id."""
    numbers = np.unique(state.object_ids[state.object_ids > 0]).tolist()
    return {number: state.names.get(number, str(number)) for number in numbers}


def describe(state: SceneState) -> str:
    """Return the objects of a state in words, for messages."""
    return ", ".join(quote_text(name) for name in objects_of(state).values()) or "no objects"


def _number(state: SceneState, name: str) -> int | None:
    """Return the id of an object by its name or id; None if the state has it not, or has two."""
    objects = objects_of(state)
    numbers = [number for number, its in objects.items() if its == name]
    if not numbers and name.isdecimal() and int(name) in objects:
        return int(name)
    return numbers[0] if len(numbers) == 1 else None


def _judge_of(
    condition: Condition, numbers: Sequence[int], state: SceneState, up: Float[np.ndarray, " 3"]
) -> Callable[[SceneState, SceneState], Judged]:
    """Return the judgment of a condition on objects of a scene."""
    number, minimum = numbers[0], condition.amount

    def at_least(value: float) -> Judged:
        return Judged(value >= minimum, max(0.0, minimum - value))

    def moved(first: SceneState, now: SceneState) -> Judged:
        return at_least(float(np.linalg.norm(displacement_m(first, now, number))))

    def moved_to(first: SceneState, now: SceneState) -> Judged:
        gap = float(np.linalg.norm(displacement_m(first, now, number) - condition.offset_m))
        return Judged(gap <= GOAL_M, gap)

    def lifted(first: SceneState, now: SceneState) -> Judged:
        return at_least(float(displacement_m(first, now, number) @ up))

    def untouched(first: SceneState, now: SceneState) -> Judged:
        motion = float(np.linalg.norm(displacement_m(first, now, number)))
        return Judged(motion <= TOUCHED_M, max(0.0, motion - TOUCHED_M), motion > TOUCHED_M)

    def opened(first: SceneState, now: SceneState) -> Judged:
        return at_least(_opening(first, now, number, case, angle=condition.angle))

    def onto(first: SceneState, now: SceneState) -> Judged:
        gap = _gap_m(now, number, numbers[1], up)
        return Judged(gap <= 0 and number not in now.held.values(), max(0.0, gap))

    case = _number(state, f"case of the {condition.object}")
    kinds = {"moved": moved, "moved to": moved_to, "lifted": lifted, "untouched": untouched}
    return {**kinds, "open": opened, "onto": onto}[condition.kind]


def _opening(
    first: SceneState, now: SceneState, number: int, case: int | None, *, angle: bool
) -> float:
    """Return how far a part is open relative to its case, in radians or meters."""
    if not angle:
        own = displacement_m(first, now, number)
        return float(
            np.linalg.norm(own - (0 if case is None else displacement_m(first, now, case)))
        )

    def turn(part: int) -> np.ndarray:
        before, after = (s.world_from_object.get(part, np.eye(4)) for s in (first, now))
        return np.asarray(after, float) @ invert(np.asarray(before, float))

    relative = turn(number) if case is None else invert(turn(case)) @ turn(number)
    return float(np.radians(rotation_angles_deg(relative[None])[0]))


def _gap_m(state: SceneState, number: int, other: int, up: Float[np.ndarray, " 3"]) -> float:
    """Return the missing distance of an object to rest on another one, in meters; at most 0.

    Its center must be above the box around the other's points, and its lowest points at the top.
    """
    points, below = (state.points_m[state.object_ids == n].astype(float) for n in (number, other))
    heights, tops = points @ up, below @ up
    vertical_m = abs(np.percentile(heights, 2) - np.percentile(tops, 98)) - GAP_M
    level = [np.cross(up, axis) for axis in np.eye(3)[np.argsort(np.abs(up))[:2]]]
    center = points.mean(axis=0)
    sides = [
        max(below.dot(axis).min() - center @ axis, center @ axis - below.dot(axis).max())
        for axis in level
    ]
    return float(max(vertical_m, *sides))
