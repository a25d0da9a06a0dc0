"""Vector environment of flat numbers, as training libraries take it: Box in, Box out.

A `Skill` says what a policy sees of an episode, and which rows its numbers mean. All episodes are
stepped as one batch, whose clips are generated together. Like the environment below it, it never
resets by itself (`AutoresetMode.DISABLED`): reset by the option `reset_mask`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
from gymnasium import spaces
from gymnasium.vector import VectorWrapper
from gymnasium.vector.utils import batch_space
from jaxtyping import Float, Float32

from egosim_jax.interactive.env.rewards import RewardFn
from egosim_jax.interactive.env.single import RunningEpisode
from egosim_jax.interactive.env.vector import StepReturn, WorldVectorEnv
from egosim_jax.io.bounded import quote
from egosim_jax.types import InputError

MAX_STARTS = 256
"""Maximum number of scenes that are kept, of about 2 MB each."""


@runtime_checkable
class Skill(RewardFn, Protocol):
    """Flat observations and actions of a policy; it is also the reward of an outcome."""

    @property
    def observed(self) -> int:
        """Count of the numbers that a policy sees."""
        ...

    @property
    def acted(self) -> int:
        """Count of the numbers of an action, each from -1 to 1."""
        ...

    def observe(self, running: RunningEpisode) -> Float[np.ndarray, " o"]:
        """Return what a policy sees of an episode."""
        ...

    def rows(
        self, action: Float[np.ndarray, " a"], running: RunningEpisode
    ) -> Float[np.ndarray, "k d"]:
        """Return the rows of the next clip, of the same count in all episodes."""
        ...


class FlatVectorEnv(VectorWrapper):
    """Episodes of a skill in the scenes of some seeds, with float32 boxes.

    Make the environment below with `reward=skill`. Each reset draws its scenes from `scenes`,
    unless it has a seed for each episode. `info["scene"]` has the seeds.
    """

    env: WorldVectorEnv  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, envs: WorldVectorEnv, skill: Skill, *, scenes: Sequence[int]):
        super().__init__(envs)
        if not len(scenes):
            raise InputError("scenes is empty: give the seeds of one scene or more. (scenes)")
        self.skill, self.scenes = skill, np.asarray(scenes)
        self.autoreset_mode = envs.autoreset_mode
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (skill.observed,), np.float32)
        self.single_action_space = spaces.Box(-1, 1, (skill.acted,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._scene = np.zeros(self.num_envs, int)
        self._starts: dict[int, dict[str, Any]] = {}

    def reset(
        self,
        *,
        seed: Any = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Float32[np.ndarray, "n o"], dict[str, Any]]:
        """Begin the episodes of `reset_mask`, or all, in drawn scenes.

        A list of seeds names the scene of each episode; one seed seeds the drawing.
        """
        given = dict(options or {})
        mask = np.asarray(given.pop("reset_mask", np.ones(self.num_envs, bool)), bool)
        if given:
            raise InputError(
                f"There is no reset option {quote(next(iter(given)))}: a skill begins its own "
                "episodes. Choose scenes by a list of seeds. (options)"
            )
        if np.ndim(seed):
            drawn = np.asarray(seed)
        else:
            if seed is not None:
                self.np_random = np.random.default_rng(seed)
            drawn = self.np_random.choice(self.scenes, self.num_envs)
        if drawn.shape != (self.num_envs,):
            raise InputError(
                f"There are {len(drawn)} seeds for {self.num_envs} episodes: give one for each."
            )
        scene = np.where(mask, drawn, self._scene)
        starts = [self._start(int(number)) for number in scene]
        _, info = self.env.reset(
            seed=scene.tolist(), options={"reset_mask": mask, "starts": starts}
        )
        self._scene = scene
        return self._observations(), {**info, "scene": self._scene.copy()}

    def step(self, actions: Float[np.ndarray, "n a"]) -> Any:
        """Run the clip that each action means.

        Numbers beyond -1 and 1 are cut off there, and rows at their bounds: policies explore.
        """
        numbers = np.asarray(actions, float)
        if numbers.shape != self.action_space.shape or not np.isfinite(numbers).all():
            raise InputError(
                f"The actions have shape {numbers.shape}: they must be finite, of shape "
                f"{self.action_space.shape}."
            )
        rows = [
            self.skill.rows(action, running)
            for action, running in zip(np.clip(numbers, -1, 1), self.env.running, strict=True)
        ]
        result: StepReturn = self.env.chunk_step(np.clip(np.stack(rows), *self.env.actions.bounds))
        _, rewards, terminated, truncated, info = result
        about = {**info, "scene": self._scene.copy()}
        return self._observations(), rewards.astype(np.float32), terminated, truncated, about

    def _start(self, seed: int) -> dict[str, Any]:
        """Return the options of a scene, which are kept: a policy comes to a scene many times."""
        if seed not in self._starts:
            start = self.env.backend.start(seed, self.env.actions)
            if len(self._starts) >= MAX_STARTS:
                self._starts.pop(next(iter(self._starts)))
            self._starts[seed] = {"start": start}
        return self._starts[seed]

    def _observations(self) -> Float32[np.ndarray, "n o"]:
        seen = [self.skill.observe(running) for running in self.env.running]
        return np.stack(seen).astype(np.float32)
