"""Gymnasium environment of one episode."""

from __future__ import annotations

import operator
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, SupportsIndex, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from jaxtyping import Float, UInt8

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import Backend, preview_info
from egosim_jax.interactive.env.chunks import (
    STATE_FIELDS,
    Chunk,
    check_observe,
    last_camera,
    make_chunk,
    observed,
    state_info,
    straight_path,
    timed_step,
    view_of,
)
from egosim_jax.interactive.env.observing import Observer, unobserved_info
from egosim_jax.interactive.env.parts import OpenStep, part_rows
from egosim_jax.interactive.env.rewards import (
    Outcome,
    Reward,
    RewardFn,
    check_reward,
    judge,
    no_reward,
    reward_of,
)
from egosim_jax.interactive.env.space import FAR_M, STATE_POINTS, observation_space
from egosim_jax.interactive.env.validity import validity
from egosim_jax.io.bounded import quote
from egosim_jax.runtime.phases import phase, show_phases
from egosim_jax.simulation.episode import Episode
from egosim_jax.simulation.rig import MountedCamera, check_cameras
from egosim_jax.simulation.simulator import Step
from egosim_jax.simulation.start import Start, check_size
from egosim_jax.state import snapshot
from egosim_jax.types import InputError, SceneState, View, check_seed

OPTIONS = ("start", "episode", "state", "prompt")
"""Options of `reset`."""
CLOSED = "The environment is closed: make a new one."


def check_settings(
    *, actions: Any = None, observe: Any = (), max_chunks: Any = 1, cameras: Any = ()
) -> None:
    """Raise `InputError` for settings that an environment cannot have."""
    if isinstance(observe, str):
        raise InputError(
            f"observe is the text {observe!r:.40}: give a tuple of names, such as ('frames',)."
        )
    if actions is not None and not isinstance(actions, ActionSpec):
        raise InputError(
            f"actions is {actions!r:.40}: it must be an ActionSpec, such as "
            "ActionSpec(layout='wrist'). (actions)"
        )
    if type(max_chunks) is not int or max_chunks < 1:
        raise InputError(
            f"max_chunks is {max_chunks!r:.40}: it must be a whole number of at least 1."
        )
    check_observe(observe, check_cameras(cameras, (actions or ActionSpec()).sides))


def start_from_options(
    backend: Backend, spec: ActionSpec, *, seed: int, options: Mapping[str, Any] | None
) -> Start:
    """Return the start of a reset: the seed's scene, unless an option replaces it.

    `start` is a `Start`, `episode` an `Episode` or its path. `state` is a `SceneState` or its
    folder, seen by the seed's camera. `prompt` replaces the prompt.
    """
    given = to_options(options)
    if unknown := sorted(given.keys() - set(OPTIONS)):
        raise InputError(
            f"There is no reset option {unknown[0]!r:.40}: choose from {', '.join(OPTIONS)}."
        )
    prompt = given.pop("prompt", None)
    if len(given) > 1:
        raise InputError(
            f"The options {', '.join(sorted(given))} are mutually exclusive: give one."
        )
    if (start := given.get("start")) is None:
        if (episode := given.get("episode")) is not None:
            episode = episode if isinstance(episode, Episode) else Episode.load(Path(episode))
            start = Start.of(episode, seed=seed)
        else:
            start = backend.start(seed, spec)
            if (state := given.get("state")) is not None:
                state = state if isinstance(state, SceneState) else snapshot.load(Path(state))
                start = replace(start, state=state, first_frame=None)
    check_size(start, backend.video)
    if start.row is not None:
        _check_row(start.row, spec)
    return start if prompt is None else replace(start, prompt=str(prompt))


def _check_row(row: np.ndarray, spec: ActionSpec) -> None:
    try:
        spec.check(np.asarray(row)[None], max_rows=1)
    except InputError as error:
        raise InputError(
            f"The row of the start does not match this environment's ActionSpec: {error} Make the "
            "start with the same ActionSpec, or without a row. (start)"
        ) from error


