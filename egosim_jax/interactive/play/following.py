"""From the joints of each camera frame to a recorded hand that grasps, and its predicted objects.

joints ─map▶ pose ─grasp▶ target ─record▶ poses ─predict▶ objects
"""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from egosim_jax.interactive.play.foresight import Foresight
from egosim_jax.interactive.play.moves import Pose
from egosim_jax.interactive.play.own_hand import OwnHand
from egosim_jax.interactive.play.played_episode import PlayedEpisode
from egosim_jax.interactive.play.recorder import Recorder

RETURN_S = 0.4
"""Time constant with which a hand that was drawn to an object returns to its place, in seconds."""


class Following:
    """Own hand in an episode, without camera and page."""

    def __init__(self, played: PlayedEpisode):
        """Wait for the calibration of the hand."""
        wearer = played.now.start.camera.world_from_camera[0, :3, :3]
        self.own = OwnHand(played.side, wearer)
        self.recorder = Recorder(played.hand, fps=played.world.video.fps)
        self._foreseeing = threading.Lock()
        self._offset_m, self._closure = np.zeros(3), None
        self._time_s = 0.0
        self.show(played)

    def show(self, played: PlayedEpisode) -> None:
        """Begin the recorded poses at an episode's current moment."""
        now = played.now.start
        spec, fps = played.session.actions, played.world.video.fps
        with self._foreseeing:
            self._played = played
            self._base = self.foresight = Foresight.of(now, spec, played.side, fps=fps)

    def begin(self, played: PlayedEpisode) -> None:
        """Record from the current moment of an episode."""
        self.show(played)
        self._offset_m, self._closure = np.zeros(3), None
        self.recorder.resume(played.hand)

    def committed(self, played: PlayedEpisode) -> None:
        """Continue after a clip of the poses that were taken."""
        self.show(played)
        self.recorder.commit()

    def see(self, joints_m: Float[np.ndarray, "21 3"] | None, time_s: float) -> Pose:
        """Return the pose of the hand after a camera's frame, or after one without a hand."""
        hand = self.own.see(joints_m, time_s)
        if not self.own.pinches:
            self._closure = None
            self._offset_m *= np.exp(-(time_s - self._time_s) / RETURN_S)
        elif self._closure is None:
            there = replace(hand, point_m=hand.point_m + self._offset_m)
            grasp = self.foresight.grasp(there)
            self._closure, self._offset_m = grasp.closure, grasp.point_m - hand.point_m
        self._time_s = time_s
        closure = hand.closure if self._closure is None else self._closure
        if self.own.phase == "calibrate":
            return self.recorder.pose
        target = replace(hand, point_m=hand.point_m + self._offset_m, closure=closure)
        return self.recorder.see(self._reachable(target), time_s)

    def foresee(self) -> tuple[Foresight, float]:
        """Predict the objects for the poses so far; return the time of the last one's frame."""
        poses, time_s = self.recorder.path()
        with self._foreseeing:
            camera = self._played.row[-6:]
            rows = np.stack([pose.row(self._played.side, camera) for pose in poses])
            rows = np.clip(rows, *self._played.session.actions.bounds)
            self.foresight = self._base.after(rows)
            return self.foresight, time_s

    def _reachable(self, hand: Pose) -> Pose:
        """Return the nearest pose within the workspace."""
        row = hand.row(self._played.side, np.zeros(6))
        return Pose.of_row(np.clip(row, *self._played.session.actions.bounds), self._played.side)
