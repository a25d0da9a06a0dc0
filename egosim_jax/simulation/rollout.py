"""Journaled simulation: every phase is saved to a folder, and an interrupted run resumes.

folder/journal.jsonl            finished phases (io/journal.py)
folder/clip_N/frames.npz        generated clip of step N
folder/clip_N/perceived.npz     perception of the clip
folder/clip_N/state/            state after the step
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sized
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from egosim_jax.io.atomic import atomic_write, lock_folder
from egosim_jax.io.digest import fingerprint
from egosim_jax.io.journal import Journal
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.perception import archive
from egosim_jax.simulation.simulator import Simulator, Step
from egosim_jax.state import snapshot
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Action, Clip, SceneState, check_seed

OUTPUTS = ("clip_*/*",)
"""Globs of files that only a journaled simulation writes."""


class Rollout:
    """A simulation in a folder, which can be interrupted and resumed."""

    def __init__(self, simulator: Simulator, folder: Path | str):
        self.simulator = simulator
        self.folder = Path(folder)

    def run(
        self,
        state: SceneState,
        actions: Iterable[Action],
        *,
        seed: int,
        first_frame: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> Iterator[Step]:
        """Run one step per action, each from the state after the previous one.

        The same call resumes an interrupted run. `first_frame` is the first frame of the first
        clip. Step N uses `seed + N`, which must be a valid seed too. Raises `InputError` showing
        both values if the folder holds a run of another state, action, generator, renderer,
        perception or seed, and if another process writes to it.
        """
        check_seed(seed, name="seed")
        if isinstance(actions, Sized):  # fail before the first clip, not after hours
            check_seed(seed + len(actions), name="seed + number of actions")
        with lock_folder(self.folder):
            journal = Journal(self.folder, outputs=OUTPUTS)
            journal.require("run", self._inputs(state, seed, first_frame))
            for number, action in enumerate(actions, start=1):
                check_seed(seed + number, name="seed + number of actions")
                journal.require(f"{number} action", {"action": fingerprint(action)})
                image = first_frame if number == 1 else None
                step = self._step(journal, number, state, action, seed + number, image)
                yield step
                state = step.state

    def _inputs(
        self, state: SceneState, seed: int, first_frame: UInt8[np.ndarray, "h w 3"] | None
    ) -> dict[str, str]:
        simulator = self.simulator
        return {
            "state": snapshot.fingerprint(state),
            "first_frame": fingerprint(first_frame),
            "generator": fingerprint(simulator.generator),
            "renderer": fingerprint(simulator.renderer),
            "perception": fingerprint(simulator.perception),
            "fusion": fingerprint((simulator.fusion, simulator.point_px, simulator.fps)),
            "seed": str(seed),
        }

    def _step(
        self,
        journal: Journal,
        number: int,
        state: SceneState,
        action: Action,
        seed: int,
        first_frame: UInt8[np.ndarray, "h w 3"] | None,
    ) -> Step:
        """Run `Simulator.step` with each phase journaled."""
        simulator, folder = self.simulator, self.folder / f"clip_{number}"
        view = simulator.render(state, action)  # not journaled: it follows from state and action
        clip = journal.phase(
            f"{number} generate",
            folder / "frames.npz",
            make=lambda: simulator.generate(view, action, seed=seed, first_frame=first_frame),
            save=_save_frames,
            load=lambda path: load_clip(path, simulator.fps),
        )
        perception = simulator.perception
        if perception is None:
            return Step(view=view, clip=clip, state=state)
        perceived = journal.phase(
            f"{number} perceive",
            folder / "perceived.npz",
            make=lambda: perception(clip, action, state),
            save=archive.save,
            load=archive.load,
        )
        after = journal.phase(
            f"{number} fuse",
            folder / "state",
            make=lambda: fuse(state, perceived, fusion=simulator.fusion),
            save=snapshot.save,
            load=snapshot.load,
        )
        return Step(view=view, clip=clip, state=after, notes=perceived.notes)


def _save_frames(path: Path, clip: Clip) -> None:
    with atomic_write(path) as temporary:
        np.savez(temporary, frames=clip.frames)


def load_clip(path: Path, fps: int) -> Clip:
    """Read the clip of a step from its frames.npz."""
    return Clip(frames=read_arrays(path, {"frames": "uint8"})["frames"], fps=fps)
