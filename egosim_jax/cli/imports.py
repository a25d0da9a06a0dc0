"""`egosim data import`: convert datasets and captures to recordings, the input of annotation."""

from __future__ import annotations

import sys
from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import Any, cast

from egosim_jax.data.readers import READERS, Reader
from egosim_jax.data.readers.agibot import AgiBot
from egosim_jax.data.readers.colmap import Colmap
from egosim_jax.data.readers.egodex import EgoDex
from egosim_jax.data.readers.egosim import EgoSimClips
from egosim_jax.data.readers.egovid import EgoVid
from egosim_jax.data.readers.hot3d import Hot3D
from egosim_jax.data.readers.lerobot import LeRobot
from egosim_jax.data.readers.nerfstudio import Nerfstudio
from egosim_jax.data.readers.record3d import Record3D
from egosim_jax.data.readers.taste_rob import TasteRob
from egosim_jax.runtime.command import ExitCode, group
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import print_line, printable


@dataclass(frozen=True, kw_only=True)
class Output:
    """Options of every import."""

    out: Path
    """Folder of the recordings."""
    limit: int | None = None
    """Maximum number of recordings."""

    def as_reader(self) -> Reader:
        """Return the reader; most commands also inherit from it."""
        return cast(Reader, self)

    def run(self) -> int:
        """Import all recordings."""
        from egosim_jax.data.importing import import_recordings

        total, outcomes = import_recordings(self.as_reader(), self.out, limit=self.limit)
        done = resumed = 0
        for outcome in track(outcomes, "importing", total=total):
            done, resumed = done + (outcome.problem is None), resumed + outcome.resumed
            if outcome.note is not None:
                print(printable(f"{outcome.recording_id}: {outcome.note}"), file=sys.stderr)
            if outcome.problem is not None:
                problem = f"skipped: {outcome.recording_id}: {outcome.problem}"
                print(printable(problem), file=sys.stderr)
        earlier = f", {resumed} of them earlier" if resumed else ""
        print(f"{done} of {total} recordings imported{earlier}", file=sys.stderr)
        print_line(self.out)
        return ExitCode.DONE if done == total else ExitCode.PARTIAL


BUILT_IN = (
    EgoDex,
    EgoVid,
    AgiBot,
    LeRobot,
    TasteRob,
    Record3D,
    Colmap,
    Nerfstudio,
    Hot3D,
    EgoSimClips,
)
"""Readers of this package."""
ABOUT = """\
Import recordings from a dataset or a capture: cameras, hands, depth and captions, if known.

Writes a folder per recording, which `egosim data annotate` reads. Videos are not copied; images
are joined to a video. Unreadable recordings are reported and skipped (exit code 3). The same
command resumes an interrupted run. Prints the folder.
"""


def _command(reader: type) -> type:
    """Return the command of a reader, whose fields are options: it begins with its docstring."""
    about = {"__doc__": str(reader.__doc__).partition("\n")[0]}
    options: Any = {"frozen": True, "kw_only": True}
    return make_dataclass(reader.__name__, [], bases=(Output, reader), namespace=about, **options)


@dataclass(frozen=True, kw_only=True)
class ImportOther(Output):
    """A dataset of your own, by a reader of another package."""

    reader: str
    """Reader with its options: MODULE:NAME, or an entry point of egosim_jax.readers."""

    def as_reader(self) -> Reader:
        """Return the named reader."""
        return READERS.parse(self.reader)


COMMANDS = {reader.dataset: _command(reader) for reader in BUILT_IN} | {"other": ImportOther}
Import = group("Import", ABOUT, COMMANDS)
