"""Backends of environments and sessions: the base of all, and a model's world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from jaxtyping import UInt8

from egosim_jax import configs
from egosim_jax.generation.choose import preview_note
from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.io.digest import fingerprint
from egosim_jax.perception import registry
from egosim_jax.simulation import preview
from egosim_jax.simulation.preview import Preview
from egosim_jax.simulation.simulator import Simulator, UpdateEvery
from egosim_jax.simulation.start import Start
from egosim_jax.simulation.streams import VideoGenerator, chunk_frames
from egosim_jax.types import Cameras, Kind, VideoSpec, View, check_seed
from egosim_jax.worlds.tabletop import start_of_sequence


@dataclass(frozen=True, kw_only=True)
class Backend:
    """Environment backend: a world in which episodes are simulated."""

    video: VideoSpec
    """Length, size and rate of the clips."""

    needs_past: ClassVar[bool] = False
    """True if a simulator depends on all actions since the seed."""

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip; a world that makes clips at once has one chunk."""
        return (self.video.frames,)

    def identity(self) -> dict[str, str]:
        """Return the settings that determine the clips; equal ones can resume a session."""
        raise NotImplementedError

    def start(self, seed: int, spec: ActionSpec) -> Start:
        """Return the start of a seed's episode: the tabletop scene with its first camera."""
        return tabletop_start(seed, spec, self.video)

    def first_frame(
        self, start: Start, camera: Cameras, view: View, kind: Kind
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return the first frame of a further camera after a start, from its view of the state."""
        return preview.without_holes(view)[0]

    def note(self, start: Start) -> str | None:
        """Return a one-line warning about the clips from a start, or None."""
        return None

    def simulator(self, start: Start) -> Simulator:
        """Return the simulator of the clip that follows a start."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class GeneratedWorld(Backend):
    """World of a video generator, with the scenes of the tabletop world."""

    generator: VideoGenerator
    """Generator of the clips, shared by all episodes; a `Batcher` generates them together."""
    perception: str | None = "classical"
    """Perception that updates the state: name and options, or None to keep the first state."""
    trained_on: str | None = None
    """Simulated world whose clips trained the generator (`configs.trained_on`); None if unknown."""
    previews_unknown_scenes: bool = False
    """Previews of scenes that are not of `trained_on`, instead of the generator's clips."""
    update_every: UpdateEvery = "clip"
    """Update of the state after each clip, or after each chunk of a clip."""

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip."""
        return chunk_frames(self.generator) or (self.video.frames,)

    def identity(self) -> dict[str, str]:
        """Return the settings that determine the clips; equal ones can resume a session."""
        return {
            "world": preview.NAME if self.makes_previews else "generated",
            "video": str(self.video),
            "perception": str(self.perception),
            "update_every": self.update_every,
            "generator": fingerprint(self.generator),
            **({"other scenes": preview.NAME} if self.previews_unknown_scenes else {}),
        }

    @property
    def makes_previews(self) -> bool:
        """True if the generator is the preview."""
        return isinstance(self.generator, Preview)

    def note(self, start: Start) -> str | None:
        """Return a warning that clips are previews, or of weights that no such scene trained."""
        if self.makes_previews or self._gets_preview(start):
            return preview_note(instead=not self.makes_previews)
        return configs.scene_warning(self.trained_on, start.state.provenance)

    def simulator(self, start: Start) -> Simulator:
        """Return the simulator of the clip that follows a start."""
        return self._previews if self._gets_preview(start) else self._simulator

    def _gets_preview(self, start: Start) -> bool:
        """Return True if a start gets previews instead of the generator's clips."""
        foreign = configs.scene_warning(self.trained_on, start.state.provenance) is not None
        return foreign and self.previews_unknown_scenes

    @cached_property
    def _previews(self) -> Simulator:
        renderer = self._simulator.renderer
        return replace(self._simulator, generator=Preview(renderer=renderer))

    @cached_property
    def _simulator(self) -> Simulator:
        pipeline = None if self.perception is None else registry.parse(self.perception)
        return Simulator(
            generator=self.generator,
            perception=None if pipeline is None else pipeline.build(),
            fps=self.video.fps,
            update_every=self.update_every,
        )


def tabletop_start(seed: int, spec: ActionSpec, video: VideoSpec) -> Start:
    """Return the start of a seed's tabletop scene, with the neutral prompt."""
    check_seed(seed, name="seed")
    _, camera, first, state = start_of_sequence(seed, spec=video, kind=spec.kind)
    return Start(
        state=state,
        camera=camera,
        prompt=neutral_prompt(spec),
        seed=seed,
        first_frame=first.colors,
    )


def is_of_seed(start: Start) -> bool:
    """Return True if the scene of a start is the tabletop scene of its seed, maybe changed."""
    origin = start.state.provenance
    return origin.get("world") == "tabletop" and origin.get("seed") == str(start.seed)


def neutral_prompt(spec: ActionSpec) -> str:
    """Return a prompt that names no object and no goal: the policy alone decides what happens."""
    side, *others = spec.sides
    if spec.kind == "robot":
        return "The grippers move." if others else "The gripper moves."
    return "The hands move." if others else f"The {side} hand moves."


def preview_info(generator: VideoGenerator) -> dict[str, bool]:
    """Return what `info` says of a step's clip: that it is a preview, if it is one."""
    return {preview.NAME: True} if isinstance(generator, Preview) else {}
