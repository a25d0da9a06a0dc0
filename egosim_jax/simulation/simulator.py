"""The closed loop, one step at a time: render the state, generate a clip, perceive it, fuse it.

    state --render--> view --generate--> clip --perceive--> perceived --fuse--> state

`OpenClip` makes a clip chunk by chunk, and its action may be given chunk by chunk too, while
earlier frames are seen. A generator that makes clips at once has one chunk.

`Simulator.step` is pure; `rollout.Rollout` journals and resumes the same functions. This module
imports no jax: any callable from view, action, first frame and seed to frames can be the generator.
Source: EgoSim, equations 1 and 2 and section 3.4.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal, Protocol, cast, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from egosim_jax.perception import Perception
from egosim_jax.rendering import POINT_PX, Renderer, reference
from egosim_jax.simulation.actions import join_actions, slice_action, split_action
from egosim_jax.state.fuse import fuse
from egosim_jax.state.tsdf import Fusion
from egosim_jax.types import Action, Clip, InputError, SceneState, View

UpdateEvery = Literal["clip", "chunk"]
Show = Callable[[UInt8[np.ndarray, "g h w 3"]], None]
"""Callback for each decoded group of frames."""
BY_STEP = ("oracle", "recorded")
"""Perception pipelines that know the clips by the steps of the state."""


@runtime_checkable
class VideoGenerator(Protocol):
    """Function that generates the video of an action.

    Its attributes `renderer` and `point_px`, if it has them, replace the NumPy renderer and the
    default side of a point in pixels.
    """

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """Generate the frames of a clip, of the view's number and size."""
        ...


