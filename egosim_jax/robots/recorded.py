"""Recorded joints of a described robot: LeRobot datasets as actions of its gripper.

The world of such an episode is the frame of the robot's base. Joint positions give the pose of the
gripper by the model, and the recorded gripper its opening, so each frame has three keypoints. The
recorded video is the ground truth.

Numbers do not say what they are, so they are compared with the model: names with its joints, values
with its limits in the described unit, the gripper's place with the camera's view, and measured
depth with the robot's own depth in that camera.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Literal, no_type_check

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.annotate.to_episode import crop_to, pick_clips
from egosim_jax.data.lerobot_writer import ACTION, STATE
from egosim_jax.data.readers.lerobot import rate_of, read_info, read_rows, read_tasks
from egosim_jax.data.readers.lerobot_frames import frames_of
from egosim_jax.geometry import invert, pixels_of
from egosim_jax.io.bounded import quote, quote_path
from egosim_jax.io.timing import Timeline, row_times
from egosim_jax.robots.description import Description, OwnCamera, OwnRecording
from egosim_jax.robots.ik import posed
from egosim_jax.robots.models import RobotModel, grip_of, is_slide, limits_of
from egosim_jax.robots.own import OwnModel
from egosim_jax.robots.retarget import keypoints_of
from egosim_jax.robots.toml import nearest
from egosim_jax.simulation.episode import Episode
from egosim_jax.types import (
    Action,
    Cameras,
    GroundTruth,
    InputError,
    SceneState,
    VideoSpec,
    seen_hands,
)

Column = Literal["observation.state", "action"]
"""Joints to follow: the measured or the commanded ones."""
BEYOND, BEYOND_M = np.radians(3.0), 0.005
"""Largest distance of a recorded position beyond a limit, in radians or meters."""
BEYOND_SHARE = 0.1
"""Largest distance of the recorded gripper beyond its ends, as a share of its range."""
MIN_DEGREES = 2 * np.pi
"""Least largest angle in degrees: smaller ones are radians."""
MAX_TURN = 4 * np.pi
"""Largest angle of an endless joint, in radians."""
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Axes of OpenGL in OpenCV's axes."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Replay:
    """Recorded motion of a robot in the frame of its base, and what its camera shows."""

    name: str
    """Name of the recording in messages."""
    robot: RobotModel
    """Model of the robot."""
    camera: Cameras
    """Camera of the video, at rest."""
    q: Float[np.ndarray, "f q"]
    """Positions of the model's joints in each frame of the video."""
    opening_m: Float[np.ndarray, " f"]
    """Opening of the gripper."""
    base_from_grip: Float[np.ndarray, "f 4 4"]
    """Pose of the grip."""
    prompts: tuple[str, ...]
    """Task of each frame."""
    fps: Fraction
    """Frames per second of the video."""
    first: UInt8[np.ndarray, "h w 3"]
    """First frame, with the robot."""
    read: Callable[[int, Callable[[np.ndarray], np.ndarray]], np.ndarray]
    """Function that decodes the first frames, so many, and applies a function to each."""


def open_replay(
    root: Path, episode: int, own: OwnModel, *, column: Column = "observation.state"
) -> Replay:
    """Return the recorded motion of an episode. Raises `InputError` for what contradicts the model.

    An action is the command for the next frame, so the first frame has its measured joints.
    """
    described, robot = own.description, own.robot
    recording, camera = _required(described)
    info = read_info(root, ["v3.0"])
    name = f"Episode {episode} of {quote_path(root)}"
    names = _names(info, column, root)
    places = _places(names, described, recording, column)
    columns = [column, "task_index"] if column == STATE else [STATE, column, "task_index"]
    rows = read_rows(root, info, episode, columns, optional=["timestamp"])
    values = _values(rows[column], places, column)
    if column == ACTION:
        there = _places(_names(info, STATE, root), described, recording, STATE)
        values = np.concatenate([_values(rows[STATE], there, STATE)[:1], values[:-1]])
    frames = frames_of(root, info, episode, recording.camera)
    _check_size(frames.first, camera, root)
    order, timeline = np.arange(len(values)), Timeline.even(len(values), rate_of(info))
    if stamps := rows.get("timestamp"):
        order, _, timeline = row_times(stamps, [rate_of(info)], name)
    at = order[timeline.nearest(np.arange(frames.count) / float(frames.fps))]
    q, opening = _postures(values[at], described, recording, robot, name)
    grips = np.stack(
        [grip_of(robot, posed(robot, robot.open(*pair))) for pair in zip(q, opening, strict=True)]
    )
    _check_seen(grips[:, :3, 3], camera, described)
    texts = read_tasks(root)
    return Replay(
        name=name,
        robot=robot,
        camera=_cameras(camera, 1),
        q=q,
        opening_m=opening,
        base_from_grip=grips,
        prompts=tuple(texts.get(rows["task_index"][row], "") for row in at.tolist()),
        fps=frames.fps,
        first=frames.first,
        read=frames.read,
    )


