"""Clips of the tabletop world without end, the processes that make them, and their queue.

    python -m egosim_jax.train.online.scenes --queue FOLDER --first SEED --stride N

writes the clips of the scenes SEED, SEED + N, ... to the folder, each as one file that appears
complete, and waits while the folder is full. A seed decides everything: the kind of hands, and
whether the scene is a script, an attempt, an encounter (modules of `worlds/tabletop`), or idle.
"""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro
from jaxtyping import Float

from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig
from egosim_jax.data.records import stacked
from egosim_jax.generation.encoding import pack
from egosim_jax.io.untrusted.npz import read_all
from egosim_jax.perception.oracle import OracleConfig
from egosim_jax.state.fuse import fuse
from egosim_jax.train.online.pool import CHUNK
from egosim_jax.types import Action, Clip, Kind, SceneState, Triplet, VideoSpec
from egosim_jax.worlds.tabletop import (
    TabletopClip,
    World,
    make_scripts,
    make_sequence,
    state_after,
)
from egosim_jax.worlds.tabletop.attempts import make_attempts
from egosim_jax.worlds.tabletop.clips import observation_of, to_action, to_triplet
from egosim_jax.worlds.tabletop.dataset import conditions_of
from egosim_jax.worlds.tabletop.encounters import make_encounters

if TYPE_CHECKING:
    from egosim_jax.train.online.plan import OnlineTraining

HELD_OUT = "held"
"""Prefix of the names of held-out clips in a queue."""
FUSED_EVERY = 4
"""Distance of the frames that are fused into a state."""
MAX_QUEUED = 400
"""Number of files in a queue from which the processes wait."""
STILL_HEAD, ABSENT, WANDERING = 0.4, 0.25, 0.4
"""Probabilities of a head that is still, of absent hands, and of wandering ones."""
STEP_M = 0.006
"""Standard deviation of a wandering hand's change of speed along each axis, meters a frame."""
REACH_M = 0.08
"""Maximum distance of a wandering hand from its start along each axis, in meters."""
ABSENT_PROMPT = "The wearer rests."
RESTING_PROMPT = "The hand rests."
"""Prompts of absent and of resting hands; every second clip has the script's prompt instead."""


@dataclass(frozen=True, kw_only=True)
class EndlessScenes:
    """Mixture of scenes; a seed gives the same clips everywhere."""

    model: ModelConfig
    """Model of the clips' size and conditions."""
    clips: int = 2
    """Clips of each scene; each starts from the state after the clip before."""
    robots: float = 0.25
    """Fraction of scenes with a gripper."""
    attempts: float = 0.25
    """Fraction of scenes in which a grasp may fail and the head turns."""
    encounters: float = 0.3
    """Fraction of scenes in which hands push, two hands act, bodies carry others or grasps slip."""
    idle: float = 0.12
    """Fraction of scenes whose hands rest, are absent or wander."""
    wrong_prompts: float = 0.04
    """Fraction of clips with the prompt of another scene: the hands decide, not the prompt."""
    fused: float = 0.0
    """Fraction of scenes whose states are fused from the frames of the clips before.

    It needs Open3D. In the other scenes the objects of the first state move, and no points are
    added."""
    black_cloths: int = 2
    """Maximum number of black cloths on a table, which look unobserved in a prior."""

    def clips_of(self, seed: int) -> Iterator[TabletopClip]:
        """Yield the clips of a scene."""
        rng = np.random.default_rng([seed, 11])
        kind = "robot" if rng.random() < self.robots else "human"
        shares = {
            make_idle: self.idle,
            make_attempts: self.attempts,
            make_encounters: self.encounters,
        }
        borders = np.cumsum(list(shares.values()))
        number = int(np.searchsorted(borders, rng.random(), side="right"))
        make = [*shares, make_sequence][number]
        for clip in make(
            seed,
            spec=self.model.video,
            clips=self.clips,
            kind=kind,
            black_cloths=self.black_cloths,
        ):
            if rng.random() < self.wrong_prompts:
                other = next(make_scripts(seed + 1, spec=self.model.video, kind=kind))
                clip = replace(clip, caption=other.caption)
            yield clip

    def triplets(self, seed: int) -> Iterator[Triplet]:
        """Yield the clips of a scene as triplets, each rendered from the state before it."""
        fused = np.random.default_rng([seed, 12]).random() < self.fused
        prior, hands = conditions_of(self.model)
        before, state = None, None
        for clip in self.clips_of(seed):
            if before is not None:
                state = state or before.state
                if fused:
                    state = fused_after(before, state, fps=self.model.video.fps)
                else:
                    state = state_after(before, state)
            yield to_triplet(clip, state, prior=prior, hands=hands, point_px=self.model.point_px)
            before = clip