def to_options(options: object) -> dict[str, Any]:
    """Return the options of a reset. Raises `InputError` unless they are a map with text keys."""
    given = {} if options is None else options
    if not isinstance(given, Mapping) or not all(isinstance(key, str) for key in given):
        raise InputError(
            f"options is {quote(given)}: it must be a map from names to values, such as "
            f"{', '.join(OPTIONS)}."
        )
    return dict(given)


def seed_of(seed: object) -> int | None:
    """Return a seed as Python's integer, or None. Raises `InputError` for any other value."""
    if seed is None:
        return None
    try:
        chosen = operator.index(cast(SupportsIndex, seed))
    except TypeError:
        raise InputError(
            f"seed is {quote(seed)}: it must be a whole number, or in a vector environment a list "
            "of one for each episode."
        ) from None
    check_seed(chosen, name="seed")
    return chosen


class RunningEpisode:
    """Episode in progress, with its position and last step."""

    def __init__(
        self,
        backend: Backend,
        actions: ActionSpec,
        start: Start,
        *,
        reward: RewardFn,
        max_chunks: int,
        cameras: tuple[MountedCamera, ...] = (),
    ):
        self.backend, self.actions, self.start, self.now = backend, actions, start, start
        self.observer = Observer(backend=backend, actions=actions, cameras=cameras)
        self._first_frames = self.observer.first_frames(start)
        self._reward, self._max_chunks, self.ended = reward, max_chunks, False
        self.camera = start.camera
        self.last: Step | None = None
        if note := backend.note(start):
            warnings.warn(note, stacklevel=3)

    @property
    def row(self) -> Float[np.ndarray, " d"]:
        """Last row of hands and camera."""
        return self.actions.rest if self.now.row is None else self.now.row

    @property
    def chunks(self) -> int:
        """Number of chunks since the reset."""
        return self.now.steps - self.start.steps

    def chunk(self, rows: object, *, prompt: str | None = None) -> Chunk:
        """Return the next chunk; a hand out of view becomes missing.

        Raises `InputError` for invalid rows and for cameras that the state does not allow.
        """
        video = self.backend.video
        return make_chunk(self.actions, rows, start=self.now, video=video, prompt=prompt)

    def simulate(self, chunk: Chunk) -> tuple[Step, dict[str, Any]]:
        """Return the step of a chunk and its metadata, without changing the episode."""
        now = self.now
        step, timing = timed_step(
            self.observer.on(self.backend.simulator(now), chunk.rows),
            now.state,
            chunk.action,
            seed=now.seed + now.steps + 1,
            first_frame=now.first_frame,
        )
        return step, {**self.facts(chunk, step), "timing": timing}

    def open(self, prompt: str | None) -> OpenStep:
        """Begin the next step, whose rows are given part by part."""
        return OpenStep(self.backend, self.actions, self.now, prompt, self.observer)

    def facts(self, chunk: Chunk, step: Step) -> dict[str, Any]:
        """Return the metadata of a step of a chunk."""
        now = self.now
        simulator = self.backend.simulator(now)
        return {
            **chunk.info(self.actions),
            **preview_info(simulator.generator),
            "notes": list(step.notes),
            **validity(now.state, step, chunk.action, simulator.renderer),
            **unobserved_info(step),
        }

    def judged(self, step: Step) -> Reward:
        """Return the reward of a step, without changing the episode."""
        return judge(self._reward, Outcome(first=self.start.state, step=step))

    def advance(
        self, chunk: Chunk, step: Step, result: Reward, facts: dict[str, Any]
    ) -> tuple[float, bool, bool, dict[str, Any]]:
        """Move past the step of a chunk; return reward, termination, truncation and `info`."""
        kept = chunk.action if self.backend.needs_past else None
        self.last, self.now = step, self.now.after(step.state, chunk.rows[-1], kept)
        self.camera = last_camera(chunk.action)
        truncated = self.chunks >= self._max_chunks and not result.terminated
        self.ended = result.terminated or truncated
        info = {**self.info(), **facts, "success": result.success}
        return result.reward, result.terminated, truncated, info

    def info(self) -> dict[str, Any]:
        """Return the number of the last chunk, the hash of the state, and its objects."""
        return {"chunk": self.chunks, **state_info(self.now.state)}

    def frames(self) -> UInt8[np.ndarray, "f h w 3"]:
        """Return the frames of the last chunk; before the first chunk, the first frame repeated."""
        if self.last is not None:
            return self.last.clip.frames
        first = self.start.first_frame
        if first is None:
            first = self._view().frames[0]
        return np.repeat(first[None], self.backend.video.frames, axis=0)

    def frames_of(self, camera: str) -> UInt8[np.ndarray, "f h w 3"]:
        """Return what `frames` does, as a further camera sees it."""
        if self.last is not None:
            return self.last.others[camera].clip.frames
        return np.repeat(self._first_frames[camera][None], self.backend.video.frames, axis=0)

    def _view(self) -> View:
        return view_of(self.backend.simulator(self.now), self.now.state, self.camera)

    def observation(self, observe: tuple[str, ...]) -> dict[str, Any]:
        """Return the row and the requested observations."""
        seen: dict[str, Any] = {"row": self.row.copy()}
        if "frames" in observe:
            seen["frames"] = self.frames().copy()
        if "depth" in observe:
            seen["depth"] = np.minimum(self._view().depth_m[0], np.float32(FAR_M))
        for name in observe:
            camera, _, what = name.partition(".")
            if what == "frames":
                seen[name] = self.frames_of(camera).copy()
            elif what:
                now = self.now
                depth = self.observer.depth(camera, now, now.state, self.camera, self.row)
                seen[name] = np.minimum(depth, np.float32(FAR_M))
        if "keypoints" in observe:
            seen["keypoints"] = self.actions.joints(self.row[None])[0].copy()
        if "state" in observe:
            state = self.now.state
            # a space has a fixed shape: sample evenly, with repeats in a small state
            chosen = np.linspace(0, len(state.points_m) - 1, STATE_POINTS).astype(int)
            seen["state"] = {name: getattr(state, name)[chosen] for name in STATE_FIELDS}
        return seen


