"""The closed loop, one clip at a time.

    state --predict--> motion --render--> view --generate--> clip
    clip --perceive--> perceived --fuse--> state

`Simulator.step` runs these five verbs once, in this order, for any generator. A clip is made chunk
by chunk (`OpenClip`), and its action may be given chunk by chunk too, while earlier frames are
seen. A generator that makes clips at once has one chunk.

`Simulator.step` is pure; `rollout.Rollout` gives it a journal that keeps the result of each phase.
This module imports no jax: any callable from view, action, first frame and seed to frames can be
the generator. Source: EgoSim, equations 1 and 2 and section 3.4.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import reduce
from typing import Any, Literal, cast

import numpy as np
from jaxtyping import UInt8

from egosim_jax.dynamics import predict
from egosim_jax.perception import Perception
from egosim_jax.rendering import POINT_PX, PriorKind, Renderer, reference
from egosim_jax.simulation.actions import join_actions, slice_action, split_action
from egosim_jax.simulation.rig import Rig
from egosim_jax.simulation.streams import (
    ClipStream,
    FrameTimer,
    KeptStream,
    Latency,
    Show,
    VideoGenerator,
    begin,
    chunk_frames,
)
from egosim_jax.simulation.views import OpenViews, Seen
from egosim_jax.state.fuse import fuse
from egosim_jax.state.tsdf import Fusion
from egosim_jax.types import (
    Action,
    Clip,
    InputError,
    Motion,
    Perceived,
    SceneState,
    Shown,
    View,
)
from egosim_jax.types.arrays import RgbImage, Video

Phase = Literal["predict", "render", "generate", "perceive", "fuse"]
"""Name of a phase of a clip."""
Run = Callable[[Phase, Callable[[], Any]], Any]
"""Function that runs a phase of a clip, or returns the result that it kept of it."""
UpdateEvery = Literal["clip", "chunk"]
BY_STEP = ("oracle", "recorded")
"""Perception pipelines that know the clips by the steps of the state."""


@dataclass(frozen=True, kw_only=True)
class Made:
    """Result of the phase `generate`: a clip, and the latency of its frames."""

    clip: Clip
    """Generated clip."""
    latency: Latency
    """Latency of its frames."""
    others: Mapping[str, Seen] = field(default_factory=dict)
    """The clip as the further cameras see it, by name."""


@dataclass(frozen=True, kw_only=True, repr=False)
class Step(Shown):
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
    others: Mapping[str, Seen] = field(default_factory=dict)
    """The clip as the further cameras see it, by name."""


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
    rig: Rig | None = None
    """Further cameras, each with its own clip; only the main camera's clip updates the state."""

    @property
    def renderer(self) -> Renderer:
        """Renderer of the view: the generator's own, or the NumPy reference."""
        return getattr(self.generator, "renderer", reference)

    @property
    def point_px(self) -> int:
        """Side of a point of the view in pixels: the generator's own, or the default."""
        return getattr(self.generator, "point_px", POINT_PX)

    @property
    def prior(self) -> PriorKind:
        """Objects in the view: at rest, or on their predicted paths."""
        return getattr(self.generator, "prior", "static")

    def step(
        self,
        state: SceneState,
        action: Action,
        *,
        seed: int,
        first_frame: RgbImage | None = None,
        frames: Video | None = None,
        run: Run | None = None,
    ) -> Step:
        """Advance the world by one clip. The caller's state is not changed.

        `first_frame` defaults to the first frame of the view. `frames` are the clip's, if it is
        made already. `run` runs the phases, or returns what it kept of them.
        """
        clip = OpenClip(self, state, seed=seed, first_frame=first_frame, run=run)
        if frames is not None:
            clip.keep(frames)
        generated = clip.run("generate", lambda: clip.make(action))
        if not clip.is_made:  # its frames were kept
            clip.replay(generated, action)
        return clip.finish(action)

    def predict(self, state: SceneState, action: Action) -> Motion | None:
        """Predict the motion of the objects; None for a generator of static views."""
        return predict(state, action, fps=self.fps) if self.prior == "predicted" else None

    def render(self, state: SceneState, action: Action, motion: Motion | None = None) -> View:
        """Render the state along the action's camera path, with the objects on their paths."""
        return self.renderer.render(state, action.cameras, point_px=self.point_px, motion=motion)

    def perceive(self, clip: Clip, action: Action, state: SceneState) -> Perceived:
        """Perceive a clip in 3D. The simulator must have a perception."""
        return cast(Perception, self.perception)(clip, action, state)

    def fuse(self, state: SceneState, perceived: Perceived) -> SceneState:
        """Merge a perceived clip into the state."""
        return fuse(state, perceived, fusion=self.fusion)

    def check(self, frames: np.ndarray, view: View) -> Video:
        """Return the generator's frames. Raises `InputError` if their shape is not the view's."""
        if frames.shape != view.frames.shape or frames.dtype != np.uint8:
            raise InputError(
                f"The generator returned {frames.dtype} {frames.shape} for a view of uint8 "
                f"{view.frames.shape}: it must return the same number of frames, of the same size."
            )
        return frames


