"""Further cameras of a clip: fixed in the world, on the head, or on a wrist.

    wrist = MountedCamera(name="wrist", mount="right_wrist", pose=..., field_of_view_deg=90)
    simulator = replace(simulator, rig=Rig(cameras=(wrist,)))
    simulator.step(state, action, seed=1).others["wrist"].clip

A wrist has the axes of an action's row: the origin is keypoint 0, y is along the fingers
and z out of the back of the hand; a gripper opens along x. All cameras see the same state and the
same predicted motion, so their clips agree. Their frames have the size of the main camera's.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args, no_type_check

import numpy as np
from jaxtyping import Float

from egosim_jax.io.bounded import quote
from egosim_jax.rendering.gripper_mesh import MIN_OPENING_M, across_of
from egosim_jax.rendering.hand_mesh import palm_rotations
from egosim_jax.rendering.mesh import Side
from egosim_jax.simulation.actions import all_joints_of, with_all_joints
from egosim_jax.types import Action, Cameras, InputError, Kind, seen_hands
from egosim_jax.types.cameras import is_rigid

Mount = Literal["world", "head", "left_wrist", "right_wrist"]
MOUNTS: tuple[Mount, ...] = get_args(Mount)
NAMES = re.compile(r"[a-z][a-z0-9_]{0,31}")
"""Valid names of cameras."""
MAIN = "ego"
"""Name of the main camera in datasets, which no other camera has."""
FIELDS_OF_VIEW = (5.0, 150.0)
"""Minimum and maximum horizontal field of view in degrees."""
MAX_AWAY_M = 5.0
"""Maximum distance of a camera from its mount, or from the origin of the world, in meters."""
MAX_CAMERAS = 8
"""Maximum number of further cameras."""
Matrix = tuple[tuple[float, ...], ...]


@no_type_check
@dataclass(frozen=True, kw_only=True)
class MountedCamera:
    """Camera that is fixed to the world, the head or a wrist."""

    name: str
    """Name in observations: lowercase letters, digits and _."""
    mount: Mount
    """Frame to which the camera is fixed."""
    pose: Matrix | np.ndarray
    """Rigid transform mount_from_camera, 4x4 in meters, in OpenCV axes; from the world if fixed."""
    field_of_view_deg: float | None = None
    """Horizontal field of view in degrees, with the principal point in the middle."""
    intrinsics_px: Matrix | np.ndarray | None = None
    """Intrinsics 3x3 in pixels of a frame; without either, the lens of the main camera."""

    def __post_init__(self) -> None:
        """Convert arrays to tuples. Raises `InputError` for a name, mount, pose or lens."""
        if not isinstance(self.name, str) or not NAMES.fullmatch(self.name) or self.name == MAIN:
            raise InputError(
                f"The name of a camera is {quote(self.name)}: it must have 1 to 32 lowercase "
                f"letters, digits or _, begin with a letter, and not be {MAIN!r}, the main camera. "
                "(cameras)"
            )
        if self.mount not in MOUNTS:
            raise InputError(
                f"Camera {self.name} has the mount {quote(self.mount)}: it must be one of "
                f"{', '.join(MOUNTS)}. (cameras)"
            )
        object.__setattr__(self, "pose", self._matrix("pose", 4))
        pose = np.array(self.pose)
        if not is_rigid(pose[None]).all() or np.linalg.norm(pose[:3, 3]) > MAX_AWAY_M:
            raise InputError(
                f"Camera {self.name} has the pose {quote(self.pose)}: it must be a rigid transform "
                "4x4 with a rotation of determinant 1 and the last row 0 0 0 1, at most "
                f"{MAX_AWAY_M:g} m from its mount. Give mount_from_camera in meters. (cameras)"
            )
        self._check_lens()

    def _check_lens(self) -> None:
        angle, (low, high) = self.field_of_view_deg, FIELDS_OF_VIEW
        if angle is not None and self.intrinsics_px is not None:
            raise InputError(
                f"Camera {self.name} has a field of view and intrinsics: give one. (cameras)"
            )
        if self.intrinsics_px is not None:
            object.__setattr__(self, "intrinsics_px", self._matrix("intrinsics_px", 3))
        elif angle is not None:
            number = isinstance(angle, int | float) and not isinstance(angle, bool)
            if not number or not low <= angle <= high:
                raise InputError(
                    f"Camera {self.name} has a field of view of {quote(angle)}: it must be from "
                    f"{low:g} to {high:g} degrees, across the image. (cameras)"
                )

    def _matrix(self, field: str, size: int) -> Matrix:
        try:
            matrix = np.array(getattr(self, field), float)
        except (TypeError, ValueError):
            matrix = np.zeros(0)
        if matrix.shape != (size, size) or not np.isfinite(matrix).all():
            raise InputError(
                f"Camera {self.name} has the {field} {quote(getattr(self, field))}: it must be "
                f"{size} rows of {size} finite numbers. (cameras)"
            )
        rows: Any = matrix.tolist()
        return tuple(tuple(row) for row in rows)

    @property
    def side(self) -> Side | None:
        """Hand that carries the camera, if one does."""
        sides: dict[Mount, Side] = {"left_wrist": "left", "right_wrist": "right"}
        return sides.get(self.mount)

    def path(self, main: Cameras, wrist: Float[np.ndarray, "f 4 4"] | None = None) -> Cameras:
        """Return the camera in each frame of the main camera's path, with its image size.

        `wrist` is world_from_wrist of the hand that carries the camera. Raises `InputError` if the
        intrinsics do not fit the image size.
        """
        mount = np.asarray(main.world_from_camera, float)
        if self.side is not None:
            mount = np.asarray(wrist, float)
        elif self.mount == "world":
            mount = np.repeat(np.eye(4)[None], len(mount), axis=0)
        intrinsics = np.asarray(main.intrinsics_px, float)
        if self.intrinsics_px is not None:
            intrinsics = np.array(self.intrinsics_px)
        elif self.field_of_view_deg is not None:
            focal = main.width / 2 / np.tan(np.radians(self.field_of_view_deg) / 2)
            middle = (main.width - 1) / 2, (main.height - 1) / 2
            intrinsics = np.array([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]])
        poses = mount @ np.array(self.pose)
        try:
            return replace(main, world_from_camera=poses, intrinsics_px=intrinsics)
        except InputError as error:
            raise InputError(f"Camera {self.name}: {error} (cameras)") from error

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON."""
        lens = {"field_of_view_deg": self.field_of_view_deg, "intrinsics_px": self.intrinsics_px}
        return {
            "name": self.name,
            "mount": self.mount,
            "pose": _listed(self.pose),
            **{name: _listed(value) for name, value in lens.items() if value is not None},
        }

    @classmethod
    def from_json(cls, fields: Any) -> MountedCamera:
        """Read a client's camera. Raises `InputError` for missing or unknown fields."""
        names = tuple(cls.__dataclass_fields__)
        required = names[:3]
        if not isinstance(fields, Mapping) or not {*required} <= fields.keys() <= {*names}:
            raise InputError(
                f"A camera is {quote(fields)}: it must be a map of {', '.join(required)} and "
                f"maybe {' or '.join(names[3:])}. (cameras)"
            )
        return cls(**fields)


