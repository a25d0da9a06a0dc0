"""`egosim view`: draw a scene state, or open a simulation."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
import tyro

from egosim_jax.geometry import UP_AXES, Up
from egosim_jax.io.journal import NAME as JOURNAL
from egosim_jax.rendering.portrait import write_portrait
from egosim_jax.rendering.rerun_log import RECORDING
from egosim_jax.runtime.command import ExitCode, Writes
from egosim_jax.runtime.terminal import print_line
from egosim_jax.state.planes import vertical
from egosim_jax.types import InputError

if TYPE_CHECKING:
    from egosim_jax.types import SceneState

IMAGES = (".png", ".jpg", ".jpeg", ".webp")
"""Suffixes of the images that the command draws."""
PAGE = "index.html"
"""Page of an evaluation or of annotated clips."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Draw a state or a point cloud, or open a simulation in Rerun.

    PATH is one of: the folder of a simulation, or its simulation.rrd (extra `viewer`); the folder
    of a state, such as OUT/clip_1/state; a PLY file of colored points.
    """

    writes: ClassVar[Writes] = "file"
    path: Annotated[Path, tyro.conf.Positional]
    """Folder or file to view."""
    out: Path | None = None
    """Image to write; by default NAME.png here."""
    up: Up | None = None
    """World axis that points up; by default z or -y, whichever the table's normal is nearer to."""
    host: str = "127.0.0.1"
    """Address of the Rerun viewer; by default only this machine can reach it."""

    def run(self) -> int:
        """Draw the state, or open the viewer."""
        recording = self.path / RECORDING if self.path.is_dir() else self.path
        if recording.suffix == ".rrd" and recording.exists():
            self._refuse_out("a recording is opened")
            return _open(recording, self.host)
        if (self.path / "report.json").exists() and (page := self.path / PAGE).exists():
            self._refuse_out(f"{page} exists")  # of an evaluation or of annotated clips
            print_line(page)
            return ExitCode.DONE
        if (self.path / JOURNAL).exists():
            first = self.path / "state_0.ply"
            state = f"; or look at one state: egosim view {first}" if first.exists() else ""
            install = "" if find_spec("rerun") else "pip install 'egosim-jax[viewer]' and "
            raise InputError(
                f"{self.path} has no {RECORDING}, which egosim simulate writes where Rerun is "
                f"installed: {install}run the same command again, which adds it{state}."
            )
        if any(path for name in ("times.json", "*/times.json") for path in self.path.glob(name)):
            raise InputError(
                f"{self.path} is a training: metrics.jsonl has its curves, samples/ its clips. "
                f"TensorBoard draws curves that training wrote for it: tensorboard --logdir "
                f"{self.path}. (--training.tensorboard)"
            )
        out = self.out or Path(f"{self.path.stem}.png")
        if out.suffix.lower() not in IMAGES:
            raise InputError(
                f"{out} is no image: its name must end in {', '.join(IMAGES)}. (--out)"
            )
        state = self._state()
        up = vertical(state) if self.up is None else np.array(UP_AXES[self.up])
        write_portrait(out, state, up=up)
        low, high = state.points_m.min(axis=0), state.points_m.max(axis=0)
        size = " x ".join(f"{length:.2f}" for length in high - low)
        objects = ", ".join(state.names.values()) or "no named objects"
        print_line(f"{len(state.points_m)} points, {size} m, {objects}")
        print_line(out)
        return ExitCode.DONE

    def _refuse_out(self, why: str) -> None:
        if self.out is not None:
            raise InputError(f"--out {self.out} would not be written, as {why}: omit it.")

    def _state(self) -> SceneState:
        from egosim_jax.state.snapshot import DESCRIPTION, load, read_ply

        if (self.path / DESCRIPTION).exists():
            return load(self.path)
        if self.path.suffix == ".ply":
            return read_ply(self.path)
        raise InputError(
            f"{self.path} cannot be viewed: give the folder of a simulation or of a state, a .rrd "
            "or a .ply."
        )


def _open(recording: Path, host: str) -> int:
    if find_spec("rerun") is None:
        raise InputError(
            f"{recording} is opened by Rerun, which is not installed: "
            "pip install 'egosim-jax[viewer]'."
        )
    command = [sys.executable, "-m", "rerun", "--bind", host, str(recording)]
    return subprocess.run(command, check=False).returncode  # noqa: S603
