"""Classical perception: compares the clip with the state's prediction, without network weights.

Cameras and hand joints are the generator's inputs. The stages then run in this order:

    HandMasks          draws hands and arms from the joints
    TrackObjects       predicts the motion of the objects, and judges it by the clip's colors
    MovedObjects       sets the ids of the objects where they moved
    NewSurfaces        continues planes of the state where it has no points

Depth is set only where the clip differs from the view of the previous state. Elsewhere depth is
unknown, and the state does not change.

A hand that closes on something without an id makes it a new object (`growth`), if the clip shows
that it moves with the hand.

Limit: objects do not topple.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np

from egosim_jax.geometry import cameras_in_object_frame
from egosim_jax.perception.clip.new_surfaces import NewSurfaces
from egosim_jax.perception.clip.object_motion import TrackObjects
from egosim_jax.perception.pipeline import Observation, Pipeline
from egosim_jax.perception.registry import register
from egosim_jax.perception.video.silhouettes import HandShape, hand_silhouette
from egosim_jax.rendering.reference import splat
from egosim_jax.types import Action, Clip, Counted, SceneState


def take_action(clip: Clip, action: Action, state: SceneState, so_far: Observation) -> Observation:
    """Set cameras and hand joints to the generator's inputs, and no names yet."""
    return replace(so_far, cameras=action.cameras, joints_m=action.joints_m, names={})


@dataclass(frozen=True, kw_only=True)
class HandMasks(HandShape):
    """Stage that sets `object_ids` to the silhouettes of hands and arms, drawn from the joints."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `object_ids`: -1 - n for hand n with its arm, 0 elsewhere."""
        cameras = so_far.require("cameras", "HandMasks")
        joints = so_far.require("joints_m", "HandMasks")
        hands = hand_silhouette(joints, action.kind, cameras, self)
        return replace(so_far, object_ids=np.where(hands >= 0, -1 - hands, 0).astype(np.int32))


@dataclass(frozen=True, kw_only=True)
class MovedObjects(Counted):
    """Stage that sets the ids of moved objects.

    Their depth stays unknown. Their points move with them, and a point that is as large as a pixel
    would make them thicker with each clip.
    """

    point_px: int = 2
    """Size of the state's rendered points, in pixels."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `object_ids` of moved objects, and no depth yet."""
        cameras, hand_ids, motions = (
            so_far.require(field, "MovedObjects") for field in ("cameras", "object_ids", "motions")
        )
        depth, ids = np.full(hand_ids.shape, np.inf, np.float32), hand_ids.copy()
        if not motions:
            return replace(so_far, depth_m=depth)
        rest = state.points_m[~np.isin(state.object_ids, list(motions))]
        nearest, _ = splat(rest, cameras, point_px=self.point_px)
        for number, motion in motions.items():
            points = state.points_m[state.object_ids == number].astype(float)
            local = cameras_in_object_frame(cameras, motion)
            moved, index = splat(points, local, point_px=self.point_px)
            nearer = (index >= 0) & (moved < nearest) & (hand_ids >= 0)
            nearest[nearer] = moved[nearer]
            ids[nearer] = number
        return replace(so_far, depth_m=depth, object_ids=ids)


@register("classical")
@dataclass(frozen=True, kw_only=True)
class ClassicalConfig:
    """Perception without network weights, for clips with known cameras and hands."""

    reads_ground_truth: ClassVar[bool] = False
    hands: HandMasks = field(default_factory=HandMasks)
    """Drawing of hands and arms."""
    motion: TrackObjects = field(default_factory=TrackObjects)
    """Judgment of the predicted motion of objects."""
    moved: MovedObjects = field(default_factory=MovedObjects)
    """Depth of moved objects."""
    new: NewSurfaces = field(default_factory=NewSurfaces)
    """Depth of surfaces that the state does not have."""

    def build(self, ground_truth: Mapping[int, Observation] | None = None) -> Pipeline:
        """Return the classical perception pipeline; the ground truth is not used."""
        return Pipeline(stages=(take_action, self.hands, self.motion, self.moved, self.new))
