"""Actions as rows of numbers, the coordinates in which a policy moves hands and camera.

There is one row per frame. It has the numbers of each hand, then six for the camera if the
`ActionSpec` includes it:

    keypoints  63 per hand: 21 joints in the world, in meters, ordered as in `simulation/episode.py`
    wrist       7 per hand: wrist position in meters, rotation vector, closure from 0 to 1
    gripper     7 per hand: the same numbers for a gripper, whose fingers close
    camera      6: translation in meters and rotation vector, in the axes of the first camera

Hands are in the world frame. Without rotation the fingers point along y, and the back of the hand
faces z (`worlds/tabletop/hands.py`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, no_type_check

import cv2
import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.io.bounded import quote
from egosim_jax.rendering.mesh import Side
from egosim_jax.runtime.terminal import counted
from egosim_jax.simulation.actions import with_all_joints
from egosim_jax.simulation.rig import wrist_poses
from egosim_jax.types import JOINTS, Action, Cameras, InputError, Kind, near_view
from egosim_jax.worlds.tabletop.hands import joints_of

Layout = Literal["keypoints", "wrist", "gripper"]
LAYOUTS: tuple[Layout, ...] = ("keypoints", "wrist", "gripper")
HAND_NAMES = ("x", "y", "z", "rx", "ry", "rz", "closure")
CAMERA_NAMES = ("camera x", "camera y", "camera z", "camera rx", "camera ry", "camera rz")
REST = (0.15, 0.02, 0.16, -0.5, 0.0, 0.4, 0.25)
"""Resting right hand: position in meters, rotation vector in radians, closure."""
REST_MARGIN = 0.05
"""Minimum distance of a resting row to each bound, as a fraction of the range."""


def to_numbers(rows: object) -> Float[np.ndarray, ...]:
    """Return rows as an array.

    Raises `InputError` for text, rows of unequal length, and integers beyond 64 bits.
    """
    try:
        numbers = np.asarray(rows)
    except (TypeError, ValueError, OverflowError):
        numbers = np.empty(0, object)
    if numbers.dtype.kind not in "biuf":
        raise InputError(f"The actions are {quote(rows)}: they must be rows of numbers.")
    return numbers.astype(np.float64)


@no_type_check
@dataclass(frozen=True, kw_only=True)
class ActionSpec:
    """Layout and bounds of action rows."""

    layout: Layout = "wrist"
    """Representation of a hand."""
    sides: tuple[Side, ...] = ("right",)
    """Hands, in the order of a row."""
    camera: bool = False
    """Append the camera pose to each row; without it the camera does not move."""
    workspace_m: tuple[tuple[float, float, float], tuple[float, float, float]] = (
        (-0.35, -0.03, 0.0),
        (0.35, 0.55, 0.40),
    )
    """Minimum and maximum position of a wrist or joint in the world, in meters."""
    camera_reach: tuple[float, float] = (0.15, 0.35)
    """Maximum translation (meters) and rotation (radians) of the camera, per axis."""

    def __post_init__(self) -> None:
        """Raise `InputError` for an unknown layout, no hands, or an empty workspace or reach."""
        if self.layout not in LAYOUTS:  # a client can send any string
            raise InputError(
                f"There is no action layout {str(self.layout)[:40]!r}: it must be one of "
                f"{', '.join(LAYOUTS)}."
            )
        if sorted(self.sides) not in (["left"], ["right"], ["left", "right"]):
            raise InputError(
                f"The hands are {self.sides!r:.60}: give 'left', 'right' or one of each."
            )
        low, high = np.array(self.workspace_m, float)
        if not (np.isfinite([low, high]).all() and (low < high).all()):
            raise InputError(
                f"The workspace is {self.workspace_m!r:.120}: it must be the lowest and the "
                "highest x, y and z in meters."
            )
        translation_m, turn = self.camera_reach
        if not (0 < translation_m < np.inf and 0 < turn <= np.pi):
            raise InputError(
                f"The reach of the camera is {self.camera_reach!r:.60}: it must be a translation "
                "above 0 in meters and a rotation above 0 and at most pi in radians."
            )

    @property
    def kind(self) -> Kind:
        """Kind of the hands."""
        return "robot" if self.layout == "gripper" else "human"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Name of each number of a row."""
        joints = [f"joint {joint} {axis}" for joint in range(JOINTS["human"]) for axis in "xyz"]
        of_hand = joints if self.layout == "keypoints" else HAND_NAMES
        hands = [f"{side} {name}" for side in self.sides for name in of_hand]
        return (*hands, *(CAMERA_NAMES if self.camera else ()))

    @cached_property
    def bounds(self) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
        """Lowest and highest value of each number of a row."""
        turn = (np.pi,) * 3
        ends = []
        for sign, place, closure in zip((-1, 1), self.workspace_m, (0.0, 1.0), strict=True):
            hand = (
                place * JOINTS["human"]
                if self.layout == "keypoints"
                else (*place, *(sign * angle for angle in turn), closure)
            )
            camera = [sign * reach for reach in self.camera_reach for _ in "xyz"]
            ends.append([*hand * len(self.sides), *(camera if self.camera else ())])
        return np.array(ends[0], float), np.array(ends[1], float)

    @cached_property
    def rest(self) -> Float[np.ndarray, " d"]:
        """Row of resting hands in front of the wearer, with a margin to the bounds."""
        row: list[float] = []
        for side in self.sides:
            mirror = np.array([-1, 1, 1, 1, -1, -1, 1]) if side == "left" else 1
            hand = np.array(REST) * mirror
            hand[:3] = _inside(hand[:3], *np.array(self.workspace_m))
            keypoints = self.layout == "keypoints"
            row += self._placed(hand, side).ravel().tolist() if keypoints else hand.tolist()
        return _inside(np.array([*row, *([0.0] * 6 if self.camera else [])]), *self.bounds)

    def check_row(self, row: object) -> Float[np.ndarray, " d"]:
        """Return one row as an array; raise `InputError` as `check` does."""
        numbers = to_numbers(row)
        if numbers.shape != (len(self.names),):
            raise InputError(
                f"The action has shape {numbers.shape}: a step takes one row of {self.about}, of "
                f"shape ({len(self.names)},). Give several rows, one for each frame, to "
                "env.unwrapped.chunk_step."
            )
        return self.check(numbers[None], max_rows=1)[0]

    @property
    def about(self) -> str:
        """Words for what a row has."""
        camera = "and the camera" if self.camera else "without a camera"
        return f"{self.layout} of {counted(len(self.sides), 'hand')} {camera}"

    def check(self, rows: object, *, max_rows: int) -> Float[np.ndarray, "k d"]:
        """Return 1 to `max_rows` rows as an array.

        Raises `InputError` for a wrong shape, a value that is not finite or one out of bounds.
        """
        numbers = to_numbers(rows)
        if (
            numbers.ndim != 2
            or not 1 <= len(numbers) <= max_rows
            or numbers.shape[1] != len(self.names)
        ):
            raise InputError(
                f"The actions have shape {numbers.shape}: {self.about} must have 1 to {max_rows} "
                f"rows of {len(self.names)} numbers."
            )
        finite = np.isfinite(numbers)
        if not finite.all():
            row, column = np.argwhere(~finite)[0].tolist()
            raise InputError(
                f"Row {row} of the actions has {numbers[row, column]} as {self.names[column]}: all "
                "must be finite. Give a hand that is out of view its last place: it is hidden from "
                "the model, and listed in hidden_hands."
            )
        low, high = self.bounds
        # float32 rounds some bounds outward
        outside = (numbers < low - 1e-6) | (numbers > high + 1e-6)
        if outside.any():
            row, column = np.argwhere(outside)[0].tolist()
            raise InputError(
                f"Row {row} of the actions has {numbers[row, column]:.4g} as {self.names[column]}: "
                f"it must be from {low[column]:.4g} to {high[column]:.4g}. Positions are in "
                "meters in the world, rotations in radians."
            )
        return numbers

    def to_action(
        self,
        rows: Float[np.ndarray, "k d"],
        *,
        camera: Cameras,
        prompt: str,
    ) -> tuple[Action, Bool[np.ndarray, " n"]]:
        """Return the action of one row per frame, and a mask of the hidden hands.

        `camera` is the first camera of the episode. A hand that never comes near the view is
        missing in the action, which is then a `FullAction`.
        """
        cameras = self.cameras_of(rows, camera)
        joints = self.joints(rows)
        lost = np.logical_not(near_view(cameras, joints).any(axis=0, keepdims=True))[0]
        seen = np.where(lost[None, :, None, None], np.nan, joints)
        action = Action(cameras=cameras, joints_m=seen, kind=self.kind, prompt=prompt)
        return with_all_joints(action, joints) if lost.any() else action, lost

    def joints(self, rows: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k n j 3"]:
        """Return the joints of each row's hands in the world, in meters."""
        keypoints = self.layout == "keypoints"
        count = 3 * JOINTS["human"] if keypoints else len(HAND_NAMES)
        hands = rows[:, : count * len(self.sides)].reshape(len(rows), len(self.sides), count)
        if keypoints:
            return hands.reshape(len(rows), len(self.sides), JOINTS["human"], 3)
        return np.stack(
            [
                [self._placed(hand, side) for hand, side in zip(row, self.sides, strict=True)]
                for row in hands
            ]
        )

    def wrists(self, rows: Float[np.ndarray, "k d"]) -> Float[np.ndarray, "k n 4 4"]:
        """Return world_from_wrist of each row's hands (`simulation/rig.py`)."""
        if self.layout == "keypoints":
            paths = np.moveaxis(self.joints(rows), 1, 0)
            sided = zip(paths, self.sides, strict=True)
            return np.stack([wrist_poses(path, self.kind, side) for path, side in sided], axis=1)
        count = len(self.sides)
        hands = rows[:, : len(HAND_NAMES) * count].reshape(len(rows), count, len(HAND_NAMES))
        poses = np.tile(np.eye(4), (len(rows), count, 1, 1))
        poses[..., :3, 3] = hands[..., :3]
        for frame, hand in np.ndindex(len(rows), count):
            poses[frame, hand, :3, :3] = cv2.Rodrigues(hands[frame, hand, 3:6])[0]
        return poses

    def _placed(self, hand: np.ndarray, side: Side) -> Float[np.ndarray, "j 3"]:
        rotation = cv2.Rodrigues(hand[3:6])[0]
        return joints_of(self.kind, float(hand[6]), side) @ rotation.T + hand[:3]

    def cameras_of(self, rows: Float[np.ndarray, "k d"], camera: Cameras) -> Cameras:
        """Return the main camera of each row; `camera` is the first one of the episode."""
        poses = np.repeat(camera.world_from_camera[:1], len(rows), axis=0)
        if not self.camera:
            return replace(camera, world_from_camera=poses)
        moves = np.repeat(np.eye(4)[None], len(rows), axis=0)
        for move, row in zip(moves, rows[:, -6:], strict=True):
            move[:3, :3], move[:3, 3] = cv2.Rodrigues(row[3:])[0], row[:3]
        return replace(camera, world_from_camera=poses @ moves)

    def to_json(self) -> dict[str, Any]:
        """Return the fields as JSON."""
        return {
            "layout": self.layout,
            "sides": list(self.sides),
            "camera": self.camera,
            "workspace_m": [list(corner) for corner in self.workspace_m],
            "camera_reach": list(self.camera_reach),
        }

    @classmethod
    def from_json(cls, fields: Mapping[str, Any]) -> ActionSpec:
        """Read the spec of a client or file; missing fields have their defaults.

        Raises `InputError` for an unknown field or a wrong type.
        """
        defaults = cls().to_json()
        if unknown := sorted(fields.keys() - defaults.keys()):
            raise InputError(
                f"The actions have no setting {quote(unknown[0])}: choose from "
                f"{', '.join(defaults)}."
            )
        given = {**defaults, **fields}
        corners, reach, sides = given["workspace_m"], given["camera_reach"], given["sides"]
        shapes = _shape(corners) == (2, 3) and _shape(reach) == (2,)
        texts = isinstance(sides, list) and all(isinstance(side, str) for side in sides)
        if not (shapes and texts and isinstance(given["camera"], bool)):
            raise InputError(
                "The actions need sides, a list of 'left' and 'right', camera, true or false, "
                "workspace_m, two corners of three numbers in meters, and camera_reach, two "
                "numbers."
            )
        values: Any = {
            "layout": given["layout"],
            "sides": tuple(sides),
            "camera": given["camera"],
            "workspace_m": tuple(tuple(map(float, corner)) for corner in corners),
            "camera_reach": tuple(map(float, reach)),
        }
        return cls(**values)


def _inside(
    values: Float[np.ndarray, " d"], low: Float[np.ndarray, " d"], high: Float[np.ndarray, " d"]
) -> Float[np.ndarray, " d"]:
    """Return values with a margin to their bounds: a policy's noise must not leave them at once."""
    margin = REST_MARGIN * (high - low)
    return np.clip(values, low + margin, high - margin)


def _shape(value: Any) -> tuple[int, ...] | None:
    try:
        return to_numbers(value).shape
    except InputError:
        return None
