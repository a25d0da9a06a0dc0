"""Datasets of the tabletop world: shards rendered in parallel, resumable per scene."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from egosim_jax.configs.model import ModelConfig
from egosim_jax.data.clips import write_clips
from egosim_jax.data.manifest import MANIFEST, read_manifest
from egosim_jax.data.pack import triplet_record
from egosim_jax.data.records import from_bytes, to_bytes
from egosim_jax.data.shards import ShardWriter, gather
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.run import open_folder
from egosim_jax.runtime.processes import run_in_processes
from egosim_jax.types import (
    WAN_GRID,
    InputError,
    Kind,
    SceneState,
    VideoGrid,
    VideoSpec,
    check_counts,
    check_seed,
)
from egosim_jax.worlds.tabletop.attempts import make_attempts
from egosim_jax.worlds.tabletop.clips import (
    POINT_PX,
    HandsName,
    PriorName,
    TabletopClip,
    state_after,
    to_triplet,
)
from egosim_jax.worlds.tabletop.sequence import make_sequence

States = Callable[[Sequence[TabletopClip]], Iterable[SceneState | None]]
"""Function from a sequence's clips to the states of their priors; None: the clip's own state."""


@dataclass(frozen=True, kw_only=True)
class DatasetConfig:
    """Settings of a tabletop dataset; equal settings give equal shards."""

    seeds: tuple[int, ...]
    """Seeds of the scenes."""
    clips: int
    """Consecutive clips of each scene; each starts from the state after the clip before."""
    spec: VideoSpec
    """Length and size of the clips."""
    kind: Kind | Literal["mixed"]
    """Human hands or a robot gripper; mixed: the gripper where the seed is a multiple of four."""
    black_cloths: int = 0
    """Maximum number of black cloths on a table, which look like holes of a prior."""
    attempts: float = 0.0
    """Fraction of the scenes in which a policy may fail and the head turns (`attempts.py`)."""
    prior: PriorName = "state"
    """Rendering of the scene: points of the state, or the ray-cast scene of the first frame."""
    hands: HandsName = "skeleton"
    """Rendering of the hands: skeletons, shaded meshes, or the meshes' binary mask."""
    point_px: int = POINT_PX
    """Side of the points of a rendered prior in pixels; must be the model's."""
    fixed_camera: bool = False
    """True: the camera keeps its pose of the first frame."""

    def kind_of(self, seed: int) -> Kind:
        """Return the kind of hands of a scene."""
        if self.kind == "mixed":
            return "human" if seed % 4 else "robot"
        return self.kind

    def clips_of(self, seed: int) -> Iterator[TabletopClip]:
        """Return the clips of a scene, which are rendered one by one."""
        settings: dict[str, Any] = {
            "spec": self.spec, "clips": self.clips, "kind": self.kind_of(seed),
            "black_cloths": self.black_cloths,
        }  # fmt: skip
        if self.attempts and np.random.default_rng([seed, 3]).random() < self.attempts:
            return make_attempts(seed, **settings)
        return make_sequence(seed, fixed_camera=self.fixed_camera, **settings)

    def __post_init__(self) -> None:
        """Raise `InputError` if the dataset would be empty, or a setting is out of range."""
        if not self.seeds or self.clips < 1:
            raise InputError(
                f"The dataset is empty: it has {len(self.seeds)} scenes of {self.clips} clips; "
                "both must be at least 1. (--scenes, --clips)"
            )
        check_seed(min(self.seeds))
        check_counts({"--point-px": self.point_px})
        if not 0 <= self.attempts <= 1:
            raise InputError(
                f"{self.attempts:g} is not a fraction of the scenes: it must be between 0 and 1. "
                "(--attempts)"
            )
        if self.attempts and self.fixed_camera:
            raise InputError(
                "A camera cannot be fixed in attempts, where the head turns: omit one of the two. "
                "(--attempts, --fixed-camera)"
            )
        if self.hands != "skeleton" and self.kind != "human":
            raise InputError(
                f"Hands of kind {self.kind} have no {self.hands}: only human hands have meshes. "
                "Use --kind human or --hands skeleton. (--kind, --hands)"
            )


