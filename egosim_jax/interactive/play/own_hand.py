"""A wearer's own hand in the workspace: calibration, pinch, and what happens without a hand.

A hand of a camera has 21 joints in meters in the camera's axes (`perception/video/hands/live.py`).
It is calibrated by an open hand that is held still: its place becomes the middle of the workspace,
and its rotation the one before a grasp. From then on the hand in the workspace moves and turns
alike. The side of the hand that the camera sees shows where the camera is:

    back    on the wearer's head: the axes of the wearer's camera
    palm    in front of the wearer: its x points to the wearer's left, and its z to the wearer
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Literal, no_type_check

import cv2
import numpy as np
from jaxtyping import Float

from egosim_jax.dynamics.hands import PALM
from egosim_jax.interactive.play.moves import MIDDLE_M, Pose
from egosim_jax.rendering.mesh import Side
from egosim_jax.worlds.tabletop.hand_motion import Grip, opened
from egosim_jax.worlds.tabletop.hands import frame_of, joints_of, pinch

Phase = Literal["calibrate", "follow", "hold", "retreat"]
"""Phase: waits for a still hand, follows it, holds without it for a moment, or retreats."""
CALIBRATE_S = 0.8
"""Time for which the open hand is held still, in seconds."""
MIN_FRAMES = 4
"""Minimum number of frames of a calibration, which then may take longer."""
STILL_M, STILL_DEG = np.array([0.05, 0.05, 0.10]), 25.0
"""Maximum motion of a hand that is held still in the camera's axes, in meters, and in degrees."""
HOLD_S = 0.4
"""Time without a hand after which the hand opens and retreats, in seconds."""
PINCH, OPEN = 0.45, 0.6
"""Distances of thumb and index finger below which a hand pinches and above which it opens.

In lengths of the palm."""
HEIGHT_M = 0.13
"""Height of the hand above the table at its calibrated place, in meters."""
FACING = np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]])
"""Rotation from the axes of a camera in front of the wearer to the world."""
MAX_TURN = np.radians(70)
"""Maximum rotation from the calibrated one, in radians; beyond it, the joints are mirrored."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class _Calibration:
    place_m: Float[np.ndarray, " 3"]
    """Middle of the palm in the camera."""
    rotation: Float[np.ndarray, "3 3"]
    """Axes of the hand in the camera."""
    world_from_camera: Float[np.ndarray, "3 3"]
    """Rotation to the world."""


class OwnHand:
    """Mapping from the hand of a camera to a hand in the workspace."""

    def __init__(self, side: Side, wearer: Float[np.ndarray, "3 3"]):
        """Wait for the calibration; `wearer` is the rotation of the wearer's camera."""
        self._side: Side = side
        self._wearer = wearer
        inward = 0.5 if side == "right" else -0.5
        middle = np.array([*MIDDLE_M, HEIGHT_M])
        grip = Grip(point_m=middle, yaw=inward, pitch=np.radians(45), closure=opened("human"))
        self.home = Pose.of_grip(grip)
        """Pose at the calibrated place, where the hand retreats."""
        open_hand = joints_of("human", grip.closure, side)
        self._reach_m = pinch(open_hand)[0] - open_hand[PALM["human"]].mean(axis=0)
        self.calibrate()

    def calibrate(self) -> None:
        """Wait for a calibration."""
        self._calibration: _Calibration | None = None
        self._recent: deque[tuple[float, np.ndarray]] = deque()
        self._last, self._last_s = self.home, -np.inf
        self.pinches = False
        """True while thumb and index finger touch."""
        self.phase: Phase = "calibrate"
        """Phase after the last frame."""

    def see(self, joints_m: Float[np.ndarray, "21 3"] | None, time_s: float) -> Pose:
        """Return the pose in the workspace, from the hand of the next frame or its absence."""
        if joints_m is None:
            if self.phase != "calibrate":
                self.phase = "hold" if time_s - self._last_s <= HOLD_S else "retreat"
            if self.phase == "retreat":
                self.pinches = False
                self._last = self.home
            return self._last
        self._last_s = time_s
        self.pinches = _opening(joints_m) < (OPEN if self.pinches else PINCH)
        if self._calibration is None:
            self._calibration = self._calibrated(joints_m, time_s)
        if self._calibration is not None:
            self.phase, self._last = "follow", self._mapped(joints_m, self._calibration)
        return self._last

    def _calibrated(self, joints_m: np.ndarray, time_s: float) -> _Calibration | None:
        """Return the calibration once an open hand was still for long enough."""
        if self.pinches:
            self._recent.clear()
            return None
        self._recent.append((time_s, joints_m))
        while len(self._recent) > MIN_FRAMES and self._recent[1][0] <= time_s - CALIBRATE_S:
            self._recent.popleft()
        if time_s - self._recent[0][0] < CALIBRATE_S or len(self._recent) < MIN_FRAMES:
            return None
        joints = np.stack([joints for _, joints in self._recent])
        places = joints[:, PALM["human"]].mean(axis=1)
        mean = joints.mean(axis=0)
        rotation = frame_of(mean, "human")[:3, :3]
        turns = [_angle(frame_of(j, "human")[:3, :3].T @ rotation) for j in (joints[0], joints[-1])]
        if (np.ptp(places, axis=0) > STILL_M).any() or max(turns) > np.radians(STILL_DEG):
            return None
        return _Calibration(
            place_m=places.mean(axis=0),
            rotation=rotation,
            world_from_camera=FACING if self._shows_palm(rotation, mean) else self._wearer,
        )

    def _shows_palm(self, rotation: np.ndarray, joints_m: np.ndarray) -> bool:
        """Return True if the palm is towards the camera, and not the back of the hand."""
        back = rotation[:, 2] if self._side == "right" else -rotation[:, 2]
        return bool(back @ joints_m.mean(axis=0) > 0)

    def _mapped(self, joints_m: np.ndarray, calibration: _Calibration) -> Pose:
        """Return the pose in the workspace of a hand in the camera."""
        world = calibration.world_from_camera
        moved = world @ (joints_m[PALM["human"]].mean(axis=0) - calibration.place_m)
        turn = world @ frame_of(joints_m, "human")[:3, :3] @ calibration.rotation.T @ world.T
        within = _angle(turn) <= MAX_TURN
        rotation = turn @ self.home.rotation if within else self._last.rotation
        swing = (rotation - self.home.rotation) @ self._reach_m
        return replace(self.home, point_m=self.home.point_m + moved + swing, rotation=rotation)


