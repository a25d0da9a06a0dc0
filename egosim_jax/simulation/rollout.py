"""Journaled simulation: every phase is saved to a folder, and an interrupted run resumes.

folder/journal.jsonl            finished phases (io/journal.py)
folder/clip_N/frames.npz        generated clip of step N, also as further cameras see it
folder/clip_N/perceived.npz     perception of the clip
folder/clip_N/state/            state after the step
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.atomic import atomic_write, lock_folder
from egosim_jax.io.digest import fingerprint
from egosim_jax.io.journal import Journal
from egosim_jax.io.untrusted.npz import DAMAGE, array_names, read_arrays
from egosim_jax.perception import archive
from egosim_jax.runtime.phases import phase
from egosim_jax.runtime.terminal import counted
from egosim_jax.simulation.simulator import Made, Phase, Simulator, Step
from egosim_jax.simulation.streams import Latency
from egosim_jax.simulation.views import Seen
from egosim_jax.state import snapshot
from egosim_jax.types import Action, Clip, SceneState, check_seed
from egosim_jax.types.arrays import RgbImage, Video

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
        first_frame: RgbImage | None = None,
        frames: Video | None = None,
    ) -> Iterator[Step]:
        """Run one step per action, each from the state after the previous one.

        The same call resumes an interrupted run, and yields its finished steps first. `first_frame`
        is the first frame of the first clip, and `frames` are all of its frames, if it is made
        already. Step N uses `seed + N`, which must be a valid seed too. Raises `InputError` showing
        both values if the folder holds a run of another state, action, generator, renderer,
        perception or seed, and if another process writes to it.
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
                images = {"first_frame": first_frame, "frames": frames} if number == 1 else {}
                step = self._step(journal, number, state, action, seed + number, images)
                yield step
                state = step.state

    def _inputs(self, state: SceneState, seed: int, first_frame: RgbImage | None) -> dict[str, str]:
        simulator = self.simulator
        return {
            "state": snapshot.fingerprint(state),
            "first_frame": fingerprint(first_frame),
            "generator": fingerprint(simulator.generator),
            "renderer": fingerprint(simulator.renderer),
            "perception": fingerprint(simulator.perception),
            "update_every": simulator.update_every,
            "fusion": fingerprint(
                (simulator.fusion, simulator.point_px, simulator.prior, simulator.fps)
            ),
            "seed": str(seed),
            **({} if simulator.rig is None else {"cameras": fingerprint(simulator.rig.cameras)}),
        }

    def _step(
        self,
        journal: Journal,
        number: int,
        state: SceneState,
        action: Action,
        seed: int,
        images: Mapping[str, Any],
    ) -> Step:
        """Run `Simulator.step` with each phase journaled; `images` are its given frames."""
        folder, clip = self.folder / f"clip_{number}", self._name.format(number=number)

        def load_made(path: Path) -> Made:
            recorded = journal.done[f"{number} generate"]
            times = {field.name: recorded[field.name] for field in fields(Latency)}
            fps, rig = self.simulator.fps, self.simulator.rig
            names = () if rig is None else [camera.name for camera in rig.cameras]
            clip, others = load_clips(path, fps, names)
            return Made(clip=clip, latency=Latency(**times), others=others)

        files: dict[Phase, tuple[Path, Any, Any]] = {
            "generate": (folder / "frames.npz", _save_frames, load_made),
            "perceive": (folder / "perceived.npz", archive.save, archive.load),
            "fuse": (folder / "state", snapshot.save, snapshot.load),
        }
        words = {"generate": "generates", "perceive": "perceives", "fuse": "updates the state"}

        def run(name: Phase, make: Callable[[], Any]) -> Any:
            if name not in files:  # predictions and views follow from their inputs
                with phase(f"{clip}: {name}s", only_if_long=True):
                    return make()
            path, save, load = files[name]
            results: list[Any] = []

            def made() -> Any:
                only_if_long = name == "fuse"
                with phase(f"{clip}: {words[name]}", only_if_long=only_if_long):
                    results.append(make())
                return results[0]

            def about() -> dict[str, float]:
                return asdict(results[0].latency) if name == "generate" else {}

            key = f"{number} {name}"
            return journal.phase(key, path, make=made, save=save, load=load, about=about)

        return self.simulator.step(state, action, seed=seed, run=run, **images)


def _save_frames(path: Path, made: Made) -> None:
    with atomic_write(path) as temporary:
        arrays: dict[str, Any] = {"frames": made.clip.frames}
        for name, seen in made.others.items():
            arrays[f"frames_{name}"] = seen.clip.frames
            arrays[f"unobserved_{name}"] = np.array(seen.unobserved)
        np.savez(temporary, **arrays)


def load_clip(path: Path, fps: int) -> Clip:
    """Read the main camera's clip of a step from its frames.npz."""
    try:
        others = [name for name in array_names(path) if name != "frames"]
    except DAMAGE:
        others = []  # the next line then names the damage
    return Clip(frames=read_arrays(path, {"frames": "uint8"}, others=others)["frames"], fps=fps)


def load_clips(path: Path, fps: int, names: Sequence[str]) -> tuple[Clip, dict[str, Seen]]:
    """Read the clip of a step from its frames.npz, also as further cameras see it, by name."""
    dtypes = {f"frames_{name}": "uint8" for name in names}
    dtypes |= {f"unobserved_{name}": "float64" for name in names}
    arrays = read_arrays(path, {"frames": "uint8", **dtypes})
    others = {
        name: Seen(
            clip=Clip(frames=arrays[f"frames_{name}"], fps=fps),
            unobserved=float(arrays[f"unobserved_{name}"].item()),
        )
        for name in names
    }
    return Clip(frames=arrays["frames"], fps=fps), others
