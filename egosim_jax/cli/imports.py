"""`egosim data import`: recordings of datasets and captures, as folders that annotation reads."""

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
class ImportEgoVid(Output, EgoVid):
    """EgoVid-5M, CSV and poses of Ego4D's videos: captions, cameras."""


@dataclass(frozen=True, kw_only=True)
class ImportAgiBot(Output, AgiBot):
    """AgiBot-World: head camera, grippers, depth and captions of each part of an episode."""


@dataclass(frozen=True, kw_only=True)
class ImportLeRobot(Output, LeRobot):
    """LeRobot dataset, v2.0 to v3.0: one camera's video and the task of each episode."""


@dataclass(frozen=True, kw_only=True)
class ImportTasteRob(Output, TasteRob):
    """TASTE-Rob, or any videos of a fixed camera with a table of captions."""


@dataclass(frozen=True, kw_only=True)
class ImportRecord3D(Output, Record3D):
    """Record3D captures of an iPhone: cameras, LiDAR depth."""


@dataclass(frozen=True, kw_only=True)
class ImportColmap(Output, Colmap):
    """COLMAP reconstruction, text or binary: cameras, points."""


@dataclass(frozen=True, kw_only=True)
class ImportNerfstudio(Output, Nerfstudio):
    """nerfstudio capture with transforms.json: cameras, depth."""


@dataclass(frozen=True, kw_only=True)
class ImportHot3D(Output, Hot3D):
    """HOT3D clips of Aria or Quest 3: cameras, hands."""


@dataclass(frozen=True, kw_only=True)
class ImportEgoSimClips(Output, EgoSimClips):
    """Clips of EgoSim's data preparation: cameras, captions."""


@dataclass(frozen=True, kw_only=True)
class ImportTrumans(Output, Trumans):
    """TRUMANS, which is refused with the reason."""


@dataclass(frozen=True, kw_only=True)
class Import:
    """Import recordings of a dataset or a capture: cameras, hands, depth and captions, as known.

    Writes a folder per recording, which `egosim data annotate` reads; videos stay where they are,
    and images become one. What cannot be read is reported and skipped (exit code 3). The same
    command resumes. Prints the folder.
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
