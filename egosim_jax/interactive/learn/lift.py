"""Skill of lifting: the hand reaches for a place, closes there, and rises.

A policy sees where an object is and how large, and says where to pinch, how far to close, and how
to turn the hand. One clip is one episode.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from egosim_jax.interactive.env.action_spec import REST, ActionSpec
from egosim_jax.interactive.env.rewards import Outcome, Reward
from egosim_jax.interactive.env.single import RunningEpisode
from egosim_jax.types import InputError, SceneState
from egosim_jax.worlds.tabletop.hands import pinch

MIDDLE_M, REACH_M = np.array([0.0, 0.25, 0.06]), np.array([0.25, 0.2, 0.06])
"""Middle and half size of the box in which a hand pinches, in meters in the world."""
TURN, PITCH = 0.6, -0.5
"""Largest turn of the hand around z, and its turn around x: the fingers point down (radians)."""
BEFORE_M, RISE_M = np.array([0.0, -0.08, 0.04]), np.array([0.0, 0.0, 0.1])
"""Offsets from the pinched place before the hand closes, and after, in meters."""
TIMES = (0.0, 0.3, 0.45, 0.6, 1.0)
"""Shares of the clip at which the hand is at rest, before the place, there, closed, and risen."""
MAX_SIZE_M = 0.11
"""Largest extent of an object that a hand takes, in meters: furniture is larger."""


@dataclass(frozen=True, kw_only=True)
class Lift:
    """Lift the object that is nearest to the resting hand; it is also the reward."""

    height_m: float = 0.05
    """Rise of the object's center that counts as success, in meters."""

    @property
    def observed(self) -> int:
        """Count of the numbers of a place and a size."""
        return 6

    @property
    def acted(self) -> int:
        """Count of the numbers of an action: a place, how far the hand closes, and its turn."""
        return 5

    def observe(self, running: RunningEpisode) -> Float[np.ndarray, " 6"]:
        """Return place and size of the object at the start, each about from -1 to 1."""
        return self.see(running.start.state)

    def see(self, state: SceneState) -> Float[np.ndarray, " 6"]:
        """Return the observation of the first state of an episode."""
        center_m, size_m = _shape(state, self.target(state))
        return np.concatenate([(center_m - MIDDLE_M) / REACH_M, size_m / MAX_SIZE_M])

    def rows(
        self, action: Float[np.ndarray, " 5"], running: RunningEpisode
    ) -> Float[np.ndarray, "k 7"]:
        """Return the rows that pinch a place and rise."""
        frames = running.backend.video.frames
        return self.path(action, running.row, running.actions, frames=frames)

    def path(
        self, action: np.ndarray, row: np.ndarray, spec: ActionSpec, *, frames: int
    ) -> Float[np.ndarray, "k 7"]:
        """Return the rows after one row, of a clip with a number of frames."""
        if spec.layout != "wrist" or len(spec.sides) != 1 or spec.camera:
            raise InputError(
                f"A lift cannot act by rows of {spec.about}: it needs the wrist of one hand "
                "without a camera, which is the default. (actions)"
            )
        place_m, closure = MIDDLE_M + REACH_M * action[:3], float(action[3] + 1) / 2
        keys = [
            row,
            *(
                _row(spec, place_m + offset_m, closure=closed, turn=TURN * float(action[4]))
                for offset_m, closed in ((BEFORE_M, 0.0), (0, 0.0), (0, closure), (RISE_M, closure))
            ),
        ]
        times, moments = np.array(TIMES) * (frames - 1), np.arange(1, frames)
        return np.transpose([np.interp(moments, times, column) for column in np.transpose(keys)])

    def __call__(self, outcome: Outcome) -> Reward:
        """Return the rise as a share of `height_m`, from 0 to 1, and end the episode."""
        risen_m = outcome.displacement_m(self.target(outcome.first))[2]
        share = float(np.clip(risen_m / self.height_m, 0, 1))
        return Reward(reward=share, terminated=True, success=bool(risen_m >= self.height_m))

    def target(self, state: SceneState) -> int:
        """Return the id of the object that the hand takes. Raises `InputError` without one."""
        rest, away_m = np.array(REST[:2]), {}
        for number in np.unique(state.object_ids[state.object_ids > 0]).tolist():
            center_m, size_m = _shape(state, number)
            if size_m.max() <= MAX_SIZE_M:
                away_m[number] = float(np.linalg.norm(center_m[:2] - rest))
        if not away_m:
            raise InputError(
                f"A scene has no object of at most {100 * MAX_SIZE_M:g} cm, which a hand could "
                "lift: choose other scenes. (scenes)"
            )
        return min(away_m, key=away_m.__getitem__)


def _shape(state: SceneState, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return center and size of an object's points, in meters."""
    points = state.points_m[state.object_ids == number].astype(float)
    return points.mean(axis=0), np.ptp(points, axis=0)


def _row(
    actions: ActionSpec, place_m: np.ndarray, *, closure: float, turn: float
) -> Float[np.ndarray, " 7"]:
    """Return the row of a hand whose fingertips pinch a place."""
    row = np.array([0, 0, 0, PITCH, 0, turn, closure])
    pinched, _ = pinch(actions.joints(row[None])[0, 0])
    row[:3] = place_m - pinched
    return row
