"""Hand moves of one clip: straight to a pose, or a scripted interaction with an object.

A hand's pose refers to the point between its grasping fingertips, because a person aims with it.
The rows of a session (`interactive/env/action_spec.py`) refer to the wrist.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, no_type_check

import cv2
import numpy as np
from jaxtyping import Float

from egosim_jax.rendering.mesh import Side
from egosim_jax.types import SceneState
from egosim_jax.worlds.tabletop import hand_motion
from egosim_jax.worlds.tabletop.hand_motion import Grip, Hand, Intent
from egosim_jax.worlds.tabletop.hands import joints_of, pinch
from egosim_jax.worlds.tabletop.scene import DRAWER_M, Scene, moving_part

Interaction = Literal["carry", "lift", "open or close"]
TRAVEL = 0.75
"""Fraction of a clip in which a driven hand moves; then it opens or closes."""
MIDDLE_M = (0.0, 0.25)
"""Center of the objects' area on the table, in meters."""
CARRY_M = (0.10, 0.16)
"""Minimum and maximum suggested distance to carry an object, in meters."""
OPENINGS = np.linspace(0, 1, 41)
"""Candidate openings of drawers and lids, from closed (0) to open (1)."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Pose:
    """Pose of a hand: point between the fingertips, rotation, closure."""

    point_m: Float[np.ndarray, " 3"]
    """Point between the grasping fingertips in the world, in meters."""
    rotation: Float[np.ndarray, "3 3"]
    """Axes of the hand in the world: y along the fingers, z out of its back."""
    closure: float
    """Closure of the hand, from open (0) to closed (1)."""

    @classmethod
    def of_row(cls, row: Float[np.ndarray, " d"], side: Side) -> Pose:
        """Return the pose of a row, whose first seven numbers describe the hand."""
        rotation, closure = cv2.Rodrigues(row[3:6])[0], float(row[6])
        return cls(
            point_m=row[:3] + rotation @ pinch(joints_of("human", closure, side))[0],
            rotation=rotation,
            closure=closure,
        )

    @classmethod
    def of_grip(cls, grip: Grip) -> Pose:
        """Return the pose of a scripted hand."""
        return cls(point_m=grip.point_m, rotation=grip.rotation, closure=grip.closure)

    def row(self, side: Side, camera: Float[np.ndarray, " 6"]) -> Float[np.ndarray, " d"]:
        """Return the row of the hand, followed by the camera's numbers."""
        tip = self.rotation @ pinch(joints_of("human", self.closure, side))[0]
        vector = cv2.Rodrigues(self.rotation)[0][:, 0]
        return np.concatenate([self.point_m - tip, vector, [self.closure], camera])

    def grip(self) -> Grip:
        """Return the nearest pose of a scripted hand, which cannot roll."""
        along = self.rotation[:, 1]
        return Grip(
            point_m=self.point_m,
            yaw=float(np.arctan2(-along[0], along[1])),
            pitch=float(np.arcsin(np.clip(-along[2], -1, 1))),
            closure=self.closure,
        )


def drive(before: Pose, target: Pose, frames: int) -> list[Pose]:
    """Return the hand's pose in each frame of a clip but the first.

    The hand moves in a straight line, then opens or closes at the target.
    """
    turn = cv2.Rodrigues(before.rotation.T @ target.rotation)[0]
    poses = []
    for time in np.linspace(0, 1, frames)[1:]:
        share = hand_motion.smooth(time / TRAVEL)
        grasp = hand_motion.smooth((time - TRAVEL) / (1 - TRAVEL))
        poses.append(
            Pose(
                point_m=before.point_m + share * (target.point_m - before.point_m),
                rotation=before.rotation @ cv2.Rodrigues(share * turn)[0],
                closure=before.closure + grasp * (target.closure - before.closure),
            )
        )
    return poses


def perform(scene: Scene, intent: Intent, before: Pose, side: Side, frames: int) -> list[Pose]:
    """Return the hand's pose in each frame but the first of a scripted interaction."""
    hand = Hand(side=side, grip=before.grip())
    moments = hand_motion.act(scene, (hand,), intent, "human", frames=frames, rises=True)
    return [Pose.of_grip(moment.hands[0].grip) for moment in moments[1:]]


def pre_grasp_pose(scene: Scene, name: str, side: Side) -> Pose:
    """Return the pose of an open hand that is about to grasp a body."""
    grip = hand_motion.grip_on(scene, Intent(verb="lift", name=name), "human", side)
    return Pose.of_grip(replace(grip, closure=hand_motion.opened("human")))


def ready_pose(scene: Scene, name: str, side: Side) -> Pose:
    """Return the pose in the air in front of a body from which training clips start."""
    grip = hand_motion.grip_on(scene, Intent(verb="lift", name=name), "human", side)
    return Pose.of_grip(hand_motion.relaxed(grip.point_m + hand_motion.BEFORE_M, side, "human"))


def suggest_goal(scene: Scene, side: Side) -> tuple[str, Float[np.ndarray, " 2"]] | None:
    """Return a movable body near the center, and a free place on the side away from the hand.

    The hand does not hide the body there. None if no movable body has a free place.
    """
    across, rng = -1.0 if side == "right" else 1.0, np.random.default_rng(0)
    loose = [b for b in scene.bodies if b.shape != "ring" and not (b.static or b.articulated)]
    gaps = {b.name: np.linalg.norm(b.world_from_body[:2, 3] - MIDDLE_M) for b in loose}
    for name in sorted(gaps, key=lambda name: gaps[name]):
        drawn = [scene.free_place(scene.body(name), rng, away_m=CARRY_M) for _ in range(8)]
        places = [place for place in drawn if place is not None]
        if places:
            return name, max(places, key=lambda place: across * place[0])
    return None


def intent_of(
    interaction: Interaction,
    scene: Scene,
    name: str,
    place_m: Float[np.ndarray, " 2"] | None = None,
) -> Intent:
    """Return an interaction as a script's intent with its caption; `carry` ends at `place_m`."""
    body = scene.body(name)
    if interaction == "open or close":
        return hand_motion.open_or_close(scene, body)
    if interaction == "lift" or place_m is None:
        return hand_motion.lift(body)
    return hand_motion.carry(body, place_m)


def scene_from_state(scene: Scene, state: SceneState) -> Scene:
    """Return a first scene with its bodies moved to their poses in a state."""
    for body in scene.bodies:
        motion = state.world_from_object.get(scene.instance_id(body.name))
        if motion is None:
            continue
        pose = motion @ scene.first_part_pose(body.name)
        if not body.articulated:
            scene = scene.with_pose(body.name, pose)
            continue
        # estimated motion is noisy: take the nearest pose that the joint allows
        inside = np.linalg.inv(body.world_from_body) @ pose
        gaps = [_gap(moving_part(body, opening), inside) for opening in OPENINGS]
        scene = scene.with_opening(body.name, float(OPENINGS[int(np.argmin(gaps))]))
    return scene


def _gap(pose: np.ndarray, other: np.ndarray) -> float:
    """Return the distance between two poses in meters; a radian counts as a drawer's travel."""
    translation = np.linalg.norm(pose[:3, 3] - other[:3, 3])
    return float(translation + DRAWER_M * np.linalg.norm(pose[:3, :3] - other[:3, :3]))
