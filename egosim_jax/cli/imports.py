"""`egosim data import`: recordings of datasets and captures, as folders that annotation reads."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, cast

import tyro

from egosim_jax.command import ExitCode
from egosim_jax.data.readers import Reader
from egosim_jax.data.readers.egodex import EgoDex
from egosim_jax.data.readers.lerobot import LeRobot
from egosim_jax.progress import track


@dataclass(frozen=True, kw_only=True)
class Output:
    """Options of every import."""

    out: Path
    """Folder of the recordings."""
    limit: int | None = None
    """Maximum number of recordings."""

    def run(self) -> int:
        """Import one recording after the other."""
        from egosim_jax.data.importing import import_recordings

        reader = cast(Reader, self)  # the other base of each subclass
        total, outcomes = import_recordings(reader, self.out, limit=self.limit)
        done = resumed = 0
        for outcome in track(outcomes, "importing", total=total):
            done, resumed = done + (outcome.problem is None), resumed + outcome.resumed
            if outcome.problem is not None:
                print(f"skipped: {outcome.recording_id}: {outcome.problem}", file=sys.stderr)
        earlier = f", {resumed} of them earlier" if resumed else ""
        print(f"{done} of {total} recordings imported{earlier}", file=sys.stderr)
        print(self.out)
        return ExitCode.DONE if done == total else ExitCode.PARTIAL


@dataclass(frozen=True, kw_only=True)
class ImportEgoDex(Output, EgoDex):
    """Apple's EgoDex, hdf5 and mp4 per episode: cameras, hands, captions."""


@dataclass(frozen=True, kw_only=True)
class ImportLeRobot(Output, LeRobot):
    """LeRobot dataset, v2.0 to v3.0: one camera's video and the task of each episode."""


@dataclass(frozen=True, kw_only=True)
class Import:
    """Import recordings of a dataset or a capture: cameras, hands, depth and captions, as known.

    Writes a folder per recording, which `egosim data annotate` reads; videos stay where they are.
    What cannot be read is reported and skipped (exit code 3). The same command resumes. Prints the
    folder.
    """

    command: (
        Annotated[ImportEgoDex, tyro.conf.subcommand("egodex")]
        | Annotated[ImportLeRobot, tyro.conf.subcommand("lerobot")]
    )

    def run(self) -> int:
        """Run the import."""
        return self.command.run()
