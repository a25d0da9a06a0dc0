"""Journaled simulation: every phase is saved to a folder, and an interrupted run resumes.

folder/journal.jsonl            finished phases (io/journal.py)
folder/clip_N/frames.npz        generated clip of step N
folder/clip_N/perceived.npz     perception of the clip
folder/clip_N/state/            state after the step
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sized
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from egosim_jax.io.atomic import atomic_write, lock_folder
from egosim_jax.io.digest import fingerprint
from egosim_jax.io.journal import Journal
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.perception import archive
from egosim_jax.rendering import POINT_PX, Renderer, reference
from egosim_jax.runtime.phases import phase
from egosim_jax.runtime.terminal import counted
from egosim_jax.simulation.simulator import (
    ClipStream,
    FrameTimer,
    Latency,
    Simulator,
    Step,
    VideoGenerator,
    chunk_frames,
)
from egosim_jax.state import snapshot
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Action, Clip, Perceived, SceneState, View, check_seed

OUTPUTS = ("clip_*/*",)
"""Globs of files that only a journaled simulation writes."""


class Rollout:
    """A simulation in a folder, which can be interrupted and resumed."""

    def __init__(self, simulator: Simulator, folder: Path | str, *, name: str = "clip {number}"):
        self.simulator = simulator
        self.folder = Path(folder)
        self._name = name  # of a clip, in the lines that say what happens

    def run(
        self,
        state: SceneState,
        actions: Iterable[Action],
        *,
        seed: int,
        first_frame: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> Iterator[Step]:
        """Run one step per action, each from the state after the previous one.

        The same call resumes an interrupted run, and yields its finished steps first. `first_frame`
        is the first frame of the first clip. Step N uses `seed + N`, which must be a valid seed
        too. Raises `InputError` showing both values if the folder holds a run of another state,
        action, generator, renderer, perception or seed, and if another process writes to it.
        """
        check_seed(seed, name="seed")
        if isinstance(actions, Sized):  # fail before the first clip, not after hours
            check_seed(seed + len(actions), name="seed + number of actions")
        with lock_folder(self.folder):
            journal = Journal(self.folder, outputs=OUTPUTS)
            journal.require("run", self._inputs(state, seed, first_frame))
            if made := sum(name.endswith(" generate") for name in journal.done):
                with phase(f"{self.folder}: {counted(made, 'clip')} made before"):
                    pass  # one line: a resumed run must not look like a new one
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
            "update_every": simulator.update_every,
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
        timer, by_chunk = FrameTimer(simulator.show), simulator.update_every == "chunk"
        timed, made = replace(simulator, show=timer), list[Step]()
        name = self._name.format(number=number)
        with phase(f"{name}: renders the view", only_if_long=True):
            view = simulator.render(state, action)  # not journaled: it follows from its inputs

        def make() -> Clip:
            with phase(f"{name}: generates"):
                if not by_chunk:
                    return timed.generate(view, action, seed=seed, first_frame=first_frame)
                made.append(timed.step(state, action, seed=seed, first_frame=first_frame))
                return made[0].clip

        clip = journal.phase(
            f"{number} generate",
            folder / "frames.npz",
            make=make,
            save=_save_frames,
            load=lambda path: load_clip(path, simulator.fps),
            about=lambda: asdict(timer.latency),
        )
        recorded = journal.done[f"{number} generate"]
        latency = Latency(**{field.name: recorded[field.name] for field in fields(Latency)})
        if (perception := simulator.perception) is None:
            return Step(view=view, clip=clip, state=state, latency=latency)
        if by_chunk:
            known = RecordedClip(generator=simulator.generator, frames=clip.frames)
            replay = replace(simulator, show=None, generator=known)
            step = made[0] if made else replay.step(state, action, seed=seed)
            view, notes, make_state = step.view, step.notes, lambda: step.state
        else:

            def perceive() -> Perceived:
                with phase(f"{name}: perceives"):
                    return perception(clip, action, state)

            perceived = journal.phase(
                f"{number} perceive",
                folder / "perceived.npz",
                make=perceive,
                save=archive.save,
                load=archive.load,
            )
            notes = perceived.notes

            def make_state() -> SceneState:
                with phase(f"{name}: updates the state", only_if_long=True):
                    return fuse(state, perceived, fusion=simulator.fusion)

        after = journal.phase(
            f"{number} fuse",
            folder / "state",
            make=make_state,
            save=snapshot.save,
            load=snapshot.load,
        )
        return Step(view=view, clip=clip, state=after, notes=notes, latency=latency)


@dataclass(frozen=True, kw_only=True)
class RecordedClip:
    """Generator of a clip that is known, in the chunks in which it was made."""

    generator: VideoGenerator
    """Generator that made the clip."""
    frames: UInt8[np.ndarray, "f h w 3"]
    """Frames of the clip."""

    @property
    def renderer(self) -> Renderer:
        """Renderer of the generator."""
        return getattr(self.generator, "renderer", reference)

    @property
    def point_px(self) -> int:
        """Side of a point of the view in pixels."""
        return getattr(self.generator, "point_px", POINT_PX)

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk."""
        return chunk_frames(self.generator) or (len(self.frames),)

    def fingerprint(self) -> str:
        """Return the content hash of the generator: the clip is its own."""
        return fingerprint(self.generator)

    def begin(self, first_frame: UInt8[np.ndarray, "h w 3"], seed: int) -> ClipStream:
        """Begin the clip."""
        ends = np.cumsum(self.chunk_frames)[:-1]
        return _RecordedStream(iter(np.split(self.frames, ends)))

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """Return the frames."""
        return self.frames


@dataclass(frozen=True)
class _RecordedStream:
    """Chunks of a clip that is known (`simulator.ClipStream`)."""

    chunks: Iterator[UInt8[np.ndarray, "f h w 3"]]

    def put(self, view: View, action: Action) -> None:
        pass

    def take(self) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        yield next(self.chunks)


def _save_frames(path: Path, clip: Clip) -> None:
    with atomic_write(path) as temporary:
        np.savez(temporary, frames=clip.frames)


def load_clip(path: Path, fps: int) -> Clip:
    """Read the clip of a step from its frames.npz."""
    return Clip(frames=read_arrays(path, {"frames": "uint8"})["frames"], fps=fps)
