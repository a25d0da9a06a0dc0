"""Shards of tabletop clips, made in parallel, one file a scene until all are there."""

from __future__ import annotations

import multiprocessing
import os
import shutil
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from egosim_jax import interrupts
from egosim_jax.data.pack import triplet_record
from egosim_jax.data.shards import MANIFEST, ShardWriter, from_bytes, gather, to_bytes
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.run import open_folder
from egosim_jax.types import InputError, Kind, VideoSpec
from egosim_jax.worlds.tabletop import make_sequence, state_after, to_triplet


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Which clips are made; equal plans make equal shards."""

    seeds: tuple[int, ...]
    """One scene each."""
    clips: int
    """In a row in each scene; those after the first see the state that the one before left."""
    spec: VideoSpec
    kind: Kind | Literal["mixed"]
    """Whose hands; mixed: a robot's in the scenes whose seed is a multiple of four."""

    def kind_of(self, seed: int) -> Kind:
        """Whose hands act in a scene."""
        if self.kind == "mixed":
            return "human" if seed % 4 else "robot"
        return self.kind

    def __post_init__(self) -> None:
        """Check that there is something to make."""
        if not self.seeds or self.clips < 1:
            raise InputError(
                f"{len(self.seeds)} scenes of {self.clips} clips are nothing: give at least one "
                "of each. (--scenes, --clips)"
            )


def make_shards(plan: Plan, *, out: Path, workers: int) -> Iterator[int]:
    """Write the shards of a plan; yields each seed when its scene is done.

    Finished scenes lie in `out`/parts, so that an interrupted run goes on where it stopped.
    """
    parts = out / "parts"
    open_folder(out, plan)
    if (out / MANIFEST).exists():
        shutil.rmtree(parts, ignore_errors=True)  # it was killed just then
        yield from plan.seeds
        return
    parts.mkdir(exist_ok=True)
    missing = [seed for seed in plan.seeds if not _part(parts, seed, plan.clips - 1).exists()]
    yield from (seed for seed in plan.seeds if seed not in missing)
    # One thread a process: two that share the cores among threads take twice as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    context = multiprocessing.get_context("spawn")  # a forked jax or Open3D may hang
    pool = ProcessPoolExecutor(workers, mp_context=context)
    try:
        with interrupts.not_inherited():
            jobs = {pool.submit(_make, plan, seed, parts): seed for seed in missing}
        for job in as_completed(jobs):
            job.result()
            yield jobs[job]
    finally:  # after an error or Ctrl-C, scenes that are not begun are left
        pool.shutdown(cancel_futures=True)
    _gather(plan, parts, out)


def _make(plan: Plan, seed: int, parts: Path) -> None:
    sequence = make_sequence(seed, spec=plan.spec, clips=plan.clips, kind=plan.kind_of(seed))
    state = None
    for number, clip in enumerate(sequence):
        path = _part(parts, seed, number)
        with atomic_write(path) as temporary:
            temporary.write_bytes(to_bytes(triplet_record(to_triplet(clip, state))))
        state = state_after(clip, state or clip.state)


def _part(parts: Path, seed: int, number: int) -> Path:
    return parts / f"{seed}_{number}.record"


def _gather(plan: Plan, parts: Path, out: Path) -> None:
    """Put the parts into shards, in the order of the plan, and remove them."""
    provenance = {"world": "tabletop", "kind": plan.kind, "seeds": list(plan.seeds)}
    whole = parts / "shards"
    with ShardWriter(
        whole, kind="frames", spec=plan.spec, provenance=provenance, overwrite=True
    ) as writer:
        for path in (_part(parts, s, n) for s in plan.seeds for n in range(plan.clips)):
            record = from_bytes(path.read_bytes(), name=path.name)
            writer.add(record.arrays, record.metadata)
    gather([whole], out)
    shutil.rmtree(parts)
