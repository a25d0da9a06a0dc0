"""Rewards and termination of episodes, from the outcome of a chunk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, no_type_check, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.simulation.simulator import Step
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
        pose = np.asarray(self.step.state.world_from_object.get(number, np.eye(4)), float)
        before = np.asarray(self.first.world_from_object.get(number, np.eye(4)), float)
        points = self.first.points_m[self.first.object_ids == number]
        if not len(points):
            raise InputError(
                f"Object {number} has no points in the first state: its position is unknown. "
                f"Choose one of {sorted(set(self.first.names))}."
            )
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


def no_reward(outcome: Outcome) -> Reward:
    """Return a reward of 0, for callers that compute their own from the frames."""
    return Reward(reward=0.0)


@dataclass(frozen=True, kw_only=True)
class MoveObject:
    """Task of moving an object by an offset; success is exact in the true world."""

    number: int
    """Id of the object in the state."""
    offset_m: tuple[float, float, float]
    """Target displacement in the world, in meters."""
    tolerance_m: float = 0.02
    """Maximum distance to the goal that counts as success, in meters."""

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

    def __call__(self, outcome: Outcome) -> Reward:
        """Return the negative LPIPS of the last frame to the goal; reaching it ends the episode."""
        last = outcome.step.clip.frames[-1:]
        check_video("The goal image", self.image[None], (1, *last.shape[1:3]))
        distance = _lpips(last, self.image[None])
        solved = distance < self.threshold
        return Reward(reward=-distance, terminated=solved, success=solved)


def _lpips(frame: np.ndarray, goal: np.ndarray) -> float:
    from egosim_jax.evaluation.metrics.lpips import Lpips, frame_distances, load_if_installed

    network = load_if_installed("alex") or Lpips.load("alex")  # load names the missing package
    return float(frame_distances(network, frame, goal)[0])