def _listed(value: Any) -> Any:
    return [list(row) for row in value] if isinstance(value, tuple) else value


def check_cameras(cameras: Any, sides: Sequence[Side]) -> tuple[MountedCamera, ...]:
    """Return cameras as a tuple. Raises `InputError` unless they fit together and the hands."""
    given = isinstance(cameras, list | tuple)
    listed: tuple[MountedCamera, ...] = tuple(cameras) if given else ()
    if not given or not all(isinstance(camera, MountedCamera) for camera in listed):
        raise InputError(
            f"cameras is {quote(cameras)}: it must be a list of MountedCamera. (cameras)"
        )
    if len(listed) > MAX_CAMERAS:
        raise InputError(f"There are {len(listed)} cameras: at most {MAX_CAMERAS}. (cameras)")
    names = [camera.name for camera in listed]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"Two cameras are named {twice[0]!r}: rename one of them. (cameras)")
    for camera in listed:
        if camera.side is not None and camera.side not in sides:
            raise InputError(
                f"Camera {camera.name} is on the {camera.side} wrist, and the action has only the "
                f"hands {', '.join(sides)}: mount it elsewhere, or add this hand to the sides of "
                "the ActionSpec. (cameras)"
            )
    return listed


@no_type_check
@dataclass(frozen=True, kw_only=True, eq=False)
class Rig:
    """Further cameras of a clip, and the hands that may carry them."""

    cameras: tuple[MountedCamera, ...]
    """The cameras."""
    sides: tuple[Side, ...] = ("right",)
    """Side of each hand of the action, in its order."""
    wrists: Float[np.ndarray, "f n 4 4"] | None = None
    """Poses of the wrists in the frames of the clip; None: estimated from the joints."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless the cameras fit together and the hands."""
        check_cameras(self.cameras, self.sides)

    def paths(self, main: Cameras) -> dict[str, Cameras]:
        """Return each camera along the main camera's path, by name; a wrist's needs `wrists`."""
        return {c.name: c.path(main, self._of_hand(c, self.wrists)) for c in self.cameras}

    def actions(self, action: Action, start: int = 0) -> dict[str, Action]:
        """Return the action as each camera sees it, by name; it begins at a frame of the clip.

        Raises `InputError` for a hand that carries a camera and is missing from a frame.
        """
        joints, frames = all_joints_of(action), slice(start, start + len(action.joints_m))
        if joints.shape[1] != len(self.sides):
            raise InputError(
                f"The action has {joints.shape[1]} hands, the rig has the sides "
                f"{', '.join(self.sides)}: give the side of each hand. (Rig.sides)"
            )
        seen = {}
        for camera in self.cameras:
            if self.wrists is not None:
                wrist = self._of_hand(camera, self.wrists[frames])
            else:
                wrist = _estimated(camera, self._of_hand(camera, joints), action.kind)
            seen[camera.name] = _seen_from(camera.path(action.cameras, wrist), action, joints)
        return seen

    def _of_hand(self, camera: MountedCamera, values: np.ndarray | None) -> np.ndarray | None:
        """Return the values (frames, hands, ...) of the hand that carries a camera, if one does."""
        if camera.side is None or values is None:
            return None
        return values[:, self.sides.index(camera.side)]