def episode_of(
    replay: Replay,
    video: VideoSpec,
    state: SceneState,
    *,
    first_frame: UInt8[np.ndarray, "h w 3"],
    clips: int | None = None,
) -> Episode:
    """Return the episode of a recorded motion, with the length, size and rate of a model's clips.

    `first_frame` is the first frame without the robot. The recorded frames are the ground truth.
    """
    crop = crop_to(video, first_frame.shape, name=replay.name)
    moments = Timeline.even(len(replay.q), replay.fps).at_rate(video.fps)
    picked = pick_clips(moments, video, clips, name=replay.name)
    frames = replay.read(int(picked[-1][-1]) + 1, crop.resample)
    points = keypoints_of(replay.base_from_grip, replay.opening_m)[:, None]
    pose = replay.camera.world_from_camera[0]
    actions = []
    for k in picked:
        cameras = Cameras(
            world_from_camera=np.tile(pose, (len(k), 1, 1)),
            intrinsics_px=crop.intrinsics(replay.camera.intrinsics_px),
            height=video.height,
            width=video.width,
        )
        joints = seen_hands(cameras, points[k])
        prompt = replay.prompts[int(k[0])]
        actions.append(Action(cameras=cameras, joints_m=joints, kind="robot", prompt=prompt))
    return Episode(
        state=state,
        actions=tuple(actions),
        fps=video.fps,
        first_frame=crop.resample(first_frame),
        ground_truth=tuple(GroundTruth(frames=frames[k]) for k in picked),
    )


def _required(described: Description) -> tuple[OwnRecording, OwnCamera]:
    """Return the parts of a description that a recording needs."""
    name = quote_path(described.path)
    if described.recording is None:
        raise InputError(
            f"{name} has no table [recording]: a dataset does not say which value is which joint, "
            'and in which unit. Add it, with angle_unit = "radians" or "degrees", gripper, '
            "gripper_closed and gripper_open (docs/robot.md)."
        )
    if described.camera is None:
        raise InputError(
            f"{name} has no table [camera]: a LeRobot dataset does not say where its camera is. "
            "Calibrate it to the robot's base (hand-eye calibration), and add base_from_camera, a "
            "4x4 matrix in OpenCV axes and meters, intrinsics_px, width and height "
            "(docs/robot.md)."
        )
    return described.recording, described.camera


def _names(info: Mapping[str, Any], column: str, root: Path) -> list[str]:
    """Return the names of the values of a feature."""
    feature = info["features"].get(column)
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}
        (names,) = names.values()
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(
            f"{quote_path(root)} does not name the values of {column}: meta/info.json must have "
            "them in features, as names. Add them."
        )
    return names


def _places(
    names: Sequence[str], described: Description, recording: OwnRecording, column: str
) -> list[int]:
    """Return the place of each joint of the arm, and of the gripper, in a row."""
    wanted = [*(recording.names or described.joints), recording.gripper]
    places = []
    for name in wanted:
        found = [n for n, known in enumerate(names) if known in (name, f"{name}.pos")]
        if len(found) != 1:
            raise InputError(
                f"The dataset's {column} has {'no' if not found else 'more than one'} value "
                f"{quote(name)}, which {quote_path(described.path)} names.{nearest(name, names)} "
                "(recording.names, recording.gripper)"
            )
        places += found
    return places


def _values(rows: Sequence[Any], places: list[int], column: str) -> Float[np.ndarray, "f d"]:
    try:
        values = np.array(rows, float)[:, places]
    except (TypeError, ValueError, IndexError):
        raise InputError(
            f"{column} is {quote(rows[0])} in the first frame: every row must have as many numbers "
            "as the feature has names."
        ) from None
    if not np.isfinite(values).all():
        frame = int(np.argmin(np.isfinite(values).all(axis=1)))
        raise InputError(f"{column} is not finite in row {frame}: choose another episode.")
    return values


