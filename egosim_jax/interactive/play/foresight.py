"""Foresight: predicted objects of a hand on its way, and the grasp that a pinch means.

`dynamics` predicts each clip from its action before it is painted. Here it does the same at once,
for the rows that are not painted yet. A pinch near an object is a grasp of it: the depth of a hand
from one camera is off by centimeters, so the hand is drawn to the object, and its fingers stop at
the object's hull.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from egosim_jax.dynamics import Prediction
from egosim_jax.dynamics.solids import Solid
from egosim_jax.geometry import transform
from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.play.moves import Pose
from egosim_jax.rendering.mesh import Side
from egosim_jax.simulation.start import Start
from egosim_jax.worlds.tabletop.hand_motion import opened
from egosim_jax.worlds.tabletop.hands import closure_for, joints_of, pinch, tips_of

AHEAD = 3
"""Frames for which the last row is repeated: `dynamics` sees a grip in a steady hand."""
DRAWN_M = 0.07
"""Maximum distance of a pinch from an object that it grasps, in meters."""
GRASP_SHARE = 0.62
"""Height of a grasp, as a fraction of the object's height, as in the training clips."""
TOUCH_M = 0.002
"""Distance of the fingertips from a hull at which they stop, in meters."""
CLOSED = closure_for("human", 0.012)
"""Closure of a pinch of nothing."""


@dataclass(frozen=True, kw_only=True)
class Foresight:
    """Prediction for a hand in the state of a start."""

    scene: Prediction
    """Prediction whose scene has all objects of the workspace."""
    start: Start
    """Start of the rows."""
    spec: ActionSpec
    """Layout of the rows."""
    side: Side
    """Hand that acts."""
    poses: Mapping[int, Float[np.ndarray, "4 4"]] = field(default_factory=dict)
    """Predicted motion in the world of each object that has moved since the start."""
    held: int | None = None
    """Object that the hand is predicted to hold."""

    @classmethod
    def of(cls, start: Start, spec: ActionSpec, side: Side, *, fps: int) -> Foresight:
        """Read the objects of a start."""
        camera, corners = start.camera.world_from_camera[0], np.array(spec.workspace_m)
        scene = Prediction.without_hands(start.state, camera, corners, fps=fps)
        return cls(scene=scene, start=start, spec=spec, side=side, held=start.state.held.get(0))

    def after(self, rows: Float[np.ndarray, "k d"]) -> Foresight:
        """Return the foresight at the last of some rows, which begin with the start's."""
        path = np.concatenate([rows, np.repeat(rows[-1:], AHEAD, axis=0)])
        action = self.spec.to_action(path, camera=self.start.camera, prompt="")[0]
        motion = self.scene.with_hands(action).motion()
        paths = motion.at(np.array([len(rows) - 1])).paths
        return replace(
            self,
            poses={number: path.motion[0] for number, path in paths.items()},
            held=motion.held.get(0),
        )

    def grasp(self, hand: Pose) -> Pose:
        """Return the pose that a pinch at a pose means: at the nearest object, or a closed hand."""
        nearest, number = DRAWN_M, None
        for candidate in self.scene.scene.solids:
            away = self._distance(candidate, hand.point_m[None])[0]
            if away < nearest and self._width(candidate, hand) < _open_width(self.side):
                nearest, number = away, candidate
        if number is None:
            return replace(hand, closure=CLOSED)
        hand = replace(hand, point_m=self._grip_point(number))
        for closure in np.linspace(opened("human"), CLOSED, 40):
            tips = _tips(replace(hand, closure=float(closure)), self.side)
            if self._distance(number, tips).max() <= TOUCH_M:
                return replace(hand, closure=float(closure))
        return replace(hand, closure=CLOSED)

    def _motion(self, number: int) -> Float[np.ndarray, "4 4"]:
        """Return the predicted motion of an object in level coordinates."""
        level = self.scene.scene.level_from_world
        return level @ self.poses.get(number, np.eye(4)) @ np.linalg.inv(level)

    def _distance(self, number: int, points_m: Float[np.ndarray, "p 3"]) -> np.ndarray:
        """Return signed distances of points in the world from an object."""
        level = transform(self.scene.scene.level_from_world, points_m)
        return self._solid(number).distance(level, self._motion(number))

    def _solid(self, number: int) -> Solid:
        return self.scene.scene.solids[number]

    def _width(self, number: int, hand: Pose) -> float:
        """Return the width of an object between the fingers."""
        thumb, fingers = _tips(hand, self.side)
        way = self.scene.scene.level_from_world[:3, :3] @ (fingers - thumb)
        way[2] = 0
        way /= max(float(np.linalg.norm(way)), 1e-9)
        return self._solid(number).width_along(way, self._motion(number))

    def _grip_point(self, number: int) -> Float[np.ndarray, " 3"]:
        """Return the point in the world at which an object is grasped."""
        solid = self._solid(number)
        low, high = solid.corners_m.min(axis=0), solid.corners_m.max(axis=0)
        point = (low + high) / 2
        point[2] = low[2] + GRASP_SHARE * (high - low)[2]
        level = np.linalg.inv(self.scene.scene.level_from_world) @ self._motion(number)
        return transform(level, point[None])[0]


def _tips(hand: Pose, side: Side) -> Float[np.ndarray, "2 3"]:
    """Return the grasping tips of a hand in the world."""
    joints = joints_of("human", hand.closure, side)
    tips = np.stack(tips_of(joints)) - pinch(joints)[0]
    return hand.point_m + tips @ hand.rotation.T


def _open_width(side: Side) -> float:
    """Return the width between the fingers of an open hand."""
    return pinch(joints_of("human", opened("human"), side))[1]
