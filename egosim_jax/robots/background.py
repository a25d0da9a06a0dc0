"""Frames without hands: the scene behind them, from the state or from other frames.

A hidden pixel takes, in this order, what the state shows there, with its objects where they are in
that frame; what other frames of the clip show; or an inpainted color, which is counted as unknown.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from egosim_jax.geometry import pixel_rays, transform
from egosim_jax.rendering.reference import add_margin, close_gaps, splat
from egosim_jax.types import Cameras, GroundTruth, InputError, SceneState

MARGIN_PX = 1
"""Pixels around a hand that are mixed with its color."""
NEIGHBORS = 8
"""Number of frames of a clip that others may take colors from."""
INPAINT_PX = 3
"""Radius of the inpainting (Telea)."""
SHADED = 0.88
"""Share of its brightness in the state below which the scene near a hand is in its shadow."""
SHADOW_REACH = 0.15
"""Distance of a hand's shadow from the hand, in image widths."""
SAME_M = 0.01
"""Distance up to which a frame and the state show the same surface."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Background:
    """Frames of a clip without hands."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """RGB of the scene."""
    depth_m: Float32[np.ndarray, "f h w"]
    """Depth in meters; infinite where it is unknown."""
    hidden: Bool[np.ndarray, "f h w"]
    """Mask of the pixels that showed a hand or its edge."""
    shadow: int
    """Number of pixels in the shadow of a hand, which have the state's color."""
    from_state: int
    """Number of hidden pixels that the state shows."""
    from_frames: int
    """Number of hidden pixels that only other frames show."""
    unknown: int
    """Number of hidden pixels that nothing shows."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class _Cloud:
    """Colored points where they are in the first frame of a clip."""

    points_m: Float[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    object_ids: Int[np.ndarray, " n"]

    def view(
        self, cameras: Cameras, motions: Mapping[int, np.ndarray], frame: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return color and depth of a frame, whose objects have moved."""
        points = self.points_m.astype(float)
        for number, motion in motions.items():
            own = self.object_ids == number
            points[own] = transform(motion[frame], points[own])
        camera = _one(cameras, frame)
        depth, index = close_gaps(*splat(points, add_margin(camera), point_px=1))
        colors = np.concatenate([self.colors, np.zeros((1, 3), np.uint8)])
        return colors[index[0]], depth[0]


def remove_hands(state: SceneState, cameras: Cameras, truth: GroundTruth) -> Background:
    """Return the frames of a clip without hands, from the state before it and its ground truth.

    Raises `InputError` if the ground truth has no depth or ids.
    """
    import cv2

    ids, known_m, motions = truth.object_ids, truth.depth_m, truth.motions or {}
    if ids is None or known_m is None:
        raise InputError(
            "The episode has no depth and ids of its frames, which say what hides the robot: make "
            "one with ground truth, such as egosim episode make --seed 0. (SOURCE)"
        )
    square = np.ones((2 * MARGIN_PX + 1,) * 2, np.uint8)
    hidden = np.stack([cv2.dilate((m < 0).astype(np.uint8), square) for m in ids]) > 0
    scene = _Cloud(points_m=state.points_m, colors=state.colors, object_ids=state.object_ids)
    frames, depth, missing = truth.frames.copy(), known_m.copy(), hidden.copy()
    shadow = 0
    (with_hands,) = np.nonzero(hidden.any(axis=(1, 2)))
    for n in with_hands.tolist():
        colors, seen_m = scene.view(cameras, motions, n)
        fixed = (ids[n] == 0) & (abs(seen_m - depth[n]) < SAME_M) & ~hidden[n]
        shaded = fixed & _in_shadow(frames[n], colors, hidden[n])
        shadow += int(shaded.sum())
        taken = shaded | (hidden[n] & np.isfinite(seen_m))
        frames[n][taken], depth[n][taken] = colors[taken], seen_m[taken]
        missing[n] &= ~taken
    from_state = int(hidden.sum() - missing.sum())
    around = _neighbors(cameras, frames, known_m, ids, hidden, motions)
    for n in np.flatnonzero(missing.any(axis=(1, 2))).tolist():
        colors, seen_m = around.view(cameras, motions, n)
        taken = missing[n] & np.isfinite(seen_m)
        frames[n][taken], depth[n][taken] = colors[taken], seen_m[taken]
        missing[n] &= ~taken
        depth[n][missing[n]] = np.inf
        hole = missing[n].astype(np.uint8)
        frames[n] = cv2.inpaint(frames[n], hole, INPAINT_PX, cv2.INPAINT_TELEA)
    unknown = int(missing.sum())
    return Background(
        frames=frames,
        depth_m=depth,
        hidden=hidden,
        shadow=shadow,
        from_state=from_state,
        from_frames=int(hidden.sum()) - from_state - unknown,
        unknown=unknown,
    )


def _in_shadow(
    image: UInt8[np.ndarray, "h w 3"],
    colors: UInt8[np.ndarray, "h w 3"],
    hole: Bool[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels near a hand that are darker than in the state."""
    import cv2

    far = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 3)
    darker = image.astype(float).sum(axis=-1) < SHADED * colors.astype(float).sum(axis=-1)
    return darker & (far < SHADOW_REACH * image.shape[1])


def _neighbors(
    cameras: Cameras,
    frames: UInt8[np.ndarray, "f h w 3"],
    depth_m: Float32[np.ndarray, "f h w"],
    object_ids: Int[np.ndarray, "f h w"],
    hidden: Bool[np.ndarray, "f h w"],
    motions: Mapping[int, np.ndarray],
) -> _Cloud:
    """Return the points that some frames show, moved back to the first frame."""
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    points, colors, numbers = [], [], []
    chosen = np.unique(np.linspace(0, len(hidden) - 1, NEIGHBORS).astype(int))
    for frame in chosen.tolist():
        seen = ~hidden[frame] & np.isfinite(depth_m[frame])
        local = rays[seen] * depth_m[frame][seen][:, None]
        place = transform(cameras.world_from_camera[frame], local)
        ids = object_ids[frame][seen]
        for number, motion in motions.items():
            own = ids == number
            place[own] = transform(np.linalg.inv(motion[frame]), place[own])
        points.append(place)
        colors.append(frames[frame][seen])
        numbers.append(ids)
    return _Cloud(
        points_m=np.concatenate(points),
        colors=np.concatenate(colors),
        object_ids=np.concatenate(numbers),
    )


def _one(cameras: Cameras, frame: int) -> Cameras:
    return replace(cameras, world_from_camera=cameras.world_from_camera[frame : frame + 1])


def moved(state: SceneState, motions: Mapping[int, np.ndarray]) -> SceneState:
    """Return the state after a clip, with its objects where the clip left them."""
    points = state.points_m.copy()
    for number, motion in motions.items():
        own = state.object_ids == number
        points[own] = transform(motion[-1], points[own])
    return replace(state, points_m=points, step=state.step + 1)
