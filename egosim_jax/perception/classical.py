"""Classical perception: compares the clip with the state's prediction, without network weights.

Cameras and hand joints are the generator's inputs. The stages then run in this order:

    HandMasks          draws hands and arms from the joints
    TrackObjects       finds the motion of a held object that best explains the clip's colors
    RevealedSurfaces   extends the supporting surface to where the object was

Depth is set only where the clip differs from the view of the previous state. Elsewhere depth is
unknown, and the state does not change.

A hand that closes on something without an id makes it a new object (`growth`), if the clip shows
that it moves with the hand.

Limits: one hand at a time moves an object, and objects do not topple.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Float32, Int32

from egosim_jax.geometry import cameras_in_object_frame, pixel_rays
from egosim_jax.perception.object_motion import TrackObjects
from egosim_jax.perception.pipeline import Observation, Pipeline
from egosim_jax.perception.registry import register
from egosim_jax.perception.silhouettes import HandShape, hand_silhouette
from egosim_jax.rendering.reference import splat
from egosim_jax.types import Action, Cameras, Clip, SceneState, check_counts


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
class RevealedSurfaces:
    """Stage that sets depth and ids of moved objects and of the surfaces that they revealed."""

    point_px: int = 2
    """Size of the state's rendered points, in pixels."""

    def __post_init__(self) -> None:
        """Check that points have a size."""
        check_counts({"point_px": self.point_px})

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `depth_m` (infinite where nothing changed, and at hands) and `object_ids`."""
        cameras, hand_ids, motions, planes = (
            so_far.require(field, "RevealedSurfaces")
            for field in ("cameras", "object_ids", "motions", "support_planes")
        )
        depth, ids = self._changes(cameras, state, motions, planes)
        hidden = hand_ids < 0
        return replace(
            so_far,
            depth_m=np.where(hidden, np.inf, depth).astype(np.float32),
            object_ids=np.where(hidden, hand_ids, ids).astype(np.int32),
        )

    def _changes(
        self,
        cameras: Cameras,
        state: SceneState,
        motions: Mapping[int, Float[np.ndarray, "f 4 4"]],
        planes: Mapping[int, Float[np.ndarray, " 4"]],
    ) -> tuple[Float32[np.ndarray, "f h w"], Int32[np.ndarray, "f h w"]]:
        """Return depth and object ids of changed pixels, and infinity and 0 elsewhere."""
        shape = (len(cameras.world_from_camera), cameras.height, cameras.width)
        depth, ids = np.full(shape, np.inf, np.float32), np.zeros(shape, np.int32)
        if not motions:
            return depth, ids
        held = np.isin(state.object_ids, list(motions))
        rest, _ = splat(state.points_m[~held], cameras, point_px=self.point_px)
        _, index = splat(state.points_m[held], cameras, point_px=self.point_px)
        before = np.append(state.object_ids[held], np.int32(0))[index]
        # First all revealed surfaces, then all moved objects: an object may end on such a surface.
        for number in motions:
            revealed = (before == number) & ~np.isfinite(rest)
            depth[revealed] = np.minimum(depth, plane_depth(planes[number], cameras))[revealed]
        for number, motion in motions.items():
            points = state.points_m[state.object_ids == number].astype(float)
            moved, index = splat(
                points, cameras_in_object_frame(cameras, motion), point_px=self.point_px
            )
            nearer = (index >= 0) & (moved < np.minimum(depth, rest))
            depth[nearer], ids[nearer] = moved[nearer], number
        return depth, ids


@register("classical")
@dataclass(frozen=True, kw_only=True)
class ClassicalConfig:
    """Perception without network weights, for clips with known cameras and hands."""

    hands: HandMasks = field(default_factory=HandMasks)
    """Drawing of hands and arms."""
    motion: TrackObjects = field(default_factory=TrackObjects)
    """Estimation of the motion of held objects."""
    surfaces: RevealedSurfaces = field(default_factory=RevealedSurfaces)
    """Depth of moved objects and of the surfaces behind them."""

    def build(self, ground_truth: Mapping[int, Observation] | None = None) -> Pipeline:
        """Return the classical perception pipeline; the ground truth is not used."""
        return Pipeline(stages=(take_action, self.hands, self.motion, self.surfaces))


def plane_depth(plane: Float[np.ndarray, " 4"], cameras: Cameras) -> Float32[np.ndarray, "f h w"]:
    """Return the depth of a plane (a, b, c, d) in meters; infinite where a ray misses it."""
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    normal, offset = plane[:3], plane[3]
    depths = []
    for pose in cameras.world_from_camera:
        height = pose[:3, 3] @ normal + offset
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -height / (rays @ pose[:3, :3].T @ normal)
        depths.append(np.where(along > 0, along, np.inf))
    return np.array(depths, np.float32)
