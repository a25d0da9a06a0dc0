"""`egosim data import`: convert datasets and captures to recordings, the input of annotation."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, cast

import tyro

from egosim_jax.data.readers import Reader
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
from egosim_jax.data.readers.trumans import Trumans
from egosim_jax.runtime.command import ExitCode
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import printable


@dataclass(frozen=True, kw_only=True)
class Output:
    """Options of every import."""

    out: Path
    """Folder of the recordings."""
    limit: int | None = None
    """Maximum number of recordings."""

    def run(self) -> int:
        """Import all recordings."""
        from egosim_jax.data.importing import import_recordings

        reader = cast(Reader, self)  # each subclass also inherits from a reader
        total, outcomes = import_recordings(reader, self.out, limit=self.limit)
        done = resumed = 0
        for outcome in track(outcomes, "importing", total=total):
            done, resumed = done + (outcome.problem is None), resumed + outcome.resumed
            if outcome.note is not None:
                print(f"{outcome.recording_id}: {outcome.note}", file=sys.stderr)
            if outcome.problem is not None:
                problem = f"skipped: {outcome.recording_id}: {outcome.problem}"
                print(printable(problem), file=sys.stderr)
        earlier = f", {resumed} of them earlier" if resumed else ""
        print(f"{done} of {total} recordings imported{earlier}", file=sys.stderr)
        print(self.out)
        return ExitCode.DONE if done == total else ExitCode.PARTIAL


@dataclass(frozen=True, kw_only=True)
class ImportEgoDex(Output, EgoDex):
    """Apple's EgoDex (HDF5 and MP4 per episode): cameras, hands, captions."""


@dataclass(frozen=True, kw_only=True)
class ImportEgoVid(Output, EgoVid):
    """EgoVid-5M (CSV and poses of Ego4D videos): captions, cameras."""


@dataclass(frozen=True, kw_only=True)
class ImportAgiBot(Output, AgiBot):
    """AgiBot-World (one recording per part of an episode): cameras, grippers, depth, captions."""


@dataclass(frozen=True, kw_only=True)
class ImportLeRobot(Output, LeRobot):
    """LeRobot dataset (v2.0 to v3.0): one camera's video, and the task as caption."""


@dataclass(frozen=True, kw_only=True)
class ImportTasteRob(Output, TasteRob):
    """TASTE-Rob, or any videos of a fixed camera with a table: captions."""


@dataclass(frozen=True, kw_only=True)
class ImportRecord3D(Output, Record3D):
    """Record3D captures (iPhone): cameras, LiDAR depth."""


@dataclass(frozen=True, kw_only=True)
class ImportColmap(Output, Colmap):
    """COLMAP reconstruction (text or binary): cameras, points."""


@dataclass(frozen=True, kw_only=True)
class ImportNerfstudio(Output, Nerfstudio):
    """nerfstudio capture (transforms.json): cameras, depth."""


@dataclass(frozen=True, kw_only=True)
class ImportHot3D(Output, Hot3D):
    """HOT3D clips (Aria or Quest 3): cameras, hands."""


@dataclass(frozen=True, kw_only=True)
class ImportEgoSimClips(Output, EgoSimClips):
    """Clips from EgoSim's data preparation: cameras, captions."""


@dataclass(frozen=True, kw_only=True)
class ImportTrumans(Output, Trumans):
    """TRUMANS: not supported; prints the reason."""


@dataclass(frozen=True, kw_only=True)
class Import:
    """Import recordings from a dataset or a capture: cameras, hands, depth and captions, if known.

    Writes a folder per recording, which `egosim data annotate` reads. Videos are not copied; images
    are joined to a video. Unreadable recordings are reported and skipped (exit code 3). The same
    command resumes an interrupted run. Prints the folder.
    """

    command: (
        Annotated[ImportEgoDex, tyro.conf.subcommand("egodex")]
        | Annotated[ImportEgoVid, tyro.conf.subcommand("egovid")]
        | Annotated[ImportAgiBot, tyro.conf.subcommand("agibot")]
        | Annotated[ImportLeRobot, tyro.conf.subcommand("lerobot")]
        | Annotated[ImportTasteRob, tyro.conf.subcommand("taste_rob")]
        | Annotated[ImportRecord3D, tyro.conf.subcommand("record3d")]
        | Annotated[ImportColmap, tyro.conf.subcommand("colmap")]
        | Annotated[ImportNerfstudio, tyro.conf.subcommand("nerfstudio")]
        | Annotated[ImportHot3D, tyro.conf.subcommand("hot3d")]
        | Annotated[ImportEgoSimClips, tyro.conf.subcommand("egosim")]
        | Annotated[ImportTrumans, tyro.conf.subcommand("trumans")]
    )

    def run(self) -> int:
        """Import the recordings of a dataset."""
        return self.command.run()