def _estimated(
    camera: MountedCamera, joints_m: np.ndarray | None, kind: Kind
) -> Float[np.ndarray, "f 4 4"] | None:
    if joints_m is None or camera.side is None:
        return None
    try:
        return wrist_poses(joints_m, kind, camera.side)
    except InputError as error:
        raise InputError(f"Camera {camera.name}: {error} (cameras)") from error


def _seen_from(cameras: Cameras, action: Action, joints_m: np.ndarray) -> Action:
    """Return the action with another camera; hands that it never sees are missing."""
    seen = seen_hands(cameras, joints_m)
    action = Action(cameras=cameras, joints_m=seen, kind=action.kind, prompt=action.prompt)
    hidden = np.isfinite(joints_m).all() and not np.isfinite(seen).all()
    return with_all_joints(action, joints_m) if hidden else action


def wrist_poses(
    joints_m: Float[np.ndarray, "f j 3"], kind: Kind, side: Side
) -> Float[np.ndarray, "f 4 4"]:
    """Return world_from_wrist of a hand in each frame, from its joints.

    Raises `InputError` if the hand is missing from a frame, or a gripper is closed in all of them.
    """
    present = np.isfinite(joints_m).all(axis=(1, 2))
    if not present.all():
        raise InputError(
            f"the {side} hand, which carries it, is missing from frame {int(np.argmin(present))}: "
            "give its joints in all frames, also where the head does not see it (FullAction)."
        )
    poses = np.repeat(np.eye(4)[None], len(joints_m), axis=0)
    poses[:, :3, 3] = joints_m[:, 0]
    if kind == "human":
        poses[:, :3, :3] = palm_rotations(joints_m, side)
        return poses
    along = joints_m[:, 1:].mean(axis=1) - joints_m[:, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    apart = joints_m[:, 2] - joints_m[:, 1]
    if np.linalg.norm(apart, axis=1).max() <= MIN_OPENING_M:
        raise InputError(
            f"the {side} gripper, which carries it, is closed in all frames, so its joints do not "
            f"show how it is turned: open it by {1e3 * MIN_OPENING_M:g} mm, or give Rig.wrists."
        )
    across = across_of(apart[:, None], along[:, None])[:, 0]
    poses[:, :3, :3] = np.stack([across, along, np.cross(across, along)], axis=2)
    return poses
