"""Rewards and ends of episodes: functions of the outcome of a chunk."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, no_type_check, runtime_checkable

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.simulation.simulator import Step
from egosim_jax.types import InputError, SceneState, check_video


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Result of a chunk, and the state in which the episode began."""

    first: SceneState
    """State at the start of the episode."""
    step: Step
    """View, clip and state of the chunk."""

    def displacement_m(self, number: int) -> Float[np.ndarray, " 3"]:
        """Return how far the middle of an object has moved since the start, in meters."""
        pose = np.asarray(self.step.state.world_from_object.get(number, np.eye(4)), float)
        before = np.asarray(self.first.world_from_object.get(number, np.eye(4)), float)
        points = self.first.points_m[self.first.object_ids == number]
        if not len(points):
            raise InputError(
                f"Object {number} has no points in the first state: its place is not known. Choose "
                f"one of {sorted(set(self.first.names))}."
            )
        middle = np.append(points.astype(float).mean(axis=0), 1)
        return (pose @ np.linalg.inv(before) @ middle - middle)[:3]


@dataclass(frozen=True, kw_only=True)
class Reward:
    """Value of a chunk."""

    reward: float
    """Reward of the chunk."""
    terminated: bool = False
    """End of the episode, such as a solved task."""
    success: bool = False
    """Task is solved in the state after the chunk."""


@runtime_checkable
class RewardFn(Protocol):
    """Function that values the outcome of a chunk."""

    def __call__(self, outcome: Outcome) -> Reward:
        """Return reward and end."""
        ...


def no_reward(outcome: Outcome) -> Reward:
    """Return 0: the caller values the frames."""
    return Reward(reward=0.0)


@dataclass(frozen=True, kw_only=True)
class MoveObject:
    """Task of moving an object by an offset; in the true world its success is exact."""

    number: int
    """Id of the object in the state."""
    offset_m: tuple[float, float, float]
    """Displacement that is asked for, in the world, in meters."""
    tolerance_m: float = 0.02
    """Largest distance to the goal that counts as success, in meters."""

    def __call__(self, outcome: Outcome) -> Reward:
        """Return minus the distance to the goal in meters; success ends the episode."""
        gap = np.linalg.norm(outcome.displacement_m(self.number) - np.array(self.offset_m))
        solved = bool(gap <= self.tolerance_m)
        return Reward(reward=-float(gap), terminated=solved, success=solved)


@no_type_check
@dataclass(frozen=True, kw_only=True)
class GoalImage:
    """Task of making the last frame look like an image, by LPIPS."""

    image: UInt8[np.ndarray, "h w 3"]
    """Image of the goal, as large as the frames."""
    threshold: float = 0.1
    """LPIPS of AlexNet below which the goal counts as reached."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless the image is RGB of uint8."""
        check_video("The goal image, as a clip of one,", self.image[None])

    def __call__(self, outcome: Outcome) -> Reward:
        """Return minus LPIPS of the last frame to the goal; a reached goal ends the episode."""
        last = outcome.step.clip.frames[-1:]
        check_video("The goal image", self.image[None], (1, *last.shape[1:3]))
        distance = _lpips(last, self.image[None])
        return Reward(
            reward=-distance,
            terminated=distance < self.threshold,
            success=distance < self.threshold,
        )


def _lpips(frame: np.ndarray, goal: np.ndarray) -> float:
    from egosim_jax.evaluation.metrics.lpips import Lpips, frame_distances, load_if_installed

    network = load_if_installed("alex") or Lpips.load("alex")  # which names the missing package
    return float(frame_distances(network, frame, goal)[0])
