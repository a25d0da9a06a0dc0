"""`egosim robot`: turn clips with hands into clips of robots, with their joint positions."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from egosim_jax.runtime.command import ExitCode, group
from egosim_jax.runtime.terminal import make_console, print_line
from egosim_jax.types import InputError

VIDEO, SHEET, REPORT = "robot.mp4", "sheet.jpg", "report.json"
DATASET, TRIPLETS = "lerobot", "triplets"


@dataclass(frozen=True, kw_only=True)
class List:
    """List the robots, and what each is good for."""

    def run(self) -> int:
        """Print the table of robots."""
        from rich.table import Table

        from egosim_jax.robots.arms import ARMS

        table = Table("name", "robot", "joints", "good for")
        for arm in ARMS.values():
            table.add_row(arm.name, arm.title, str(len(arm.joints)), arm.suits)
        make_console(width=140).print(table)
        return ExitCode.DONE


@dataclass(frozen=True, kw_only=True)
class Render:
    """Replace the hands of a clip by robots that follow them (extra `robot`).

    Writes a video, a contact sheet, report.json, a LeRobot dataset (version 3.0) with joint
    positions, and training clips with the gripper's skeleton. The report names the frames that the
    robot does not reach, and by how much. The folder is complete or absent: a stopped command is
    repeated.
    """

    source: Annotated[Path, tyro.conf.Positional]
    """Clip with known hands and cameras, recognized by its files.

    An episode with ground truth (`egosim episode make`), a clip of `egosim data annotate`, a run of
    `egosim simulate`, or a session of `egosim serve` or `egosim play`."""
    robot: str
    """Name in `egosim robot list`, or the .toml file of your own robot (docs/robot.md)."""
    out: Path
    """Folder to write, new or empty."""
    hands: Literal["acting", "all"] = "acting"
    """Hands that get a robot: the one that moves most, or each. All hands are removed."""
    base: tuple[float, float, float, float] | None = None
    """Place of the robot's base, x, y and z in meters above the table, and its yaw in degrees.

    By default a place is searched from which the whole path can be reached."""

    def run(self) -> int:
        """Convert the episode and write everything."""
        from egosim_jax.data.clips import write_clips
        from egosim_jax.data.lerobot_writer import check_new
        from egosim_jax.data.sheet import SheetClip, draw_sheet
        from egosim_jax.io.atomic import atomic_folder
        from egosim_jax.io.run import write_json
        from egosim_jax.io.writing import write_video
        from egosim_jax.rendering import get
        from egosim_jax.robots.conversion import (
            convert,
            export,
            report_of,
            triplets_of,
            video_of,
        )
        from egosim_jax.robots.own import open_robot
        from egosim_jax.robots.sources import open_source

        check_new(self.out)
        robot = open_robot(self.robot)
        arm = robot.arm
        began = time.monotonic()
        source = open_source(self.source)
        episode = source.episode
        converted = convert(source, robot, hands=self.hands, base=self.base)
        first, truth = converted.drawn[0], episode.ground_truth[0]
        rows = [truth.frames, converted.backgrounds[0].frames, first.frames]
        moments = [round(n * (len(truth.frames) - 1) / 5) for n in range(6)]
        name = re.sub("[^A-Za-z0-9_-]+", "_", f"{self.source.resolve().stem}_{arm.name}")
        report = {"source": self.source, "kind": source.kind, **report_of(converted)}
        with atomic_folder(self.out) as out:
            write_video(out / VIDEO, video_of(converted), converted.fps)
            draw_sheet([SheetClip(arm.title, rows)], out / SHEET, moments=moments)
            export(converted, out / DATASET)
            triplets = triplets_of(converted, name, get("jax"))
            write_clips(out / TRIPLETS, triplets, fps=converted.fps)
            seconds = round(time.monotonic() - began, 1)
            write_json(out / REPORT, {**report, "seconds": seconds})
        for entry in report["robots"]:
            print_line(_words(entry))
        if not any(entry["reached"] for entry in report["robots"]):
            raise InputError(
                f"{arm.title} reaches the hand in no frame: see {self.out / REPORT}. Use another "
                "robot or base. (--robot, --base)"
            )
        print_line(self.out)
        return ExitCode.DONE


def _words(entry: Mapping[str, Any]) -> str:
    """Return what the report says of one robot, in a line."""
    frames, missing, near = (
        entry[name] for name in ("frames", "frames_without_hand", "frames_at_camera")
    )
    words = (
        f"{entry['robot']} for hand {entry['hand']} reaches {entry['reached']:.1%} of "
        f"{frames - missing} frames, {1000 * entry['pinch_error_m']['max']:.1f} mm off at most"
    )
    if missing:
        words += f"; it waits in {missing} frames in which the hand was not found, nor removed"
    if near:
        words += f"; in {near} frames it is at the camera: try another base (--base)"
    return words


@dataclass(frozen=True, kw_only=True)
class Check:
    """Check the description of your own robot: its URDF or MJCF, its gripper and its units.

    Prints the parts of the model that the description names, or the first problem and its fix.
    Nothing is written.
    """

    robot: Annotated[Path, tyro.conf.Positional]
    """Description, a .toml file (docs/robot.md)."""

    def run(self) -> int:
        """Print the arm, its gripper, and the frames that the description gives."""
        from egosim_jax.robots.own import load_own
        from egosim_jax.robots.own_report import lines_of

        for line in lines_of(load_own(self.robot)):
            print_line(line)
        return ExitCode.DONE


Robot = group(
    "Robot",
    "Turn clips with hands into clips of robots, with their joint positions.",
    {
        "render": Render,
        "list": List,
        "check": Check,
    },
)
