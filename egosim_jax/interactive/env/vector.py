"""Gymnasium vector environment: several episodes whose clips are generated as one batch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, SupportsIndex, cast

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array
from jaxtyping import Bool, Float

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import Backend
from egosim_jax.interactive.env.chunks import observed, straight_path
from egosim_jax.interactive.env.rewards import (
    RewardFn,
    check_reward,
    no_reward,
    reward_of,
)
from egosim_jax.interactive.env.single import (
    CLOSED,
    RunningEpisode,
    check_settings,
    seed_of,
    start_from_options,
    to_options,
)
from egosim_jax.interactive.env.space import observation_space
from egosim_jax.io.bounded import quote
from egosim_jax.runtime.phases import phase, show_phases
from egosim_jax.simulation.rig import MountedCamera
from egosim_jax.types import InputError, check_counts

Seeds = SupportsIndex | Sequence[SupportsIndex | None] | np.ndarray | None
"""Seed of the first episode, or of each episode."""
StepReturn = tuple[
    dict[str, Any],
    Float[np.ndarray, " n"],
    Bool[np.ndarray, " n"],
    Bool[np.ndarray, " n"],
    dict[str, Any],
]


class WorldVectorEnv(VectorEnv):
    """Episodes of a world, stepped together; finished episodes stay idle until reset.

    Each episode steps in its own thread: perception overlaps, and a backend with a `Batcher`
    generates all clips in one program. The option `reset_mask` selects the episodes to reset
    (`AutoresetMode.DISABLED`).
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - Gymnasium declares it so
        "render_modes": [],
        "autoreset_mode": AutoresetMode.DISABLED,
    }
    autoreset_mode = AutoresetMode.DISABLED
    """Mode of `metadata`, where TorchRL looks for it."""

    def __init__(
        self,
        backend: Backend,
        num_envs: int,
        *,
        actions: ActionSpec | None = None,
        observe: tuple[str, ...] = ("frames",),
        reward: RewardFn | str | Sequence[RewardFn | str] = no_reward,
        max_chunks: int = 10,
        cameras: Sequence[MountedCamera] = (),
    ):
        check_counts({"num_envs": num_envs})
        check_settings(actions=actions, observe=observe, max_chunks=max_chunks, cameras=cameras)
        self._cameras = observed(cameras, observe)
        self.num_envs, self.backend, self.actions = num_envs, backend, actions or ActionSpec()
        self._observe, self._max_chunks = tuple(observe), max_chunks
        single = callable(reward) or isinstance(reward, str)
        rewards = [reward] * num_envs if single else list(cast(Sequence[RewardFn | str], reward))
        if len(rewards) != num_envs:
            raise InputError(
                f"{len(rewards)} rewards for {num_envs} episodes: give one, or one for each."
            )
        self._rewards = [reward_of(one) for one in rewards]
        low, high = self.actions.bounds
        self.single_action_space = spaces.Box(low, high, dtype=np.float64)
        self.action_space = batch_space(self.single_action_space, num_envs)
        space = observation_space(backend.video, self.actions, self._observe)
        self.single_observation_space = space
        self.observation_space = batch_space(space, num_envs)
        self._running: list[RunningEpisode | None] = [None] * num_envs
        self._threads = ThreadPoolExecutor(num_envs, thread_name_prefix="episode")

    @property
    def chunk(self) -> int:
        """Maximum number of rows of a chunk."""
        return self.backend.video.frames - 1

    @property
    def running(self) -> list[RunningEpisode]:
        """Episodes in progress. Raises `InputError` before the first reset."""
        begun = [running for running in self._running if running is not None]
        if len(begun) < self.num_envs:
            raise InputError("The environment has no episodes: call reset first.")
        return begun

    def reset(
        self,
        *,
        seed: Seeds = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin the episodes of `reset_mask`, or all; if one cannot begin, none does.

        A single seed seeds episode 0; episode i uses seed + i. The other options are the options of
        `WorldEnv.reset`, for all episodes. `starts` gives one set of options per episode.
        """
        self._check_open()
        given = to_options(options)
        mask = np.asarray(given.pop("reset_mask", np.ones(self.num_envs, bool)), bool)
        starts = given.pop("starts", [given] * self.num_envs)
        seeds = self._seeds(seed)
        if not isinstance(starts, list | tuple):
            raise InputError(f"starts is {quote(starts)}: it must be a list of maps of options.")
        if mask.shape != (self.num_envs,) or {len(starts), len(seeds)} != {self.num_envs}:
            raise InputError(
                f"reset_mask has shape {mask.shape}, starts has {len(starts)} entries and seed "
                f"{len(seeds)}: each must have one entry for each of {self.num_envs} episodes."
            )
        chosen = np.flatnonzero(mask).tolist()
        # all starts are made before any episode changes: one bad option begins none
        with show_phases(), phase(f"makes {len(chosen)} scenes", only_if_long=True):
            begun = [
                start_from_options(
                    self.backend, self.actions, seed=seeds[number], options=starts[number]
                )
                for number in chosen
            ]
        for number, start in zip(chosen, begun, strict=True):
            check_reward(self._rewards[number], start)
        limits = {"max_chunks": self._max_chunks, "cameras": self._cameras}
        running = [
            RunningEpisode(
                self.backend, self.actions, start, reward=self._rewards[number], **limits
            )
            for number, start in zip(chosen, begun, strict=True)
        ]
        for number, episode in zip(chosen, running, strict=True):
            self._running[number] = episode
        with show_phases(), phase("draws the first observations", only_if_long=True):
            return self._observations(), self._infos([running.info() for running in self.running])

    def _seeds(self, seed: Seeds) -> list[int]:
        """Return the seed of each episode; missing seeds are drawn from `np_random`."""
        several = isinstance(seed, list | tuple) or (isinstance(seed, np.ndarray) and seed.ndim > 0)
        numbers: Iterable[Any] = cast(Iterable[Any], seed) if several else [seed]
        given = [seed_of(number) for number in numbers]
        super().reset(seed=next((number for number in given if number is not None), None))
        seeds = [int(self.np_random.integers(2**31)) if n is None else n for n in given]
        return seeds if several else [seeds[0] + number for number in range(self.num_envs)]

    def step(self, actions: Float[np.ndarray, "n d"]) -> StepReturn:
        """Move each episode to a row in a straight line, over a full chunk."""
        self._check_rows(actions)
        frames = self.chunk + 1
        targets = [self.actions.check_row(row) for row in actions]
        rows = [
            straight_path(r.row, target, frames)
            for r, target in zip(self.running, targets, strict=True)
        ]
        return self.chunk_step(np.stack(rows))

    def chunk_step(
        self, actions: Float[np.ndarray, "n k d"], *, prompts: Sequence[str] | None = None
    ) -> StepReturn:
        """Simulate k rows in each episode as one batch (`WorldEnv.chunk_step`).

        If an action is invalid or a step fails, no episode changes. Reset a finished episode first.
        """
        self._check_rows(actions)
        texts = [None] * self.num_envs if prompts is None else prompts
        if not isinstance(texts, list | tuple) or len(texts) != self.num_envs:
            raise InputError(
                f"prompts is {quote(texts)}: it must be a list of one for each of {self.num_envs} "
                "episodes."
            )
        chunks = [
            running.chunk(rows, prompt=prompt)
            for running, rows, prompt in zip(self.running, actions, texts, strict=True)
        ]
        with show_phases(), phase(f"simulates {self.num_envs} chunks", only_if_long=True):
            made = [
                self._threads.submit(running.simulate, chunk)
                for running, chunk in zip(self.running, chunks, strict=True)
            ]
            wait(made)  # all: a step that still runs must not outlive an error of another
        steps, facts = zip(*(future.result() for future in made), strict=True)
        # all are judged before any episode changes: a reward function may raise
        results = [r.judged(step) for r, step in zip(self.running, steps, strict=True)]
        outcomes = [
            running.advance(chunk, step, result, of_step)
            for running, chunk, step, result, of_step in zip(
                self.running, chunks, steps, results, facts, strict=True
            )
        ]
        rewards, terminated, truncated, infos = zip(*outcomes, strict=True)
        flags = np.array(terminated), np.array(truncated)
        return self._observations(), np.array(rewards), *flags, self._infos(infos)

    def _check_open(self) -> None:
        if self.closed:
            raise InputError(CLOSED)

    def _check_rows(self, actions: object) -> None:
        """Raise `InputError` unless each episode can take a step, and has an action."""
        self._check_open()
        given = len(actions) if isinstance(actions, np.ndarray | list | tuple) else 0
        if given != self.num_envs:
            raise InputError(
                f"There are {given} actions for {self.num_envs} episodes: give one for each."
            )
        for number, running in enumerate(self.running):
            if running.ended:
                raise InputError(
                    f"Episode {number} has ended: reset it with the option reset_mask before the "
                    "next step."
                )

    def _observations(self) -> dict[str, Any]:
        seen = [running.observation(self._observe) for running in self.running]
        empty = create_empty_array(self.single_observation_space, self.num_envs)
        batch: Any = concatenate(self.single_observation_space, seen, empty)
        return batch

    def _infos(self, infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
        joined: dict[str, Any] = {}
        for number, info in enumerate(infos):
            joined = self._add_info(joined, info, number)
        return joined

    def close_extras(self, **kwargs: Any) -> None:
        """End the threads."""
        self._threads.shutdown()