def make_idle(
    seed: int, *, spec: VideoSpec, clips: int = 1, kind: Kind = "human", black_cloths: int = 0
) -> Iterator[TabletopClip]:
    """Yield the clips of a scene whose hands rest, are absent or wander, under any prompt.

    In a script a hand always reaches for a body. A model trained only on scripts lets a resting
    hand melt.
    """
    rng = np.random.default_rng([seed, 0 if kind == "human" else 1, 9])
    script = next(
        make_scripts(
            seed,
            spec=spec,
            kind=kind,
            black_cloths=black_cloths,
            fixed_camera=bool(rng.random() < STILL_HEAD),
        )
    )
    joints = np.repeat(script.action.joints_m[:1], spec.frames, axis=0)
    prompt, choice = RESTING_PROMPT, rng.random()
    wanders = ABSENT < choice < ABSENT + WANDERING
    if choice < ABSENT:
        joints, prompt = np.full_like(joints, np.nan), ABSENT_PROMPT
    world = World(scene=script.scene, seed=seed)
    for _ in range(clips):
        if wanders:
            joints = joints[-1:] + wander(spec.frames, rng)
        action = Action(
            cameras=script.cameras,
            joints_m=joints,
            kind=kind,
            prompt=script.caption if wanders or rng.random() < 0.5 else prompt,
        )
        clip, world = world.execute(action)
        yield clip


def wander(frames: int, rng: np.random.Generator) -> Float[np.ndarray, "f 1 1 3"]:
    """Return the offsets of a hand on a smooth random path from 0, in meters."""
    speed = np.cumsum(rng.normal(0, STEP_M, (frames, 3)), axis=0)
    path = np.cumsum(speed - speed[:1], axis=0) / np.sqrt(frames)
    path = REACH_M * np.tanh(path / REACH_M)
    path[:, 2] = np.maximum(path[:, 2], -0.02)  # a hand does not sink into the table
    return path[:, None, None, :]


def fused_after(clip: TabletopClip, state: SceneState, *, fps: int) -> SceneState:
    """Fuse true frames of a clip into a state, with the true motion.

    A simulator fuses all frames; every `FUSED_EVERY`-th costs a quarter of the time, and leaves the
    same traces of objects, shadows and hands.
    """
    some = slice(None, None, FUSED_EVERY)
    cameras = replace(clip.cameras, world_from_camera=clip.cameras.world_from_camera[some])
    clip = replace(
        clip,
        cameras=cameras,
        frames=clip.frames[some],
        depth_m=clip.depth_m[some],
        ids=clip.ids[some],
        joints_m=clip.joints_m[some],
        world_from_body={name: path[some] for name, path in clip.world_from_body.items()},
    )
    perceive = OracleConfig().build({state.step: observation_of(clip)})
    perceived = perceive(Clip(frames=clip.frames, fps=fps), to_action(clip), state)
    return fuse(state, perceived)


def row_of(triplet: Triplet, model: ModelConfig) -> dict[str, np.ndarray]:
    """Return the arrays of a clip that training needs: the condition's inputs and the frames."""
    row = {name: array[0] for name, array in pack([triplet], model).items()}
    if triplet.target is not None:
        row["target"] = triplet.target
    return row


def write_row(folder: Path, name: str, row: Mapping[str, Any]) -> None:
    """Write a row to a queue; readers see the complete file or none."""
    hidden = folder / f".{name}.npz"
    with hidden.open("wb") as file:
        np.savez(file, **row)
    hidden.rename(folder / f"{name}.npz")


