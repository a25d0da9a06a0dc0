"""Rewards and termination of episodes, from the outcome of a chunk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, cast, no_type_check, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.io.bounded import quote
from egosim_jax.runtime.registry import Registry
from egosim_jax.simulation.simulator import Step
from egosim_jax.simulation.start import Start
from egosim_jax.types import InputError, SceneState, check_video


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of a chunk, and the first state of the episode."""

    first: SceneState
    """State at the start of the episode."""
    step: Step
    """View, clip and state of the chunk."""

    def displacement_m(self, number: int) -> Float[np.ndarray, " 3"]:
        """Return the displacement of an object's center since the start, in meters."""
        return displacement_m(self.first, self.step.state, number)


def displacement_m(first: SceneState, now: SceneState, number: int) -> Float[np.ndarray, " 3"]:
    """Return the displacement of an object's center between two states, in meters."""
    pose = np.asarray(now.world_from_object.get(number, np.eye(4)), float)
    before = np.asarray(first.world_from_object.get(number, np.eye(4)), float)
    check_object(first, number)
    points = first.points_m[first.object_ids == number]
    center = np.append(points.astype(float).mean(axis=0), 1)
    return (pose @ np.linalg.inv(before) @ center - center)[:3]


@dataclass(frozen=True, kw_only=True)
class Reward:
    """Reward of a chunk, and whether it ends the episode."""

    reward: float
    """Reward of the chunk."""
    terminated: bool = False
    """True if the episode ends, for example with a solved task."""
    success: bool = False
    """True if the task is solved after the chunk."""


@runtime_checkable
class RewardFn(Protocol):
    """Reward function of a chunk's outcome."""

    def __call__(self, outcome: Outcome) -> Reward:
        """Return the reward."""
        ...


REWARDS: Registry[RewardFn] = Registry(
    "reward",
    "reward",
    "egosim_jax.rewards",
    {"lift": "egosim_jax.interactive.learn.lift:Lift"},
)
"""Rewards by name, with options. A learned judge is the MODULE:NAME of a function of an outcome."""


def check_object(first: SceneState, number: int) -> None:
    """Raise `InputError` unless the first state of an episode has points of an object."""
    objects = set(np.unique(first.object_ids).tolist()) - {0}
    if number not in objects:
        raise InputError(
            f"Object {number} has no points in the first state: its position is unknown. Choose "
            f"one of {sorted(objects)[:100]}, the keys of info['objects']."
        )


def check_reward(reward: RewardFn, start: Start) -> None:
    """Run the method `check` of a reward function that has one: it refuses a start."""
    if (check := getattr(reward, "check", None)) is not None:
        check(start)


def reward_of(reward: Any) -> RewardFn:
    """Return a reward function, which a text names: `lift --height-m 0.1`, MODULE:NAME.

    Raises `InputError` for an unknown name, and for a value that is no function of the outcome.
    """
    named_by = reward
    if isinstance(reward, str):
        name = reward.split(maxsplit=1)[0] if reward.strip() else ""
        named = REWARDS.get(name)
        # a function of an outcome is a reward; only a class is made, with the options
        reward = REWARDS.parse(reward) if isinstance(named, type) or reward != name else named
    if not callable(reward):
        raise InputError(
            f"The reward is {quote(named_by)}: it must be MoveObject, GoalImage, a function of an "
            "Outcome that returns a Reward, or the MODULE:NAME of one. (reward)"
        )
    return cast(RewardFn, reward)


def judge(reward: RewardFn, outcome: Outcome) -> Reward:
    """Return the reward of an outcome. Raises `InputError` if the function returns none."""
    result: Any = reward(outcome)
    if not isinstance(result, Reward):
        raise InputError(
            f"The reward function returned {quote(result)}: it must return a Reward, for instance "
            "Reward(reward=0.5). (reward)"
        )
    return result


def no_reward(outcome: Outcome) -> Reward:
    """Return a reward of 0, for callers that compute their own from the frames."""
    return Reward(reward=0.0)


@no_type_check
@dataclass(frozen=True, kw_only=True)
class MoveObject:
    """Task of moving an object by an offset; success is exact in the true world."""

    number: int
    """Id of the object in the state."""
    offset_m: tuple[float, float, float]
    """Target displacement in the world, in meters."""
    tolerance_m: float = 0.02
    """Maximum distance to the goal that counts as success, in meters."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless id, offset and tolerance are numbers that a task can have."""
        if isinstance(self.number, bool) or not isinstance(self.number, int | np.integer):
            raise InputError(
                f"The object is {quote(self.number)}: it must be an id, a whole number. Choose one "
                "of the keys of info['objects']. (number)"
            )
        offset = np.asarray(self.offset_m)
        numbers = offset.shape == (3,) and offset.dtype.kind in "iuf"
        if not (numbers and np.isfinite(offset).all()):
            raise InputError(
                f"The offset is {quote(self.offset_m)}: it must be x, y and z in meters, all "
                "finite. (offset_m)"
            )
        if not 0 < self.tolerance_m < np.inf:
            raise InputError(
                f"The tolerance is {quote(self.tolerance_m)}: it must be above 0, in meters. "
                "(tolerance_m)"
            )

    def check(self, start: Start) -> None:
        """Raise `InputError` unless the state has points of the object."""
        check_object(start.state, self.number)

    def __call__(self, outcome: Outcome) -> Reward:
        """Return the negative distance to the goal in meters; success ends the episode."""
        gap = np.linalg.norm(outcome.displacement_m(self.number) - np.array(self.offset_m))
        solved = bool(gap <= self.tolerance_m)
        return Reward(reward=-float(gap), terminated=solved, success=solved)


@no_type_check
@dataclass(frozen=True, kw_only=True)
class GoalImage:
    """Task of matching the last frame to a goal image, by LPIPS."""

    image: UInt8[np.ndarray, "h w 3"]
    """Goal image, of the frame size."""
    threshold: float = 0.1
    """LPIPS (AlexNet) below which the goal is reached."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless the image is RGB uint8."""
        check_video("The goal image, as a clip of one frame,", self.image[None])

    def check(self, start: Start) -> None:
        """Raise `InputError` unless the image has the size of the frames."""
        size = start.camera.height, start.camera.width
        check_video("The goal image", self.image[None], (1, *size))

    def __call__(self, outcome: Outcome) -> Reward:
        """Return the negative LPIPS of the last frame to the goal; reaching it ends the episode."""
        last = outcome.step.clip.frames[-1:]
        distance = _lpips(last, self.image[None])
        solved = distance < self.threshold
        return Reward(reward=-distance, terminated=solved, success=solved)


def _lpips(frame: np.ndarray, goal: np.ndarray) -> float:
    from egosim_jax.evaluation.metrics.lpips import Lpips, frame_distances, load_if_installed

    network = load_if_installed("alex") or Lpips.load("alex")  # load names the missing package
    return float(frame_distances(network, frame, goal)[0])