def conditions_of(config: ModelConfig) -> tuple[PriorName, HandsName]:
    """Return the renderings of scene and hands in a model's conditions."""
    if config.layout.mask_packing == "observed":
        return "static", "mesh"
    return "predicted" if config.prior == "predicted" else "state", "skeleton"


def write_scenes(
    folder: Path,
    seeds: Iterable[int],
    *,
    spec: VideoSpec,
    kind: Kind,
    prior: PriorName = "state",
    hands: HandsName = "skeleton",
) -> Path:
    """Write the first clip of each seed as files in EgoSim's layout; return their metadata.csv."""
    clips = (next(make_sequence(seed, spec=spec, kind=kind)) for seed in seeds)
    triplets = (to_triplet(clip, prior=prior, hands=hands) for clip in clips)
    return write_clips(folder, triplets, fps=spec.fps)


def true_states(clips: Sequence[TabletopClip]) -> Iterator[SceneState | None]:
    """Yield None for the first clip, then its state with the ground-truth motion of its objects."""
    state = None
    for clip in clips:
        yield state
        state = state_after(clip, state or clip.state)


def make_shards(
    config: DatasetConfig,
    *,
    out: Path,
    workers: int,
    grid: VideoGrid = WAN_GRID,
    states: States = true_states,
) -> Iterator[int]:
    """Write the shards of a dataset; yield each seed when its scene is done.

    Finished scenes are stored in `out`/parts: the same call resumes an interrupted one. The
    manifest records the latent `grid`, which the clips must fit. `states` is a part of the
    dataset's settings. Pass a dataclass, which can be sent to worker processes. Raises `InputError`
    if the clips do not fit the grid, or if `out` holds other settings.
    """
    grid.check(config.spec)
    parts = out / "parts"
    open_folder(out, config if states is true_states else {"dataset": config, "states": states})
    if (out / MANIFEST).exists():
        written = read_manifest(out).grid
        if written != grid:
            raise InputError(
                f"{quote_path(out)} holds clips for another latent grid: it must be {grid}, not "
                f"{written}. Choose another folder. (--out)"
            )
        # A run may have been killed after it wrote the manifest and before it removed the parts.
        shutil.rmtree(parts, ignore_errors=True)
        yield from config.seeds
        return
    parts.mkdir(exist_ok=True)
    # Clips are written in order: the last part of a scene shows that the scene is complete.
    missing = [seed for seed in config.seeds if not _part(parts, seed, config.clips - 1).exists()]
    yield from (seed for seed in config.seeds if seed not in missing)
    calls = [(config, seed, parts, states) for seed in missing]
    for index, _ in run_in_processes(_make, calls, workers=workers):
        yield missing[index]
    _gather(config, grid, parts, out)


def _make(config: DatasetConfig, seed: int, parts: Path, states: States) -> None:
    clips = list(config.clips_of(seed))
    for clip, state in zip(clips, states(clips), strict=True):
        with atomic_write(_part(parts, seed, clip.number)) as temporary:
            triplet = to_triplet(
                clip, state, prior=config.prior, hands=config.hands, point_px=config.point_px
            )
            temporary.write_bytes(to_bytes(triplet_record(triplet)))


def _part(parts: Path, seed: int, number: int) -> Path:
    return parts / f"{seed}_{number}.record"


def _gather(config: DatasetConfig, grid: VideoGrid, parts: Path, out: Path) -> None:
    """Write the parts to shards, in the order of the seeds, and remove them."""
    provenance = {
        "world": "tabletop", "kind": config.kind, "seeds": list(config.seeds),
        "prior": config.prior, "hands": config.hands,
    }  # fmt: skip
    complete = parts / "shards"
    with ShardWriter(
        complete, kind="frames", spec=config.spec, grid=grid, provenance=provenance, overwrite=True
    ) as writer:
        for path in (_part(parts, s, n) for s in config.seeds for n in range(config.clips)):
            record = from_bytes(path.read_bytes(), name=path.name)
            writer.add(record.arrays, record.metadata)
    gather([complete], out)
    shutil.rmtree(parts)
