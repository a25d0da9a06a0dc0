"""Backends of environments and sessions: a model's world, or another one with its interface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Protocol, runtime_checkable

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.io.digest import fingerprint
from egosim_jax.perception import registry
from egosim_jax.simulation.simulator import (
    Simulator,
    UpdateEvery,
    VideoGenerator,
    chunk_frames,
)
from egosim_jax.simulation.start import Start
from egosim_jax.types import VideoSpec, check_seed
from egosim_jax.worlds.tabletop import start_of_sequence


@runtime_checkable
class Backend(Protocol):
    """Environment backend: a world in which episodes are simulated."""

    @property
    def video(self) -> VideoSpec:
        """Length, size and rate of the clips."""
        ...

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip; a world that makes clips at once has one chunk."""
        ...

    @property
    def trained_on(self) -> str | None:
        """Simulated world whose clips trained the model; None if unknown or without a model."""
        ...

    needs_past: ClassVar[bool]
    """True if a simulator depends on all actions since the seed."""

    def identity(self) -> dict[str, str]:
        """Return the settings that determine the clips; equal ones can resume a session."""
        ...

    def start(self, seed: int, spec: ActionSpec) -> Start:
        """Return the start of a seed's episode."""
        ...

    def simulator(self, start: Start) -> Simulator:
        """Return the simulator of the clip that follows a start."""
        ...


@dataclass(frozen=True, kw_only=True)
class GeneratedWorld:
    """World of a video generator, with the scenes of the tabletop world."""

    generator: VideoGenerator
    """Generator of the clips, shared by all episodes; a `Batcher` generates them together."""
    video: VideoSpec
    """Length, size and rate of the generator's clips."""
    perception: str | None = "classical"
    """Perception that updates the state: name and options, or None to keep the first state."""
    trained_on: str | None = None
    """Simulated world whose clips trained the generator (`configs.trained_on`); None if unknown."""

    update_every: UpdateEvery = "clip"
    """Update of the state after each clip, or after each chunk of a clip."""

    needs_past: ClassVar[bool] = False

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip."""
        return chunk_frames(self.generator) or (self.video.frames,)

    def identity(self) -> dict[str, str]:
        """Return the size of the clips, the perception, and the generator's content hash."""
        return {
            "world": "generated",
            "video": str(self.video),
            "perception": str(self.perception),
            "update_every": self.update_every,
            "generator": fingerprint(self.generator),
        }

    def start(self, seed: int, spec: ActionSpec) -> Start:
        """Return the seed's tabletop scene with its first camera."""
        return tabletop_start(seed, spec, self.video)

    def simulator(self, start: Start) -> Simulator:
        """Return the simulator, the same one for all clips."""
        return self._simulator

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


def neutral_prompt(spec: ActionSpec) -> str:
    """Return a prompt that names no object and no goal: the policy alone decides what happens."""
    side, *others = spec.sides
    if spec.kind == "robot":
        return "The grippers move." if others else "The gripper moves."
    return "The hands move." if others else f"The {side} hand moves."
