"""The loop: a state is looked at, something is done, the video of it is read back into the state.

    state ─render▶ view ─generate▶ clip ─perceive▶ perceived ─fuse▶ state

Knows no jax: any callable from a view, an action, a first frame and a seed to frames drives it.
Source: EgoSim, equations 1 and 2 and section 3.4.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from egosim_jax.io.atomic import atomic_write, lock_folder
from egosim_jax.io.fingerprint import fingerprint
from egosim_jax.io.journal import Journal
from egosim_jax.io.npz import read_arrays
from egosim_jax.perception import Perception, archive
from egosim_jax.rendering.reference import render
from egosim_jax.state import snapshot
from egosim_jax.state.fuse import fuse
from egosim_jax.state.tsdf import Fusion
from egosim_jax.types import Action, Clip, InputError, SceneState, View, check_seed

T = TypeVar("T")


@runtime_checkable
class Generator(Protocol):
    """What makes a video of an action: any function."""

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """The frames of the clip, as many and as large as the view's."""
        ...


@runtime_checkable
class Keep(Protocol):
    """How a phase's result is come by."""

    def __call__(
        self,
        phase: str,
        output: str,
        *,
        make: Callable[[], T],
        save: Callable[[Path, T], None],
        load: Callable[[Path], T],
    ) -> T:
        """What `make` gives, or gave before."""
        ...


@dataclass(frozen=True, kw_only=True)
class Step:
    """One turn of the loop."""

    view: View
    clip: Clip
    state: SceneState
    """Afterwards."""


@dataclass(frozen=True, kw_only=True)
class Simulator:
    """A world that remembers what was done in it."""

    generator: Generator
    perception: Perception | None
    """None: the state stays as it was before the first clip."""
    fps: int
    point_px: int = 2
    """Size of the points in the view; what the generator was trained with."""
    fusion: Fusion = field(default_factory=Fusion)

    def step(
        self,
        state: SceneState,
        action: Action,
        *,
        seed: int,
        first_frame: UInt8[np.ndarray, "h w 3"] | None = None,
        keep: Keep | None = None,
    ) -> Step:
        """Advance the world by one clip; the caller's state is not changed.

        Without a first frame the generator is given what the view shows first.
        """
        keep = keep or _afresh
        view = render(state, action.cameras, point_px=self.point_px)
        image = view.frames[0] if first_frame is None else first_frame
        frames = keep(
            "generate",
            "frames.npz",
            make=lambda: self._generate(view, action, image, seed),
            save=_save_frames,
            load=_load_frames,
        )
        clip = Clip(frames=frames, fps=self.fps)
        if self.perception is None:
            return Step(view=view, clip=clip, state=state)
        perception = self.perception
        perceived = keep(
            "perceive",
            "perceived.npz",
            make=lambda: perception(clip, action, state),
            save=archive.save,
            load=archive.load,
        )
        after = keep(
            "fuse",
            "state",
            make=lambda: fuse(state, perceived, fusion=self.fusion),
            save=snapshot.save,
            load=snapshot.load,
        )
        return Step(view=view, clip=clip, state=after)

    def run(
        self,
        state: SceneState,
        actions: Iterable[Action],
        *,
        out: Path | str,
        seed: int,
        first_frame: UInt8[np.ndarray, "h w 3"] | None = None,
    ) -> Iterator[Step]:
        """Run one step for each action, each from the state that the last one left.

        Every phase is journaled in `out`, with the content hashes of what the run is made of; the
        same call resumes where it was interrupted. The first frame is that of the first clip.
        Raises `InputError` showing both values if `out` holds a run of another state, action,
        generator, perception or seed, and if another process is writing to it.
        """
        check_seed(seed, name="seed")
        out = Path(out)
        with lock_folder(out):
            journal = Journal(out, outputs=("clip_*/*",))
            journal.require(
                "run",
                {
                    "state": snapshot.fingerprint(state),
                    "first_frame": fingerprint(first_frame),
                    "generator": fingerprint(self.generator),
                    "perception": fingerprint(self.perception),
                    "fusion": fingerprint((self.fusion, self.point_px, self.fps)),
                    "seed": str(seed),
                },
            )
            for number, action in enumerate(actions, start=1):
                journal.require(f"{number} action", {"action": fingerprint(action)})

                def keep(phase: str, output: str, number: int = number, **how: object) -> object:
                    where = out / f"clip_{number}" / output
                    return journal.phase(f"{number} {phase}", where, **how)  # type: ignore[arg-type]

                image = first_frame if number == 1 else None
                step = self.step(state, action, seed=seed + number, first_frame=image, keep=keep)  # type: ignore[arg-type]
                yield step
                state = step.state

    def _generate(
        self, view: View, action: Action, image: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        frames = np.asarray(self.generator(view, action, image, seed))
        if frames.shape != view.frames.shape or frames.dtype != np.uint8:
            raise InputError(
                f"The generator gave {frames.dtype} {frames.shape} for a view of uint8 "
                f"{view.frames.shape}: it must give as many frames of the same size."
            )
        return frames


def _afresh(
    phase: str,
    output: str,
    *,
    make: Callable[[], T],
    save: Callable[[Path, T], None],
    load: Callable[[Path], T],
) -> T:
    return make()


def _save_frames(path: Path, frames: UInt8[np.ndarray, "f h w 3"]) -> None:
    with atomic_write(path) as temporary:
        np.savez(temporary, frames=frames)


def _load_frames(path: Path) -> UInt8[np.ndarray, "f h w 3"]:
    return read_arrays(path, {"frames": "uint8"})["frames"]