def queued(folder: Path) -> list[Path]:
    """Return the complete files of a queue, the oldest first."""
    with os.scandir(folder) as entries:
        found = [(e.stat().st_mtime_ns, e.path) for e in entries if not e.name.startswith(".")]
    return [Path(path) for _, path in sorted(found)]


class Clips(threading.Thread):
    """Reader of the queue: chunks of raw clips, and the held-out ones."""

    def __init__(self, folder: Path):
        super().__init__(daemon=True)
        self.folder, self.chunks = folder, queue.Queue(maxsize=4)
        self.held: list[Mapping[str, np.ndarray]] = []

    def run(self) -> None:
        """Read files as they appear."""
        rows: list[Mapping[str, np.ndarray]] = []
        while self.folder.is_dir():
            for path in queued(self.folder):
                row = read_all(path)  # NumPy's own reader fails in threads of Python 3.11
                path.unlink()
                if path.name.startswith(HELD_OUT):
                    self.held.append(row)
                    continue
                rows.append(row)
                if len(rows) == CHUNK:
                    self.chunks.put(stacked(rows))
                    rows = []
            time.sleep(0.1)


def start_workers(plan: OnlineTraining, folder: Path, *, made: int) -> list[subprocess.Popen]:
    """Start the processes that make scenes, first the held-out ones.

    `made` clips were made before an interruption; a scene has at least one of them.
    """
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", **dict.fromkeys(threads, "1")}
    command = [sys.executable, "-m", "egosim_jax.train.online.scenes"]
    command += ["--config", plan.model.name, "--queue", str(folder)]
    command += ["--stride", str(plan.workers), "--held-out", str(plan.held_out), "--first"]
    with (plan.out / "scenes.log").open("a") as log:
        return [
            subprocess.Popen(  # noqa: S603 - this package's module
                [*command, str(plan.first_scene + made + number)],
                env=environment,
                stderr=log,
                stdout=log,
            )
            for number in range(plan.workers)
        ]


def make(
    scenes: EndlessScenes, folder: Path, *, first: int, stride: int, held_out: int = 0
) -> None:
    """Make scenes until the process is ended or the folder is removed.

    Its part of the held-out scenes, of seeds below `held_out`, comes first: one scripted clip each.
    """
    for seed in range(first % stride, held_out, stride):
        kind = "human" if seed % 4 else "robot"
        clip = next(make_sequence(seed, spec=scenes.model.video, kind=kind, black_cloths=2))
        triplet = to_triplet(clip, point_px=scenes.model.point_px)
        write_row(folder, f"{HELD_OUT}_{seed}", row_of(triplet, scenes.model))
    seed = first
    while folder.is_dir():
        while folder.is_dir() and len(os.listdir(folder)) >= MAX_QUEUED:
            time.sleep(0.2)
        try:
            for number, triplet in enumerate(scenes.triplets(seed)):
                write_row(folder, f"{seed}_{number}", row_of(triplet, scenes.model))
        except FileNotFoundError:
            return
        except Exception as problem:  # one bad scene must not end a run on a lent machine
            print(f"scene {seed}: {type(problem).__name__}: {problem}", file=sys.stderr, flush=True)
        seed += stride


def main(*, queue: Path, first: int, config: str, stride: int, held_out: int) -> None:
    """Make the scenes of one process of a training.

    Args:
        queue: Folder of the clips.
        first: First seed.
        config: Name of the model.
        stride: Distance of two seeds.
        held_out: Scenes of validation, made first.
    """
    scenes = EndlessScenes(model=configs.get(config))
    os.nice(10)  # the training process comes first
    cores = sorted(os.sched_getaffinity(0))
    if stride + 2 <= len(cores):  # Embree would start more threads than one each
        os.sched_setaffinity(0, {cores[2 + first % stride]})
    make(scenes, queue, first=first, stride=stride, held_out=held_out)


if __name__ == "__main__":
    tyro.cli(main)
