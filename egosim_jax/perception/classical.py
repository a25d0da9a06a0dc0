"""Perception without network weights: by comparing the clip with what the state predicts.

The cameras are those that the generator was given; what the hands carried is found by trying
(`carried`); where it was, the surface that it stood on is continued. What agrees with the view of
the state before teaches nothing: its depth is left unknown, and the state stays as it was there.

It sees generated frames, cameras, the state before and the action, never the truth. Limits: things
must be apart in the state (object ids), a thing is moved by one hand at a time, and what turns on a
hinge is taken for a rigid body between its ends.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from egosim_jax.geometry import beside, invert, pixel_rays, project, transform
from egosim_jax.perception.carried import PALM, Carried, Thing, carried
from egosim_jax.rendering.reference import render, splat
from egosim_jax.rendering.skeleton import SKELETONS
from egosim_jax.types import Action, Cameras, Clip, Perceived, SceneState

FINGER_M, ARM_M = 0.013, 0.05
"""Radius of the flesh around a bone and around an arm."""
CHEST_M, ARM_SHARE = np.array([0.0, 0.35, 0.05]), 0.8
"""Where arms come from as the camera sees it: below, straight down from the hand; and how much of
the way there is covered."""
NEAR_M, DISCS = 0.05, 25
"""Flesh nearer to the camera is not drawn, and how many discs make a tube."""


@dataclass(frozen=True, kw_only=True)
class Classical:
    """A perception of clips whose cameras are known."""

    point_px: int = 2
    """Size of the points with which the state is looked at."""

    def __call__(self, clip: Clip, action: Action, state: SceneState) -> Perceived:
        """What was carried and what came to light; everything else is unknown."""
        hands = flesh(action)
        moved = carried(clip, action, state, hands >= 0)
        depth, ids = self._changes(action.cameras, state, moved)
        frames = np.arange(len(clip.frames))
        return Perceived(
            step=state.step + 1,
            frames=clip.frames,
            cameras=action.cameras,
            depth_m=np.where(hands >= 0, np.inf, depth).astype(np.float32),
            object_ids=np.where(hands >= 0, -1 - hands, ids).astype(np.int32),
            names={},
            world_from_object={
                m.thing.number: m.path @ state.world_from_object.get(m.thing.number, np.eye(4))
                for m in moved
            },
            touched={m.thing.number: (frames >= m.grasped) & (frames <= m.released) for m in moved},
        )

    def _changes(
        self, cameras: Cameras, state: SceneState, moved: list[Carried]
    ) -> tuple[Float32[np.ndarray, "f h w"], Int32[np.ndarray, "f h w"]]:
        """Depth and ids of what moved and of the surfaces it stood on; infinite and 0 elsewhere."""
        view = render(state, cameras, point_px=self.point_px)
        others = ~np.isin(state.object_ids, [m.thing.number for m in moved])
        rest, _ = splat(state.points_m[others], cameras, point_px=self.point_px)
        depth = np.full(rest.shape, np.inf, np.float32)
        ids = np.zeros(rest.shape, np.int32)
        for m in moved:
            bared = (view.object_ids == m.thing.number) & ~np.isfinite(rest)
            depth[bared] = np.minimum(depth, _plane(m.thing, cameras))[bared]
        for m in moved:
            there, index = splat(m.thing.points_m, beside(cameras, m.path), point_px=self.point_px)
            nearer = (index >= 0) & (there < np.minimum(depth, rest))
            depth[nearer], ids[nearer] = there[nearer], m.thing.number
        return depth, ids


def flesh(action: Action) -> Int32[np.ndarray, "f h w"]:
    """Which hand covers each pixel, arm included; -1 for none.

    Bones with flesh around them, the palm between its knuckles, and an arm from the wrist towards
    the wearer.
    """
    import cv2

    cameras = action.cameras
    covered = np.full((len(action.joints_m), cameras.height, cameras.width), -1, np.int32)
    bones = SKELETONS[action.kind].bones.tolist()
    for frame, world_from_camera in enumerate(cameras.world_from_camera):
        canvas = np.zeros((cameras.height, cameras.width), np.uint8)
        for number, hand in enumerate(action.joints_m[frame]):
            if not np.isfinite(hand).all():
                continue
            joints = transform(invert(world_from_camera), hand)
            palm = joints[PALM[action.kind]]
            elbow = palm[0] + ARM_SHARE * (CHEST_M + [palm[0, 0], 0, 0] - palm[0])
            canvas[:] = 0
            for start, end in bones:
                _tube(canvas, joints[start], joints[end], FINGER_M, cameras)
            _tube(canvas, palm[0], elbow, ARM_M, cameras)
            if (palm[:, 2] > NEAR_M).all():
                u, v = project(cameras.intrinsics_px, palm)
                corners = np.rint(np.stack([u, v], axis=1)).astype(np.int32)
                cv2.fillConvexPoly(canvas, cv2.convexHull(corners), 1)
            covered[frame][canvas > 0] = number
    return covered


def _tube(
    canvas: UInt8[np.ndarray, "h w"],
    start: Float[np.ndarray, " 3"],
    end: Float[np.ndarray, " 3"],
    radius_m: float,
    cameras: Cameras,
) -> None:
    """Draw what a tube covers: discs of its radius along it."""
    import cv2

    places = start + np.linspace(0, 1, DISCS)[:, None] * (end - start)
    places = places[places[:, 2] > NEAR_M]
    far = 10 * cameras.width  # farther out is out of sight, and of the range that can be drawn
    centers = np.clip(np.stack(project(cameras.intrinsics_px, places), axis=1), -far, far)
    radii = cameras.intrinsics_px[0, 0] * radius_m / places[:, 2]
    for (column, row), radius in zip(np.rint(centers).astype(int), radii, strict=True):
        cv2.circle(canvas, (int(column), int(row)), max(1, round(float(radius))), 1, -1)


def _plane(thing: Thing, cameras: Cameras) -> Float32[np.ndarray, "f h w"]:
    """Depth of the surface that a thing stands on; infinite where there is none."""
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    depths = []
    for pose in cameras.world_from_camera:
        height = pose[:3, 3] @ thing.normal + thing.offset_m
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -height / (rays @ pose[:3, :3].T @ thing.normal)
        depths.append(np.where(along > 0, along, np.inf))
    return np.array(depths, np.float32)
