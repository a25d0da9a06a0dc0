"""Perception that returns the ground truth, for tests and as an upper bound."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from egosim_jax.geometry import invert
from egosim_jax.perception.pipeline import Observation, Pipeline, find_interactions
from egosim_jax.perception.registry import register
from egosim_jax.types import Action, Clip, InputError, SceneState
from egosim_jax.types.arrays import Poses


@register("oracle")
@dataclass(frozen=True, kw_only=True)
class OracleConfig:
    """Perception that returns the ground truth of each clip and ignores its frames."""

    def build(self, ground_truth: Mapping[int, Observation] | None = None) -> Pipeline:
        """Return the oracle's pipeline; raise `InputError` without ground truth."""
        if not ground_truth:
            raise InputError(
                "Perception pipeline 'oracle' needs ground truth, and none is available here: use "
                "'classical'. (--perception)"
            )
        return Pipeline(stages=(ReadGroundTruth(ground_truth=ground_truth), find_interactions))


@dataclass(frozen=True, kw_only=True)
class ReadGroundTruth:
    """Stage that replaces the observation with the ground truth of the clip."""

    ground_truth: Mapping[int, Observation]
    """Ground truth of each clip, by the step of the state before it."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Return the ground truth of the clip after the state."""
        if state.step not in self.ground_truth:
            raise InputError(
                f"There is no ground truth for the clip after step {state.step}, only after "
                f"{sorted(self.ground_truth)}."
            )
        return self.ground_truth[state.step]


def motions_of(world_from_body: Mapping[int, Poses]) -> dict[int, Poses]:
    """Return the motion of each moving body, relative to the first frame.

    The result does not depend on the choice of the body's axes.
    """
    return {
        number: path @ invert(path[0])
        for number, path in world_from_body.items()
        if not np.array_equal(path, np.broadcast_to(path[0], path.shape))
    }