class OpenClip:
    """Clip whose action is given chunk by chunk: actions in (`put`), frames out (`take`)."""

    def __init__(
        self,
        simulator: Simulator,
        state: SceneState,
        *,
        seed: int,
        first_frame: RgbImage | None = None,
        run: Run | None = None,
    ):
        """Begin a clip; `first_frame` defaults to the first frame of the view."""
        self.simulator, self.state = simulator, state
        self.lengths = chunk_frames(simulator.generator)
        """Frames of each chunk; None: one chunk of any length."""
        self.latencies: list[Latency] = []
        """Latency of each chunk that was taken."""
        self.notes: tuple[str, ...] = ()
        """Words of the perception."""
        self.run: Run = run or (lambda name, make: make())
        """Runs each phase."""
        self._seed, self._first_frame = seed, first_frame
        self._stream: ClipStream | None = None
        self._put: list[tuple[FrameTimer, View, Action]] = []
        self._frames: list[UInt8[np.ndarray, "f h w 3"]] = []
        self._since_update: list[Action] = []
        self._kept: Made | None = None
        self._views = OpenViews(
            simulator.generator,
            renderer=simulator.renderer,
            point_px=simulator.point_px,
            seed=seed,
        )

    @property
    def is_made(self) -> bool:
        """True if chunks of the clip were taken."""
        return bool(self._frames)

    @property
    def by_chunk(self) -> bool:
        """True if the state is updated after each chunk."""
        return self.simulator.update_every == "chunk" and self.simulator.perception is not None

    @property
    def frames(self) -> Video:
        """Frames of the chunks that were taken."""
        return np.concatenate(self._frames)

    @property
    def others(self) -> Mapping[str, Seen]:
        """The chunks that were taken as the further cameras see them, by name."""
        return self._views.seen(self.simulator.fps) if self._kept is None else self._kept.others

    @property
    def latency(self) -> Latency:
        """Latency of the clip so far; it must have a chunk."""
        if self._kept is not None:
            return self._kept.latency
        begun = self._put[0][0].since
        return Latency(
            first_frame_s=self.latencies[0].first_frame_s,
            last_frame_s=self.latencies[-1].last_frame_s + self._put[-1][0].since - begun,
        )

    def make(self, action: Action) -> Made:
        """Generate all chunks of the clip's action."""
        parts = [action] if self.lengths is None else split_action(action, self.lengths)
        for number, chunk in enumerate(parts):
            self.put(chunk)
            if number or self.by_chunk:  # else the next view does not need the frames
                self.take()
        if not self.by_chunk:
            self.take()
        clip = Clip(frames=self.frames, fps=self.simulator.fps)
        return Made(clip=clip, latency=self.latency, others=self.others)

    def replay(self, made: Made, action: Action) -> None:
        """Go through a clip that was made before, in the chunks in which it was made."""
        self.keep(made.clip.frames)
        self._kept = made
        self.simulator = replace(self.simulator, show=None, rig=None)
        self.make(action)

    def keep(self, frames: Video) -> None:
        """Take the frames of a clip that is made already, instead of the generator's."""
        lengths = self.lengths or (len(frames),)
        self._stream = KeptStream(iter(np.split(frames, np.cumsum(lengths)[:-1])))

    def put(self, action: Action, show: Show | None = None) -> None:
        """Begin the next chunk, from the cameras and hands of its frames; do not wait for it.

        `show` replaces the simulator's callback for the chunk.
        """
        simulator = self.simulator
        timer = FrameTimer(show or simulator.show)
        motion = self.run("predict", lambda: self._predict(action))
        view = self.run("render", lambda: simulator.render(self.state, action, motion))
        if self._stream is None:
            image = view.frames[0] if self._first_frame is None else self._first_frame
            self._stream = begin(simulator.generator, image, self._seed)
        self._stream.put(view, action)
        self._put.append((timer, view, action))
        if (rig := simulator.rig) is not None:
            self.run("render", lambda: self._views.put(rig, self.state, action, motion))

    def _predict(self, action: Action) -> Motion | None:
        """Return the predicted motion in the next chunk.

        The hands since the state's last update decide: a hold may have begun in an earlier chunk.
        """
        self._since_update.append(action)
        motion = self.simulator.predict(self.state, reduce(join_actions, self._since_update))
        frames = len(action.joints_m)
        return motion and replace(
            motion,
            paths={
                number: replace(path, motion=path.motion[-frames:])
                for number, path in motion.paths.items()
            },
        )

    def take(self) -> Video:
        """Return the frames of the oldest chunk that was put; show each group as it is decoded."""
        timer, view, action = self._put[len(self._frames)]
        self._views.request()
        groups = []
        for group in cast(ClipStream, self._stream).take():
            if group.dtype != np.uint8:  # before it is shown
                self.simulator.check(group, view)
            timer(group)
            groups.append(group)
        frames = self.simulator.check(np.concatenate(groups), view)
        self.latencies.append(timer.latency)
        self._views.take(self.simulator.check)
        if self.by_chunk:
            self._update_by_chunk(frames, action)
        self._frames.append(frames)
        return frames

    def _update_by_chunk(self, frames: Video, action: Action) -> None:
        """Update the state by a chunk, which is perceived from the last frame before it on."""
        if self._frames:
            before = slice_action(self._put[len(self._frames) - 1][2], -1, None)
            frames = np.concatenate([self._frames[-1][-1:], frames])
            action = join_actions(before, action)
        clip = Clip(frames=frames, fps=self.simulator.fps)
        perceived = self.simulator.perceive(clip, action, self.state)
        self.state = self.simulator.fuse(self.state, perceived)
        self.notes += perceived.notes
        self._since_update = [slice_action(action, -1, None)]

    def finish(self, action: Action) -> Step:
        """Return the step of the clip, once all its chunks are taken; the action is the clip's."""
        simulator, before, run = self.simulator, self.state, self.run
        clip = Clip(frames=self.frames, fps=simulator.fps)
        if self.by_chunk:
            self.state = run("fuse", lambda: before)
        elif simulator.perception is not None:
            perceived = run("perceive", lambda: simulator.perceive(clip, action, before))
            self.state = run("fuse", lambda: simulator.fuse(before, perceived))
            self.notes = perceived.notes
        return Step(
            view=_join_views([view for _, view, _ in self._put]),
            clip=clip,
            state=self.state,
            notes=self.notes,
            latency=self.latency,
            others=self.others,
        )


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
