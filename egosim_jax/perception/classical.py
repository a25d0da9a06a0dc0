"""Classical perception: without network weights, by comparing the clip with the state's prediction.

Cameras and hand joints are those that the generator was given. Hands and arms are drawn from the
joints (`HandMasks`); the motion of a held object is the one that explains the clip's colors best
(`object_motion.TrackObjects`); where the object was, the surface that it stood on is extended
(`RevealedSurfaces`). Depth is set only where the clip differs from the view of the state before;
elsewhere it is unknown, and the state stays as it was.

Limits: objects must be separate instances in the state, and the moving part of an articulated one
another than the rest; an object is moved by one hand at a time, and does not topple.
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
    """Set cameras and hand joints to those that the generator was given; no new names."""
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
    """Stage that sets depth and ids of moved objects and of the surfaces they stood on."""

    point_px: int = 2
    """Size in pixels of the points with which the state is rendered."""

    def __post_init__(self) -> None:
        """Check that points have a size."""
        check_counts({"point_px": self.point_px})

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `depth_m`, infinite where the clip agrees with the state or shows hands, and ids."""
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
        """Return depth and object ids of changed pixels; infinite and 0 elsewhere."""
        shape = (len(cameras.world_from_camera), cameras.height, cameras.width)
        depth, ids = np.full(shape, np.inf, np.float32), np.zeros(shape, np.int32)
        if not motions:
            return depth, ids
        held = np.isin(state.object_ids, list(motions))
        rest, _ = splat(state.points_m[~held], cameras, point_px=self.point_px)
        _, index = splat(state.points_m[held], cameras, point_px=self.point_px)
        before = np.append(state.object_ids[held], np.int32(0))[index]
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
    """Perception without network weights, for clips whose cameras and hands are known."""

    hands: HandMasks = field(default_factory=HandMasks)
    """Drawing of hands and arms."""
    motion: TrackObjects = field(default_factory=TrackObjects)
    """Search for the motion of held objects."""
    surfaces: RevealedSurfaces = field(default_factory=RevealedSurfaces)
    """Depth of moved objects and of the surfaces behind them."""

    def build(self, ground_truth: Mapping[int, Observation] | None = None) -> Pipeline:
        """Return the classical perception pipeline; the ground truth is not used."""
        return Pipeline(stages=(take_action, self.hands, self.motion, self.surfaces))


def plane_depth(plane: Float[np.ndarray, " 4"], cameras: Cameras) -> Float32[np.ndarray, "f h w"]:
    """Return the depth in meters of a plane (a, b, c, d); infinite where a ray does not meet it."""
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    normal, offset = plane[:3], plane[3]
    depths = []
    for pose in cameras.world_from_camera:
        height = pose[:3, 3] @ normal + offset
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -height / (rays @ pose[:3, :3].T @ normal)
        depths.append(np.where(along > 0, along, np.inf))
    return np.array(depths, np.float32)