def _opening(joints_m: np.ndarray) -> float:
    """Return the distance of the tips of thumb and index finger, in lengths of the palm."""
    palm = np.linalg.norm(joints_m[9] - joints_m[0])
    return float(np.linalg.norm(joints_m[4] - joints_m[8]) / max(palm, 1e-9))


def _angle(rotation: np.ndarray) -> float:
    return float(np.linalg.norm(cv2.Rodrigues(rotation)[0]))


def steps_towards(before: Pose, target: Pose, step_s: float) -> Pose:
    """Return the pose after a time on the way to a target, at limited speeds.

    Without them, a hand that is lost and seen again would jump through objects.
    """
    way = target.point_m - before.point_m
    turn = cv2.Rodrigues(before.rotation.T @ target.rotation)[0]
    closing = target.closure - before.closure
    moved = _within(float(np.linalg.norm(way)), MAX_SPEED_M_S * step_s)
    turned = _within(float(np.linalg.norm(turn)), MAX_TURN_S * step_s)
    return Pose(
        point_m=before.point_m + moved * way,
        rotation=before.rotation @ cv2.Rodrigues(turned * turn)[0],
        closure=before.closure + _within(abs(closing), MAX_CLOSING_S * step_s) * closing,
    )


MAX_SPEED_M_S, MAX_TURN_S, MAX_CLOSING_S = 1.0, 6.0, 2.5
"""Maximum speeds of a hand: meters, radians, and closures per second."""


def _within(length: float, limit: float) -> float:
    """Return the factor that limits a length."""
    return 1.0 if length <= limit else limit / length