class WorldEnv(gymnasium.Env):
    """Environment of one episode, stepped by chunks of action rows."""

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 8}  # noqa: RUF012

    def __init__(
        self,
        backend: Backend,
        *,
        actions: ActionSpec | None = None,
        observe: tuple[str, ...] = ("frames",),
        reward: RewardFn | str = no_reward,
        max_chunks: int = 10,
        render_mode: str | None = None,
        cameras: Sequence[MountedCamera] = (),
    ):
        check_settings(actions=actions, observe=observe, max_chunks=max_chunks, cameras=cameras)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise InputError(
                f"render_mode is {render_mode!r:.40}: it must be 'rgb_array' or None. The page of "
                "`egosim play` shows an episode in a browser."
            )
        self.backend, self.actions = backend, actions or ActionSpec()
        self.metadata = {**self.metadata, "render_fps": backend.video.fps}
        self.render_mode = render_mode
        self._observe, self._max_chunks = tuple(observe), max_chunks
        self._reward, self._cameras = reward_of(reward), observed(cameras, observe)
        low, high = self.actions.bounds
        self.action_space = spaces.Box(low, high, dtype=np.float64)
        self.observation_space = observation_space(backend.video, self.actions, self._observe)
        self._running: RunningEpisode | None = None
        self._open: OpenStep | None = None
        self._closed = False

    @property
    def chunk(self) -> int:
        """Maximum number of rows of a chunk."""
        return self.backend.video.frames - 1

    @property
    def parts(self) -> tuple[int, ...]:
        """Number of rows of each part of a clip, for `part_step`."""
        return part_rows(self.backend.chunk_frames)

    @property
    def running(self) -> RunningEpisode:
        """Episode in progress. Raises `InputError` before the first reset."""
        if self._running is None:
            raise InputError("The environment has no episode: call reset first.")
        return self._running

    def reset(
        self, *, seed: SupportsIndex | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Begin an episode from a seed, or from the options of `start_from_options`."""
        self._check_open()
        given = seed_of(seed)
        super().reset(seed=given)
        chosen = int(self.np_random.integers(2**31)) if given is None else given
        with show_phases(), phase("makes the scene", only_if_long=True):
            start = start_from_options(self.backend, self.actions, seed=chosen, options=options)
        check_reward(self._reward, start)
        limits: dict[str, Any] = {"reward": self._reward, "max_chunks": self._max_chunks}
        limits["cameras"] = self._cameras
        self._running = RunningEpisode(self.backend, self.actions, start, **limits)
        self._open = None
        return self.running.observation(self._observe), self.running.info()

    def step(
        self, action: Float[np.ndarray, " d"]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Move to a row in a straight line, over a full chunk."""
        target = self.actions.check_row(action)
        return self.chunk_step(straight_path(self.running.row, target, self.chunk + 1))

    def chunk_step(
        self, actions: Float[np.ndarray, "k d"], *, prompt: str | None = None
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Simulate 1 to `chunk` rows, one per frame, and hold the last row until the chunk ends.

        `info` has the chunk number, padded frames, hidden hands, hash of the state, names and poses
        of the objects, seconds of each phase, `validity`, `object_validity` with the object that it
        is of, and `success`.
        """
        running = self._continued()
        chunk = running.chunk(actions, prompt=prompt)
        self._open = None
        with show_phases(), phase(f"simulates chunk {running.chunks + 1}", only_if_long=True):
            made = running.simulate(chunk)
        return self._advance(chunk, *made)

    def part_step(
        self, actions: Float[np.ndarray, "k d"], *, prompt: str | None = None
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Simulate the rows of the next part of a clip (`parts`), and hold the last row until then.

        Before the last part, the reward is 0, the observed frames hold the last one, the state is
        the clip's first, and `info` has the part and its latency. The first part's prompt counts.
        """
        running = self._continued()
        if self._open is None:
            self._open = running.open(prompt)
        step = self._open
        try:
            with show_phases(), phase(f"simulates part {step.done + 1}", only_if_long=True):
                step.step(actions)
        except FloatingPointError:
            self._open = None  # no part of this clip can follow
            raise
        about = {"part": step.done, "timing": step.latency}
        if step.left:
            seen = running.observation(self._observe)
            if "frames" in seen:
                missing = self.backend.video.frames - len(step.frames)
                seen["frames"] = np.pad(step.frames, ((0, missing), *[(0, 0)] * 3), mode="edge")
            for camera in self._cameras:
                if (name := f"{camera.name}.frames") in seen:
                    frames = step.frames_of(camera.name)
                    missing = self.backend.video.frames - len(frames)
                    seen[name] = np.pad(frames, ((0, missing), *[(0, 0)] * 3), mode="edge")
            seen["row"] = step.row.copy()
            if "keypoints" in seen:
                seen["keypoints"] = self.actions.joints(step.row[None])[0]
            return seen, 0.0, False, False, {**running.info(), **about}
        self._open = None
        chunk, made = step.finish()
        return self._advance(chunk, made, {**running.facts(chunk, made), **about})

    def _continued(self) -> RunningEpisode:
        """Return the episode. Raises `InputError` if it has ended."""
        self._check_open()
        if self.running.ended:
            raise InputError("The episode has ended: reset it before the next step.")
        return self.running

    def _advance(
        self, chunk: Chunk, step: Step, facts: dict[str, Any]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Move the episode past a step, and return its result."""
        outcome = self.running.advance(chunk, step, self.running.judged(step), facts)
        return self.running.observation(self._observe), *outcome

    def _check_open(self) -> None:
        if self._closed:
            raise InputError(CLOSED)

    def close(self) -> None:
        """Refuse further resets and steps."""
        self._closed = True

    def render(self) -> UInt8[np.ndarray, "h w 3"] | None:
        """Return the last frame."""
        return self.running.frames()[-1] if self.render_mode == "rgb_array" else None
