"""`egosim data export`: convert recorded sessions to LeRobot, training shards or Rerun."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import tyro

from egosim_jax.runtime.command import ExitCode
from egosim_jax.runtime.terminal import print_line, printable
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class Export:
    """Export sessions of `egosim serve` or `egosim play` to LeRobot, training shards or Rerun.

    lerobot: a dataset (version 3.0) with one episode per reset (extra `video`). shards: one clip
    per step; its target is the generated clip. rerun: OUT/SESSION.rrd per session, for `egosim
    view` (extra `viewer`). A damaged session is reported and skipped (exit code 3). Prints OUT.
    """

    sessions: Annotated[Path, tyro.conf.Positional]
    """Folder of the sessions: --out of `egosim serve` or `egosim play`."""
    out: Path
    """Folder to write."""
    to: Literal["lerobot", "shards", "rerun"] = "lerobot"
    """Format to write."""
    session: tuple[str, ...] = ()
    """Ids of the sessions; by default all."""
    config: str = "tabletop"
    """Name of a model whose latent grid the shards must fit."""

    def run(self) -> int:
        """Read the sessions and write them."""
        if self.to == "rerun" and find_spec("rerun") is None:
            raise InputError(
                "A recording is written by Rerun, which is not installed: pip install "
                "'egosim-jax[viewer]'."
            )
        from egosim_jax import configs
        from egosim_jax.data.lerobot_writer import check_new
        from egosim_jax.interactive.server import dataset_export

        if self.to == "lerobot":
            check_new(self.out)
        sessions, damaged = dataset_export.open_sessions(self.sessions, self.session)
        for name, problem in damaged.items():
            print(printable(f"skipped session {name}: {problem}"), file=sys.stderr)
        if self.to == "lerobot":
            dataset_export.to_lerobot(sessions, self.out)
        elif self.to == "shards":
            dataset_export.to_shards(sessions, self.out, grid=configs.get(self.config).grid)
        else:
            for session in sessions:
                dataset_export.to_rerun(session, self.out / f"{session.id}.rrd")
        print_line(self.out)
        return ExitCode.PARTIAL if damaged else ExitCode.DONE
