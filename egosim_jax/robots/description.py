"""Description of a robot that is not in the table: a TOML file next to its URDF or MJCF.

    model = "my_arm.urdf"
    base = "base_link"
    joints = ["joint1", "joint2", "joint3", "joint4", "joint5", "joint6", "joint7"]

    [gripper]
    joints = ["finger1", "finger2"]
    closing_sign = -1
    largest_opening_m = 0.08
    tips = [{frame = "left_tip"}, {frame = "right_tip", offset_m = [0.0, 0.0, 0.01]}]

docs/robot.md has all keys. Lengths are in meters and angles in radians. The first joint of the
gripper drives the fingers. The frame of the base has its z axis upwards.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Float

from egosim_jax.io.bounded import quote, quote_path, quote_text, read_bytes
from egosim_jax.robots.arms import Point
from egosim_jax.robots.toml import Table
from egosim_jax.types import Cameras, InputError

SUFFIX = ".toml"
"""Suffix of a description."""
MAX_BYTES = 1 << 20
"""Maximum size of a description in bytes."""
GRIPPER_SPEED_M_S = 0.1
"""Speed of an opening, unless a description gives it."""
Unit = Literal["radians", "degrees"]
Moves = Literal["joint", "opening"]


@dataclass(frozen=True, kw_only=True)
class Tip:
    """Point of a finger that touches what it grasps."""

    frame: str
    """Name of a link, body or site."""
    offset_m: Point = (0.0, 0.0, 0.0)
    """Position of the point in that frame."""


@dataclass(frozen=True, kw_only=True)
class OwnGripper:
    """Gripper of a description."""

    joints: tuple[str, ...]
    """Joint that drives the fingers, and the joints that follow it."""
    closing_sign: int
    """1 if the fingers close while the position of the driving joint grows, else -1."""
    largest_opening_m: float
    """Largest distance between the fingers, to be compared with the model's."""
    tips: tuple[Tip, Tip]
    """Tip of each finger."""
    closed_at: float | None = None
    """Position of the driving joint at which the fingers touch; None: the end of its limits."""
    open_at: float | None = None
    """Position at which they are farthest apart; None: the other end."""
    speed_m_s: float = GRIPPER_SPEED_M_S
    """Maximum speed of the opening."""
    body: str | None = None
    """Body that the fingers are mounted on; None: the last one that both tips hang on."""
    approach: Point | None = None
    """Direction of the fingers in axes of the body; None: from its origin to the closed tips."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class OwnCamera:
    """Camera of recorded videos, at rest in the frame of the robot's base."""

    base_from_camera: Float[np.ndarray, "4 4"]
    """Pose in OpenCV axes."""
    intrinsics_px: Float[np.ndarray, "3 3"]
    """Pinhole intrinsics of the recorded video."""
    width: int
    """Columns of the recorded video."""
    height: int
    """Rows of the recorded video."""


@dataclass(frozen=True, kw_only=True)
class OwnRecording:
    """Columns and units of LeRobot datasets of a robot."""

    angle_unit: Unit
    """Unit of hinges."""
    names: tuple[str, ...] = ()
    """Name of each joint of the arm in the dataset; empty: the model's names."""
    camera: str | None = None
    """Feature of the video; None: the only one."""
    gripper: str
    """Name of the gripper's value."""
    gripper_closed: float
    """Recorded value of the closed gripper."""
    gripper_open: float
    """Recorded value of the gripper at its largest opening."""
    gripper_moves: Moves = "joint"
    """Quantity that is linear in the recorded values."""


