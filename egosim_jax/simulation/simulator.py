"""The closed loop, one step at a time: render the state, generate a clip, perceive it, fuse it.

    state --render--> view --generate--> clip --perceive--> perceived --fuse--> state

`Simulator.step` is pure; `rollout.Rollout` journals and resumes the same functions. This module
imports no jax: any callable from view, action, first frame and seed to frames can be the generator.
Source: EgoSim, equations 1 and 2 and section 3.4.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from egosim_jax.perception import Perception
from egosim_jax.rendering import POINT_PX, Renderer, reference
from egosim_jax.state.fuse import fuse
from egosim_jax.state.tsdf import Fusion
from egosim_jax.types import Action, Clip, InputError, SceneState, View


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
    show: Callable[[UInt8[np.ndarray, "g h w 3"]], None] | None = None
    """Callback for each decoded group of frames."""

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
        view = self.render(state, action)
        clip = self.generate(view, action, seed=seed, first_frame=first_frame)
        after, notes = self.update(state, clip, action)
        return Step(view=view, clip=clip, state=after, notes=notes)

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
        frames = np.asarray(self._frames(view, action, image, seed))
        if frames.shape != view.frames.shape or frames.dtype != np.uint8:
            raise InputError(
                f"The generator returned {frames.dtype} {frames.shape} for a view of uint8 "
                f"{view.frames.shape}: it must return the same number of frames, of the same size."
            )
        return Clip(frames=frames, fps=self.fps)

    def _frames(
        self, view: View, action: Action, image: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> np.ndarray:
        """Return the generator's frames and show them, in groups if the generator streams."""
        if self.show is None:
            return self.generator(view, action, image, seed)
        if not isinstance(self.generator, StreamedGenerator):
            frames = self.generator(view, action, image, seed)
            self.show(frames)
            return frames
        groups = []
        for frames in self.generator.stream(view, action, image, seed):
            self.show(frames)
            groups.append(frames)
        return np.concatenate(groups)
