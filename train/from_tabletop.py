"""Training from scratch on the tabletop world, and on states of a model's own rollouts.

In a closed loop, perception reads the state before a clip from generated frames. Such a state has
their errors and lacks unseen regions. A model that trains only on perfect states never learns to
correct either. `OwnRollouts` yields such states, from which training priors are rendered.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from egosim_jax import configs
from egosim_jax.io.weights import hashes
from egosim_jax.runtime.command import HelpGroups
from egosim_jax.runtime.progress import track
from egosim_jax.train.distributed import stop_if_preempted
from egosim_jax.train.from_scratch import FromScratch
from egosim_jax.types import InputError, SceneState

if TYPE_CHECKING:
    from egosim_jax.simulation.streams import VideoGenerator
    from egosim_jax.worlds.tabletop import TabletopClip

FIRST_TRAINED = 1000
"""Seed of the first training scene; scenes of lower seeds are held out."""


@dataclass(frozen=True, kw_only=True)
class FromTabletop(FromScratch):
    """Train a small model from scratch on scenes of the tabletop world, a quarter with a robot."""

    help_groups: ClassVar[HelpGroups] = {
        "data": (
            "first_scene", "held_out", "black_cloths", "attempts", "rollouts", "rollout_clips",
            "twins",
        ),
        **FromScratch.help_groups,
    }  # fmt: skip
    scenes: int = 1000
    """Number of training scenes, two clips of each."""
    first_scene: int = FIRST_TRAINED
    """Seed of the first training scene. Choose another to train given weights further."""
    held_out: int = 48
    """Number of validation scenes, one clip of each."""
    black_cloths: int = 0
    """Maximum number of black cloths on a table, which look unobserved in a prior."""
    attempts: float = 0.0
    """Share of scenes with a fallible policy and a turning head instead of a script."""
    rollouts: int = 0
    """Number of further scenes, with states of the given weights' own rollouts."""
    rollout_clips: int = 4
    """Number of clips of each of these scenes."""
    twins: bool = False
    """DWM's conditions: static twins and meshes of hands, with human hands only."""

    def __post_init__(self) -> None:
        if self.first_scene < FIRST_TRAINED:
            raise InputError(
                f"Scenes of seeds below {FIRST_TRAINED} are held out: --first-scene must be at "
                f"least {FIRST_TRAINED}, not {self.first_scene}."
            )
        if self.twins and self.rollouts:
            raise InputError(
                f"{self.rollouts} scenes of rollouts cannot have static twins, which show each "
                "clip's own first frame: omit one of them. (--rollouts, --twins)"
            )
        if self.rollouts < 0 or (self.rollouts and self.weights is None):
            raise InputError(
                f"{self.rollouts} scenes of rollouts cannot be made: there must be at least 0, and "
                "weights of the model to roll out. (--rollouts, --weights)"
            )

    def frames(self, out: Path) -> Mapping[str, Path]:
        """Make the clips of all splits."""
        first, last = self.first_scene, self.first_scene + self.scenes
        frames = {
            "train": self._make("train", range(first, last), 2, out),
            "test": self._make("test", range(self.held_out), 1, out),
        }
        if self.rollouts:
            seeds = range(last, last + self.rollouts)
            frames["rollouts"] = self._make("rollouts", seeds, self.rollout_clips, out)
        return frames

    def _make(self, split: str, seeds: range, clips: int, out: Path) -> Path:
        from egosim_jax.worlds.tabletop.dataset import (
            DatasetConfig,
            conditions_of,
            make_shards,
            true_states,
        )

        model = configs.get(self.config)
        prior, hands = ("static", "mesh") if self.twins else conditions_of(model)
        plan = DatasetConfig(
            seeds=tuple(seeds),
            clips=clips,
            spec=model.video,
            kind="human" if self.twins else "mixed",
            black_cloths=self.black_cloths,
            attempts=self.attempts if split == "train" else 0.0,
            prior=prior,
            hands=hands,
            point_px=model.point_px,
        )
        frames = out / "frames" / split
        workers, states = os.cpu_count() or 1, true_states
        if split == "rollouts" and self.weights is not None:
            # One process: the generator uses all cores.
            workers, states = 1, OwnRollouts.of(self.config, self.weights)
        scenes = make_shards(plan, out=frames, workers=workers, grid=model.grid, states=states)
        try:
            for _ in track(scenes, f"making {split}", total=len(seeds)):
                stop_if_preempted(out)
        except BrokenProcessPool:
            stop_if_preempted(out)  # Slurm's SIGTERM ends the workers, too
            raise
        return frames


@dataclass(frozen=True, kw_only=True)
class OwnRollouts:
    """States before each clip of a sequence, in a rollout of a model under the true actions."""

    config: str
    """Name of the model."""
    weights: Path
    """Folder of its weights."""
    digests: Mapping[str, str]
    """Hashes of the weights: a data set cannot be continued with other weights."""
    perceptions: tuple[str, ...] = ("classical", "oracle")
    """Names of the perceptions that update the state; the seed of a scene selects one."""

    @classmethod
    def of(cls, config: str, weights: Path) -> OwnRollouts:
        """Return the rollouts of a weights folder."""
        return cls(config=config, weights=weights, digests=hashes(weights))

    def __call__(self, clips: Sequence[TabletopClip]) -> Iterator[SceneState | None]:
        """Yield None for the first clip, which has its own state, then each clip's first state."""
        from egosim_jax.perception import registry
        from egosim_jax.simulation.simulator import Simulator
        from egosim_jax.worlds.tabletop import to_episode

        yield None
        generator, fps = load_generator(self.config, self.weights)
        episode = to_episode(clips, fps=fps)
        name = self.perceptions[clips[0].seed % len(self.perceptions)]
        simulator = Simulator(
            generator=generator,
            perception=registry.parse(name).build(episode.observations()),
            fps=fps,
        )
        state, image = episode.state, episode.first_frame
        for clip, action in zip(clips[:-1], episode.actions, strict=False):
            seed = 1000 * clip.seed + clip.number
            state = simulator.step(state, action, seed=seed, first_frame=image).state
            image = None
            yield state


@cache
def load_generator(config: str, weights: Path) -> tuple[VideoGenerator, int]:
    """Load a model as a generator of clips, once per process; return it and its frame rate."""
    from egosim_jax.generation.generator import Generator

    return Generator.load(config, weights), configs.get(config).video.fps