@dataclass(frozen=True, kw_only=True)
class Description:
    """Robot that is not in the table."""

    path: Path
    """File of the description."""
    name: str
    """Name in files and reports."""
    title: str
    """Name for readers."""
    model: Path
    """File of the URDF or MJCF."""
    base: str
    """Body or site whose frame is the base's."""
    joints: tuple[str, ...]
    """Joints of the arm from base to wrist."""
    speeds: tuple[float, ...] = ()
    """Maximum speed of each joint; empty: the model's."""
    home: tuple[float, ...] = ()
    """Posture where a search begins; empty: the middle of the limits."""
    gripper: OwnGripper
    """The gripper."""
    fixed: Mapping[str, float] = field(default_factory=dict)
    """Positions of joints that rest."""
    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Limits of joints that have none in the model."""
    packages: Mapping[str, Path] = field(default_factory=dict)
    """Folder of each package that the URDF names."""
    camera: OwnCamera | None = None
    """Camera of recorded videos."""
    recording: OwnRecording | None = None
    """Columns of recorded datasets."""


def read_description(path: Path) -> Description:
    """Read a description. Raises `InputError` for a missing, unknown or implausible value."""
    name = quote_path(path)
    data = read_bytes(path, limit=MAX_BYTES)
    try:
        values = tomllib.loads(data.decode("utf-8"))
    except RecursionError:
        raise InputError(f"{name} is nested too deeply for a robot's description.") from None
    except ValueError as error:
        raise InputError(f"{name} is not valid TOML: {quote_text(str(error))}.") from error
    table = Table(values, name)
    folder = path.parent
    joints = table.texts("joints")
    named = table.text("name", path.stem)
    described = Description(
        path=path,
        name=named,
        title=table.text("title", named),
        model=folder / table.text("model"),
        base=table.text("base"),
        joints=joints,
        speeds=tuple(table.numbers("speeds", len(joints), (), low=0.0)),
        home=tuple(table.numbers("home", len(joints), ())),
        gripper=_gripper(table.table("gripper")),
        fixed={key: table.number_of(f"fixed.{key}", v) for key, v in table.open("fixed").items()},
        limits={
            key: _range(table.numbers_of(f"limits.{key}", v, 2), f"{name}: limits.{key}")
            for key, v in table.open("limits").items()
        },
        packages={
            key: folder / table.text_of(f"packages.{key}", v)
            for key, v in table.open("packages").items()
        },
        camera=_camera(table.table("camera")) if "camera" in values else None,
        recording=_recording(table.table("recording"), joints) if "recording" in values else None,
    )
    table.end()
    _check_roles(described, name)
    return described


def _gripper(table: Table) -> OwnGripper:
    tips = [_tip(table.item("tips", n, tip)) for n, tip in enumerate(table.pair("tips"))]
    sign = table.number("closing_sign")
    if sign not in (1, -1):
        raise InputError(
            f"{table.place('closing_sign')} is {sign:g}: it must be 1 if the gripper closes while "
            "the position of its first joint grows, else -1."
        )
    approach = table.numbers("approach", 3, ())
    if approach and not np.linalg.norm(approach) > 1e-6:
        raise InputError(f"{table.place('approach')} is 0: it must be a direction.")
    length = float(np.linalg.norm(approach)) if approach else 1.0
    gripper = OwnGripper(
        joints=table.texts("joints"),
        closing_sign=int(sign),
        largest_opening_m=table.number("largest_opening_m", low=0.0),
        tips=(tips[0], tips[1]),
        closed_at=table.number("closed_at") if "closed_at" in table.values else None,
        open_at=table.number("open_at") if "open_at" in table.values else None,
        speed_m_s=table.number("speed_m_s", GRIPPER_SPEED_M_S, low=0.0),
        body=table.text("body", "") or None,
        approach=_point([value / length for value in approach]) if approach else None,
    )
    table.end()
    return gripper


def _tip(table: Table) -> Tip:
    tip = Tip(
        frame=table.text("frame"), offset_m=_point(table.numbers("offset_m", 3, (0.0, 0.0, 0.0)))
    )
    table.end()
    return tip


def _camera(table: Table) -> OwnCamera:
    camera = OwnCamera(
        base_from_camera=table.matrix("base_from_camera", 4),
        intrinsics_px=table.matrix("intrinsics_px", 3),
        width=table.count("width"),
        height=table.count("height"),
    )
    table.end()
    try:
        Cameras(
            world_from_camera=camera.base_from_camera[None],
            intrinsics_px=camera.intrinsics_px,
            height=camera.height,
            width=camera.width,
        )
    except InputError as error:
        raise InputError(f"{table.name}: {error} (base_from_camera, intrinsics_px)") from error
    return camera


def _recording(table: Table, joints: tuple[str, ...]) -> OwnRecording:
    recording = OwnRecording(
        angle_unit=table.choice("angle_unit", ("radians", "degrees")),
        names=table.texts("names", ()),
        camera=table.text("camera", "") or None,
        gripper=table.text("gripper"),
        gripper_closed=table.number("gripper_closed"),
        gripper_open=table.number("gripper_open"),
        gripper_moves=table.choice("gripper_moves", ("joint", "opening"), "joint"),
    )
    table.end()
    if recording.names and len(recording.names) != len(joints):
        raise InputError(
            f"{table.place('names')} has {len(recording.names)} names: it must have one for each "
            f"of the {len(joints)} joints of the arm, in their order."
        )
    if recording.gripper_closed == recording.gripper_open:
        raise InputError(
            f"{table.place('gripper_open')} is {recording.gripper_open:g}, like gripper_closed: "
            "they must be the two ends of the recorded values."
        )
    return recording


def _check_roles(described: Description, name: str) -> None:
    """Raise `InputError` for a joint with two roles."""
    roles = [*described.joints, *described.gripper.joints, *described.fixed]
    twice = [joint for joint in dict.fromkeys(roles) if roles.count(joint) > 1]
    if twice:
        raise InputError(
            f"{name} has the joint {quote(twice[0])} more than once: a joint is of the arm, of the "
            "gripper, or fixed. Remove it from the others. (joints, gripper.joints, fixed)"
        )


def _range(values: list[float], name: str) -> tuple[float, float]:
    low, high = values
    if not low < high:
        raise InputError(f"{name} is [{low:g}, {high:g}]: the first limit must be below the other.")
    return low, high


def _point(values: Iterable[float]) -> Point:
    x, y, z = values
    return float(x), float(y), float(z)
