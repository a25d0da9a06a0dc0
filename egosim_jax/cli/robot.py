"""`egosim robot`: turn clips with hands into clips of robots, with their joint positions."""

from __future__ import annotations

import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import tyro

from egosim_jax.runtime.command import ExitCode, Writes, group
from egosim_jax.runtime.terminal import make_console, print_line
from egosim_jax.types import InputError, check_counts

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.robots.recorded import Replay
    from egosim_jax.types import SceneState

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


@dataclass(frozen=True, kw_only=True)
class Actions:
    """Make an episode of recorded joints: a LeRobot dataset (version 3.0) of your own robot.

    The description says which values are the arm's joints and the gripper, in which unit, and where
    the camera is (docs/robot.md). The joints become actions of the gripper, in the frame of the
    robot's base. The recorded video is the ground truth, so `egosim simulate` scores against it.
    The scene is the first frame without the robot: give its depth, or a --state.
    """

    writes: ClassVar[Writes] = "folder or .zip file"
    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset, with meta/info.json."""
    robot: Path
    """Description of the robot, a .toml file with [recording] and [camera]."""
    out: Path
    """Folder to write, or a file whose name ends in .zip."""
    episode: int = 0
    """Number of the episode in the dataset."""
    joints: Literal["observation.state", "action"] = "observation.state"
    """Joints to follow: the measured ones, or the commands, each for the next frame."""
    depth: str | None = None
    """Depth of the first frame: an .npz file with depth_m in meters, or NETWORK=FOLDER.

    Networks are depth-anything, depth-anything-3 and depth-pro; the robot gives the scale."""
    state: Path | None = None
    """Folder of a state, or a .ply of colored points, in the frame of the base, without depth."""
    objects: str = "auto"
    """Movable objects of the first frame: auto, none, or a .png of ids (see `egosim episode`)."""
    names: tuple[str, ...] = ()
    """Names of objects, each ID=NAME; by default "object 1" and so on."""
    config: str = "tabletop"
    """Model whose length, size and frame rate the clips have."""
    clips: int | None = None
    """Number of clips; by default as many as fit into the episode."""
    device: str = "auto"
    """Device of a depth network: cpu, cuda, cuda:N, or auto for the first GPU if there is one."""

    def run(self) -> int:
        """Check robot, dataset and camera, and write the episode."""
        from egosim_jax import configs
        from egosim_jax.cli.episode import save_episode
        from egosim_jax.robots.own import load_own
        from egosim_jax.robots.recorded import episode_of, open_replay

        check_counts({"--clips": self.clips})
        if (self.depth is None) == (self.state is None):
            raise InputError(
                "The scene must be given once: the depth of the first frame, as an .npz file with "
                "depth_m or as a network, or a state. (--depth, --state)"
            )
        video = configs.get(self.config).video
        robot = load_own(self.robot)
        replay = open_replay(self.dataset, self.episode, robot, column=self.joints)
        state, image = self._scene(replay)
        episode = episode_of(replay, video, state, first_frame=image, clips=self.clips)
        return save_episode(episode, self.out, describe=True)

    def _scene(self, replay: Replay) -> tuple[SceneState, np.ndarray]:
        """Return the scene and the first frame, both without the robot."""
        import numpy as np

        from egosim_jax.cli.episode import read_state
        from egosim_jax.cli.objects import names_of, objects_of
        from egosim_jax.robots.first_scene import robot_depth, without_robot
        from egosim_jax.state.depth import state_from_depth

        robot_m = robot_depth(replay)
        image, mask = without_robot(replay, robot_m)
        print_line(f"the robot covers {np.isfinite(robot_m).mean():.1%} of the first frame")
        if self.state is not None:
            return read_state(self.state), image
        depth_m = np.where(mask, np.nan, self._depth(replay, robot_m))
        intrinsics, pose = replay.camera.intrinsics_px, replay.camera.world_from_camera[0]
        ids, known = objects_of(self.objects, image, depth_m, intrinsics)
        names = names_of(ids, known, self.names)
        scene = state_from_depth(image, depth_m, intrinsics, pose, object_ids=ids, names=names)
        return scene, image

    def _depth(self, replay: Replay, robot_m: np.ndarray) -> np.ndarray:
        """Return the depth of the first frame in meters, compared with the robot's own."""
        from egosim_jax.annotate.config import build_depth
        from egosim_jax.io.untrusted.npz import read_arrays
        from egosim_jax.robots.first_scene import check_depth, estimate_depth

        chosen = str(self.depth)
        if "=" in chosen:
            network = build_depth(chosen, device=self.device)
            return estimate_depth(replay, robot_m, network, name=chosen)
        path = Path(chosen)
        depth_m = read_arrays(path, {}, others=("depth_m",), packed=True)["depth_m"]
        if depth_m.shape != robot_m.shape:
            raise InputError(
                f"{path} has shape {depth_m.shape} and the video {robot_m.shape}: depth must have "
                "one value per pixel of the first frame. (--depth)"
            )
        check_depth(replay, depth_m, robot_m, name=str(path))
        return depth_m


Robot = group(
    "Robot",
    "Turn clips with hands into clips of robots, and recordings of your own robot into episodes.",
    {
        "render": Render,
        "list": List,
        "check": Check,
        "actions": Actions,
    },
)
