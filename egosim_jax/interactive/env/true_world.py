"""True tabletop world as a backend: clips and states are ground truth."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import ClassVar

import numpy as np
from jaxtyping import UInt8

from egosim_jax.interactive.env.backends import Backend, is_of_seed
from egosim_jax.io.digest import fingerprint
from egosim_jax.perception.oracle import OracleConfig
from egosim_jax.rendering import jitted
from egosim_jax.simulation.actions import all_joints_of
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.simulation.start import Start
from egosim_jax.types import (
    Action,
    Cameras,
    Clip,
    InputError,
    Kind,
    Perceived,
    SceneState,
    View,
)
from egosim_jax.worlds.tabletop import TabletopClip, World, observation_of, start_of_sequence
from egosim_jax.worlds.tabletop.clips import POINT_PX, film, render_scenes
from egosim_jax.worlds.tabletop.scene import Scene
from egosim_jax.worlds.tabletop.world import arms_of

MAX_CACHED_WORLDS = 256
"""Maximum number of cached worlds; without a cache each step repeats its episode from the start."""


@dataclass(frozen=True, kw_only=True)
class TrueWorld(Backend):
    """Backend that executes actions in the tabletop world and returns its ground truth."""

    needs_past: ClassVar[bool] = True
    _changing: threading.Lock = field(
        default_factory=threading.Lock, init=False, repr=False, compare=False
    )
    _worlds: OrderedDict[str, World] = field(
        default_factory=OrderedDict, init=False, repr=False, compare=False
    )

    def identity(self) -> dict[str, str]:
        """Return the size of the clips; nothing else varies."""
        return {"world": "true", "video": str(self.video)}

    def simulator(self, start: Start) -> Simulator:
        """Return the simulator of the clip after a start.

        Raises `InputError` unless the start has a seed's scene and all actions since the seed.
        """
        if not is_of_seed(start) or start.state.step != len(start.past):
            raise InputError(
                "The true world has only the scenes of its seeds, changed by known actions: it "
                f"cannot begin from a state of {dict(start.state.provenance)} at step "
                f"{start.state.step} with {len(start.past)} known actions. Reset it with a seed."
            )
        execution = _Execution(world=self, start=start)
        return Simulator(
            generator=_TrueGenerator(execution=execution),
            perception=_TruePerception(execution=execution),
            fps=self.video.fps,
        )

    def first_frame(
        self, start: Start, camera: Cameras, view: View, kind: Kind
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Return the true first frame of a further camera, without hands."""
        return render_scenes([self.after(start, kind).scene], camera)[0].colors

    def after(self, start: Start, kind: Kind) -> World:
        """Return the world after all past actions of a start."""
        key = f"{start.seed} {kind}"
        keys = [key]
        for action in start.past:  # a chained hash names each prefix of the episode
            key = hashlib.sha256(f"{key} {fingerprint(action)}".encode()).hexdigest()
            keys.append(key)
        count, world = self._longest_cached(keys)
        if world is None:
            scene = start_of_sequence(start.seed, spec=self.video, kind=kind)[0]
            world = World(scene=scene, seed=start.seed)
        for action in start.past[count:]:
            world = world.move(action, joints_m=all_joints_of(action))[1]
        with self._changing:
            self._worlds[keys[-1]] = world
            self._worlds.move_to_end(keys[-1])
            while len(self._worlds) > MAX_CACHED_WORLDS:
                self._worlds.popitem(last=False)
        return world

    def _longest_cached(self, keys: Sequence[str]) -> tuple[int, World | None]:
        """Return the longest cached prefix: its number of actions, and its world."""
        with self._changing:
            for count in reversed(range(len(keys))):
                if (world := self._worlds.get(keys[count])) is not None:
                    return count, world
        return 0, None


@dataclass(kw_only=True)
class _Execution:
    """Execution of one action, shared by the generator and the perception."""

    world: TrueWorld
    start: Start
    _made: tuple[Action, TabletopClip] | None = None
    _moved: tuple[np.ndarray, list[Scene]] | None = None

    def clip(self, action: Action) -> TabletopClip:
        """Return the clip of an action."""
        if self._made is None or self._made[0] is not action:
            world = self.world.after(self.start, action.kind)
            clip, _ = world.execute(action, joints_m=all_joints_of(action))
            self._made = action, clip
        return self._made[1]

    def frames(self, action: Action) -> UInt8[np.ndarray, "f h w 3"]:
        """Return the frames of the first action, or of the same one as another camera sees it."""
        if self._made is None or self._made[0] is action:
            return self.clip(action).frames
        joints = all_joints_of(action)
        if self._moved is None or not np.array_equal(self._moved[0], joints, equal_nan=True):
            world = self.world.after(self.start, action.kind)
            self._moved = joints, world.move(action, joints_m=joints)[0]
        return film(self._moved[1], action.cameras, arms=arms_of(joints, action.kind))

    def fingerprint(self) -> str:
        """Return the content hash of the scene and the past actions."""
        return fingerprint(("tabletop", self.start.seed, self.start.past))


@dataclass(frozen=True, kw_only=True)
class _TrueGenerator:
    """Generator that returns the true frames (`streams.VideoGenerator`)."""

    execution: _Execution
    renderer: ModuleType = jitted
    point_px: int = POINT_PX

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        return self.execution.frames(action)


@dataclass(frozen=True, kw_only=True)
class _TruePerception:
    """Perception that returns the ground truth (`perception.Perception`)."""

    execution: _Execution

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Perceived:
        observation = observation_of(self.execution.clip(action))
        return OracleConfig().build({state.step: observation})(clip, action, state)