def _postures(
    values: np.ndarray,
    described: Description,
    recording: OwnRecording,
    robot: RobotModel,
    name: str,
) -> tuple[Float[np.ndarray, "f q"], Float[np.ndarray, " f"]]:
    """Return the positions of all joints and the opening. Raises `InputError` for other units."""
    mj, joints = robot.mj, described.joints
    hinge = np.array([not is_slide(mj, joint) for joint in joints])
    recorded = values[:, :-1]
    degrees = recording.angle_unit == "degrees"
    if degrees and hinge.any() and np.abs(recorded[:, hinge]).max() < MIN_DEGREES:
        raise InputError(
            f"{name}: no joint leaves {np.abs(recorded[:, hinge]).max():.3g} degrees from zero: "
            'the values seem to be radians. Set angle_unit = "radians". (recording.angle_unit)'
        )
    positions = np.where(hinge, np.radians(recorded), recorded) if degrees else recorded
    if (problem := _beyond(positions, robot, joints)) is not None:
        joint, row = problem
        other = np.where(hinge, np.radians(recorded), recorded)
        fits = not degrees and _beyond(other, robot, joints) is None
        hint = (
            'In degrees they all fit: set angle_unit = "degrees". (recording.angle_unit)'
            if fits
            else "The dataset's zero, sign or unit is not the model's, or its names are of other "
            "joints. (recording.names, recording.angle_unit)"
        )
        raise InputError(
            f"{name}: {quote(joints[joint])} is at {recorded[row, joint]:.4g} "
            f"{recording.angle_unit if hinge[joint] else 'm'} in frame {row}, beyond its limits. "
            f"{hint}"
        )
    opening = _openings(values[:, -1], recording, robot, name)
    q = np.tile(robot.home, (len(values), 1))
    q[:, robot.joint_at] = positions
    return q, opening


def _beyond(
    positions: np.ndarray, robot: RobotModel, joints: Sequence[str]
) -> tuple[int, int] | None:
    """Return the joint and the frame that are farthest beyond a limit, or None."""
    excess = np.zeros(positions.shape)
    for n, joint in enumerate(joints):
        low, high = limits_of(robot.mj, joint) or (-MAX_TURN, MAX_TURN)
        room = BEYOND_M if is_slide(robot.mj, joint) else BEYOND
        beyond = np.maximum(low - positions[:, n], positions[:, n] - high)
        excess[:, n] = beyond - room
    row, joint = np.unravel_index(excess.argmax(), excess.shape)
    return None if excess.max() <= 0 else (int(joint), int(row))


def _openings(
    values: np.ndarray, recording: OwnRecording, robot: RobotModel, name: str
) -> Float[np.ndarray, " f"]:
    """Return the opening in meters of recorded values of the gripper."""
    closed, opened = recording.gripper_closed, recording.gripper_open
    share = (values - closed) / (opened - closed)
    worst = int(np.abs(share - 0.5).argmax())
    if abs(share[worst] - 0.5) > 0.5 + BEYOND_SHARE:
        raise InputError(
            f"{name}: {quote(recording.gripper)} is {values[worst]:.4g} in frame {worst}, and the "
            f"gripper is closed at {closed:g} and open at {opened:g}: give the recorded values of "
            "both ends. (recording.gripper_closed, recording.gripper_open)"
        )
    share = np.clip(share, 0.0, 1.0)
    if recording.gripper_moves == "opening":
        return share * robot.largest_m
    gripper, mj = robot.arm.gripper, robot.mj
    place = int(mj.joint(gripper.driver).qposadr[0])
    drive = robot.positions[:, robot.gripper_at.tolist().index(place)]
    wanted = gripper.closed + share * (gripper.open - gripper.closed)
    sign = 1 if gripper.open > gripper.closed else -1
    return np.interp(sign * wanted, sign * drive, robot.openings_m)


def _check_size(image: np.ndarray, camera: OwnCamera, root: Path) -> None:
    if image.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"The video of {quote_path(root)} is {image.shape[1]}x{image.shape[0]}, and the "
            f"camera is described for {camera.width}x{camera.height}: intrinsics_px, width and "
            "height must be of the recorded video. (camera)"
        )


def _check_seen(points: np.ndarray, camera: OwnCamera, described: Description) -> None:
    """Raise `InputError` if the camera never sees the gripper, with the matrix that would."""
    if _share(points, camera, camera.base_from_camera):
        return
    others = {
        "its inverse": invert(camera.base_from_camera),
        "its axes of OpenGL turned to OpenCV's (y and z negated)": camera.base_from_camera @ FLIP,
        "the inverse, turned from OpenGL's axes": invert(camera.base_from_camera) @ FLIP,
    }
    better = {key: _share(points, camera, pose) for key, pose in others.items()}
    best = max(better, key=better.__getitem__)
    hint = f" With {best} it is seen in {better[best]:.0%} of the frames." if better[best] else ""
    raise InputError(
        f"{quote_path(described.path)}: the camera sees the gripper in no frame: base_from_camera "
        "must map points of the camera, in OpenCV axes (x right, y down, z forward), to the "
        f"robot's base, in meters.{hint} (camera.base_from_camera)"
    )


def _share(points: np.ndarray, camera: OwnCamera, pose: np.ndarray) -> float:
    """Return the share of points that are in the image of a camera."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    return float(np.mean(pixels_of(_cameras(camera, 1), local)[2]))


def _cameras(camera: OwnCamera, count: int) -> Cameras:
    return Cameras(
        world_from_camera=np.tile(camera.base_from_camera, (count, 1, 1)),
        intrinsics_px=camera.intrinsics_px,
        height=camera.height,
        width=camera.width,
    )
