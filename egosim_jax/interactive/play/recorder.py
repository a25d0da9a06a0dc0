"""Recorder of a hand on its way: its poses at the rate of the clips, until they are painted."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from egosim_jax.interactive.play.moves import Pose
from egosim_jax.interactive.play.own_hand import steps_towards

STILL_M, STILL_DEG, STILL_CLOSURE = 0.01, 5.0, 0.02
"""Motion up to which a hand rests: nothing is painted."""


class Recorder:
    """Poses of a hand since a moment; the first ones are painted."""

    def __init__(self, pose: Pose, *, fps: int):
        self._fps, self._changed = fps, threading.Condition()
        self._live = False
        self.rests = False
        """True once all motion is painted."""
        self.begin(pose)

    def begin(self, pose: Pose) -> None:
        """Record from a pose at a moment of the episode; nothing before it counts."""
        with self._changed:
            self._first, self._poses, self._painted = pose, list[Pose](), 0
            self._times_s = list[float]()
            self.pose, self._time_s, self._next_s = pose, -np.inf, -np.inf
            self.taken_s = 0.0

    @property
    def live(self) -> bool:
        """True while the hand is recorded."""
        return self._live

    def pause(self) -> None:
        """Stop to record; a part that waits for poses gets the last one instead."""
        with self._changed:
            self._live = False
            self._changed.notify_all()

    def resume(self, pose: Pose) -> None:
        """Record again, from the pose of the current moment."""
        self.begin(pose)
        self._live = True

    def see(self, target: Pose, time_s: float) -> Pose:
        """Move towards the pose of a camera's frame; return the pose that is reached."""
        with self._changed:
            if not self._live:
                return self.pose
            if not np.isfinite(self._time_s):
                self._time_s, self._next_s = time_s, time_s + 1 / self._fps
                return self.pose
            before, before_s = self.pose, self._time_s
            self.pose = steps_towards(before, target, time_s - before_s)
            self._time_s = time_s
            while self._next_s <= time_s:
                share = (self._next_s - before_s) / max(time_s - before_s, 1e-9)
                self._poses.append(between(before, self.pose, share))
                self._times_s.append(time_s)
                self._next_s += 1 / self._fps
            self._changed.notify_all()
            return self.pose

    def path(self) -> tuple[list[Pose], float]:
        """Return the poses since the moment, the live one last, and the time of its frame."""
        with self._changed:
            return [self._first, *self._poses, self.pose], self._time_s

    def wait_for_motion(self, timeout_s: float) -> bool:
        """Return True once the hand has moved since the last painted pose.

        Poses of a resting hand are forgotten, except for the last.
        """
        with self._changed:
            if not self._live:
                self._changed.wait(timeout_s)
                return False
            if any(_differs(pose, self._base()) for pose in self._poses[self._painted :]):
                self.rests = False
                return True
            del self._poses[self._painted : -1], self._times_s[self._painted : -1]
            self.rests = True
            self._changed.wait(timeout_s)
            return False

    def take(self, count: int) -> Sequence[Pose]:
        """Return the next poses to paint, when they are there.

        If twice as many wait, because painting is slow, every other one is skipped.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: not self._live or len(self._poses) - self._painted >= count
            )
            waiting = self._poses[self._painted :] or [self._base()]
            times_s = self._times_s[self._painted :] or [self._time_s]
            used = 2 * count if len(waiting) >= 2 * count else min(count, len(waiting))
            step = 2 if used > count else 1
            poses, times_s = waiting[step - 1 : used : step], times_s[step - 1 : used : step]
            self.taken_s = times_s[-1]
            poses += [poses[-1]] * (count - len(poses))
            times_s += [self.taken_s] * (count - len(times_s))
            taken = slice(self._painted, self._painted + used)
            self._poses[taken], self._times_s[taken] = poses, times_s
            self._painted += count
            return poses

    def commit(self) -> None:
        """Begin at the last painted pose: a clip of the poses before is made."""
        with self._changed:
            if self._painted:
                self._first = self._poses[self._painted - 1]
            del self._poses[: self._painted], self._times_s[: self._painted]
            self._painted = 0

    def _base(self) -> Pose:
        return self._poses[self._painted - 1] if self._painted else self._first


def between(before: Pose, after: Pose, share: float) -> Pose:
    """Return the pose at a share of the way between two poses."""
    turn = cv2.Rodrigues(before.rotation.T @ after.rotation)[0]
    return replace(
        before,
        point_m=before.point_m + share * (after.point_m - before.point_m),
        rotation=before.rotation @ cv2.Rodrigues(share * turn)[0],
        closure=before.closure + share * (after.closure - before.closure),
    )


def _differs(one: Pose, other: Pose) -> bool:
    """Return True if a hand moved from one pose to another."""
    turn = np.linalg.norm(cv2.Rodrigues(one.rotation.T @ other.rotation)[0])
    return bool(
        np.linalg.norm(one.point_m - other.point_m) > STILL_M
        or turn > np.radians(STILL_DEG)
        or abs(one.closure - other.closure) > STILL_CLOSURE
    )