@runtime_checkable
class StreamedGenerator(VideoGenerator, Protocol):
    """Generator that yields the first frames of a video before it has the last ones."""

    def stream(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the frames of a clip in order, in groups."""
        ...


@runtime_checkable
class ClipStream(Protocol):
    """Clip that is generated chunk by chunk: conditions in (`put`), frames out (`take`)."""

    def put(self, view: View, action: Action) -> None:
        """Begin the next chunk, from the view and the action of its frames; do not wait for it."""
        ...

    def take(self) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the frames of the oldest chunk that was put, in groups, as they are decoded."""
        ...


@runtime_checkable
class ChunkedGenerator(VideoGenerator, Protocol):
    """Generator whose clips may get the conditions of each chunk once the one before is seen."""

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip."""
        ...

    def begin(self, first_frame: UInt8[np.ndarray, "h w 3"], seed: int) -> ClipStream:
        """Begin a clip."""
        ...


@dataclass(frozen=True, kw_only=True)
class Latency:
    """Seconds from an action to its frames; all latencies compare equal, so equal steps stay so."""

    first_frame_s: float = field(compare=False)
    """Time until the first frames are decoded."""
    last_frame_s: float = field(compare=False)
    """Time until the last frames are decoded."""


@dataclass
class FrameTimer:
    """Callback for each decoded group of frames that measures their latency."""

    show: Show | None = None
    """Callback to call too."""
    since: float = field(default_factory=time.monotonic)
    """Time of the action."""
    times: list[float] = field(default_factory=list)
    """Seconds from the action to each group."""

    def __call__(self, frames: UInt8[np.ndarray, "g h w 3"]) -> None:
        """Note the time, and show the frames."""
        self.times.append(time.monotonic() - self.since)
        if self.show is not None:
            self.show(frames)

    @property
    def latency(self) -> Latency:
        """Latency of the groups so far; there must be one."""
        return Latency(first_frame_s=self.times[0], last_frame_s=self.times[-1])


@dataclass(frozen=True, kw_only=True)
class Step:
    """Result of one step of the simulator."""

    view: View
    """State before the step, seen along the action's camera path."""
    clip: Clip
    """Clip generated from the view and the action."""
    state: SceneState
    """State after the step."""
    notes: tuple[str, ...] = ()
    """Words of the perception: new objects, and what it could not decide."""
    latency: Latency | None = None
    """Latency of the frames; None if the clip was made before."""


@dataclass(frozen=True, kw_only=True)
class Simulator:
    """World simulator with a persistent 3D state."""

    generator: VideoGenerator
    """Generator of the clips."""
    perception: Perception | None
    """Perception that reconstructs the clips in 3D; None keeps the state unchanged."""
    fps: int
    """Frame rate of the clips, in frames per second."""
    fusion: Fusion = field(default_factory=Fusion)
    """Settings of the fusion."""
    show: Show | None = None
    """Callback for each decoded group of frames."""
    update_every: UpdateEvery = "clip"
    """Update of the state after each clip, or after each chunk of a clip."""

    @property
    def renderer(self) -> Renderer:
        """Renderer of the view: the generator's own, or the NumPy reference."""
        return getattr(self.generator, "renderer", reference)

    @property
    def point_px(self) -> int:
        """Side of a point of the view in pixels: the generator's own, or the default."""
        return getattr(self.generator, "point_px", POINT_PX)

    def step(
        self,
        state: SceneState,
        action: Action,
        *,
        seed: int,
        first_frame: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> Step:
        """Advance the world by one clip. The caller's state is not changed.

        `first_frame` defaults to the first frame of the view.
        """
        clip = OpenClip(self, state, seed=seed, first_frame=first_frame)
        ahead = self.update_every == "clip"  # else the next view needs the frames
        for number, part in enumerate(clip.split(action)):
            clip.put(part)
            if number or not ahead:
                clip.take()
        if ahead:
            clip.take()
        return clip.finish(action)

    def update(
        self, state: SceneState, clip: Clip, action: Action
    ) -> tuple[SceneState, tuple[str, ...]]:
        """Perceive a clip and fuse it; return the state after it, and the perception's notes."""
        if self.perception is None:
            return state, ()
        perceived = self.perception(clip, action, state)
        return fuse(state, perceived, fusion=self.fusion), perceived.notes

    def render(self, state: SceneState, action: Action) -> View:
        """Render the state along the action's camera path."""
        return self.renderer.render(state, action.cameras, point_px=self.point_px)

    def generate(
        self,
        view: View,
        action: Action,
        *,
        seed: int,
        first_frame: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> Clip:
        """Generate the clip of an action. Raises `InputError` if its shape is not the view's."""
        image = view.frames[0] if first_frame is None else first_frame
        return Clip(frames=self._frames(view, action, image, seed), fps=self.fps)

    def check(self, frames: np.ndarray, view: View) -> UInt8[np.ndarray, "f h w 3"]:
        """Return the generator's frames. Raises `InputError` if their shape is not the view's."""
        if frames.shape != view.frames.shape or frames.dtype != np.uint8:
            raise InputError(
                f"The generator returned {frames.dtype} {frames.shape} for a view of uint8 "
                f"{view.frames.shape}: it must return the same number of frames, of the same size."
            )
        return frames

    def _frames(
        self, view: View, action: Action, image: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> np.ndarray:
        """Return the generator's frames and show them, in groups if the generator streams."""
        if self.show is None or not isinstance(self.generator, StreamedGenerator):
            frames = self.check(np.asarray(self.generator(view, action, image, seed)), view)
            if self.show is not None:
                self.show(frames)
            return frames
        groups = []
        for frames in self.generator.stream(view, action, image, seed):
            self.show(frames)
            groups.append(frames)
        return self.check(np.concatenate(groups), view)


class OpenClip:
    """Clip whose action is given chunk by chunk: actions in (`put`), frames out (`take`)."""

    def __init__(
        self,
        simulator: Simulator,
        state: SceneState,
        *,
        seed: int,
        first_frame: UInt8[np.ndarray, "h w 3"] | None = None,
    ):
        """Begin a clip; `first_frame` defaults to the first frame of the view."""
        self.simulator, self.state = simulator, state
        self.lengths = chunk_frames(simulator.generator)
        """Frames of each chunk; None: one chunk of any length."""
        self.latencies: list[Latency] = []
        """Latency of each chunk that was taken."""
        self.notes: tuple[str, ...] = ()
        """Words of the perception, if the state is updated after each chunk."""
        self._seed, self._first_frame = seed, first_frame
        self._stream: ClipStream | None = None
        self._put: list[tuple[FrameTimer, View, Action]] = []
        self._frames: list[UInt8[np.ndarray, "f h w 3"]] = []

    def split(self, action: Action) -> list[Action]:
        """Return the actions of the chunks of a clip's action."""
        return [action] if self.lengths is None else split_action(action, self.lengths)

    @property
    def frames(self) -> UInt8[np.ndarray, "f h w 3"]:
        """Frames of the chunks that were taken."""
        return np.concatenate(self._frames)

    def put(self, action: Action, show: Show | None = None) -> None:
        """Begin the next chunk, from the cameras and hands of its frames; do not wait for it.

        `show` replaces the simulator's callback for the chunk.
        """
        simulator = self.simulator
        timer = FrameTimer(show or simulator.show)
        view = simulator.render(self.state, action)
        if self._stream is None:
            image = view.frames[0] if self._first_frame is None else self._first_frame
            self._stream = begin(simulator.generator, image, self._seed)
        self._stream.put(view, action)
        self._put.append((timer, view, action))

    def take(self) -> UInt8[np.ndarray, "f h w 3"]:
        """Return the frames of the oldest chunk that was put; show each group as it is decoded."""
        timer, view, action = self._put[len(self._frames)]
        groups = []
        for group in cast(ClipStream, self._stream).take():
            timer(group)
            groups.append(group)
        frames = self.simulator.check(np.concatenate(groups), view)
        self.latencies.append(timer.latency)
        if self.simulator.update_every == "chunk":
            self._update(frames, action)
        self._frames.append(frames)
        return frames

    def _update(self, frames: UInt8[np.ndarray, "f h w 3"], action: Action) -> None:
        """Update the state by a chunk, which is perceived from the last frame before it on."""
        if self._frames:
            before = slice_action(self._put[len(self._frames) - 1][2], -1, None)
            frames = np.concatenate([self._frames[-1][-1:], frames])
            action = join_actions(before, action)
        clip = Clip(frames=frames, fps=self.simulator.fps)
        self.state, notes = self.simulator.update(self.state, clip, action)
        self.notes += notes

    def finish(self, action: Action) -> Step:
        """Return the step of the clip, once all its chunks are taken; the action is the clip's."""
        clip = Clip(frames=self.frames, fps=self.simulator.fps)
        if self.simulator.update_every == "clip":
            self.state, self.notes = self.simulator.update(self.state, clip, action)
        begun = self._put[0][0].since
        latency = Latency(
            first_frame_s=self.latencies[0].first_frame_s,
            last_frame_s=self.latencies[-1].last_frame_s + self._put[-1][0].since - begun,
        )
        return Step(
            view=_join_views([view for _, view, _ in self._put]),
            clip=clip,
            state=self.state,
            notes=self.notes,
            latency=latency,
        )


def chunk_frames(generator: VideoGenerator) -> tuple[int, ...] | None:
    """Return the frames of each chunk of a generator; None: one chunk of any length."""
    return generator.chunk_frames if isinstance(generator, ChunkedGenerator) else None


def begin(
    generator: VideoGenerator, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
) -> ClipStream:
    """Begin a clip; a generator that makes clips at once gets one chunk."""
    if isinstance(generator, ChunkedGenerator):
        return generator.begin(first_frame, seed)
    return _WholeClip(generator, first_frame, seed)


@dataclass
class _WholeClip:
    """Clip of a generator that makes clips at once, as one chunk (`simulator.ClipStream`)."""

    generator: VideoGenerator
    first_frame: UInt8[np.ndarray, "h w 3"]
    seed: int
    given: list[tuple[View, Action]] = field(default_factory=list)

    def put(self, view: View, action: Action) -> None:
        self.given.append((view, action))

    def take(self) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        ((view, action),) = self.given
        given = view, action, self.first_frame, self.seed
        if isinstance(self.generator, StreamedGenerator):
            yield from self.generator.stream(*given)
        else:
            yield np.asarray(self.generator(*given))


def _join_views(views: list[View]) -> View:
    """Return the view of consecutive frames."""
    names = ("frames", "mask", "depth_m", "object_ids")
    return View(**{name: np.concatenate([getattr(v, name) for v in views]) for name in names})


def check_update_every(
    update_every: UpdateEvery, chunk_frames: tuple[int, ...], name: str, perception: str | None
) -> None:
    """Raise `InputError` if a model or a perception cannot update the state by chunk."""
    if update_every == "clip":
        return
    if len(chunk_frames) == 1:
        raise InputError(
            f"{name} makes clips at once, so a clip has no chunks after which the state could be "
            "updated: give a causal student, or --update-every clip. (--update-every)"
        )
    if (perception or "").split()[:1] in [[pipeline] for pipeline in BY_STEP]:
        raise InputError(
            f"--perception {perception} knows the clips by number, so it cannot update the state "
            "after each chunk: give --update-every clip. (--update-every)"
        )
