"""Frames without hands: the scene behind them, from the state or from other frames.

A hidden pixel takes, in this order, what the state shows there, with its objects where they are in
that frame; what the first frame without hands shows; what other frames of the clip show; or an
inpainted color, which is counted as unknown.
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

EDGE = 1 / 80
"""Width of the edge of an estimated hand that is hidden, too, in image widths."""
SLEEVE = 0.15
"""Width around an estimated hand in which a sleeve may be, in image widths."""
DIFFERENT = 90
"""Least difference of a sleeve from the state: sum over the channels, in 8-bit levels."""
FAR_M = 100.0
"""Assumed depth of the first frame where nothing gives it: a turning camera shows it right."""
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
    from_first_frame: int
    """Number of further ones that the first frame without hands shows."""
    from_frames: int
    """Number of further ones that other frames show."""
    unknown: int
    """Number of hidden pixels that nothing shows."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Cloud:
    """Colored points where they are in the first frame of a clip."""

    points_m: Float[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    object_ids: Int[np.ndarray, " n"]

    def view(
        self, cameras: Cameras, motions: Mapping[int, np.ndarray], frame: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return color, depth and ids of a frame, whose objects have moved."""
        points = self.points_m.astype(float)
        for number, motion in motions.items():
            own = self.object_ids == number
            points[own] = transform(motion[frame], points[own])
        camera = _one(cameras, frame)
        depth, index = close_gaps(*splat(points, add_margin(camera), point_px=1))
        colors = np.concatenate([self.colors, np.zeros((1, 3), np.uint8)])
        return colors[index[0]], depth[0], np.append(self.object_ids, 0)[index[0]]


def cloud_of(state: SceneState) -> Cloud:
    """Return the points of a state."""
    return Cloud(points_m=state.points_m, colors=state.colors, object_ids=state.object_ids)


def first_cloud(image: UInt8[np.ndarray, "h w 3"], state: SceneState, cameras: Cameras) -> Cloud:
    """Return the fixed scene that the first frame without hands shows, in the world.

    `cameras` begin with the camera of the frame. Depth and ids are the state's.
    """
    _, depth, ids = cloud_of(state).view(cameras, {}, 0)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    local = rays * np.where(np.isfinite(depth), depth, FAR_M)[..., None]
    fixed = ids == 0
    points = transform(cameras.world_from_camera[0], local[fixed])
    return Cloud(points_m=points, colors=image[fixed], object_ids=np.zeros(len(points), int))


def remove_hands(
    state: SceneState,
    cameras: Cameras,
    truth: GroundTruth,
    *,
    first: Cloud | None = None,
    estimated: bool = False,
) -> Background:
    """Return the frames of a clip without hands, from the state before it and its ground truth.

    `first` has the points of the first frame without hands. Where the depth is unknown, it is the
    state's. With `estimated` ids, the edge of a hand is wider, and what differs from the state next
    to a hand is its sleeve. Raises `InputError` if the ground truth has no depth or ids.
    """
    import cv2

    ids, known_m, motions = truth.object_ids, truth.depth_m, truth.motions or {}
    if ids is None or known_m is None:
        raise InputError(
            "The episode has no depth and ids of its frames, which say what hides the robot: make "
            "one with ground truth, such as egosim episode make --seed 0. (SOURCE)"
        )
    edge_px = max(2, round(EDGE * cameras.width)) if estimated else 1
    hidden = np.stack([dilated(m < 0, edge_px) for m in ids])
    scene = cloud_of(state)
    if estimated:
        for n in np.flatnonzero(hidden.any(axis=(1, 2))).tolist():
            colors, seen_m, _ = scene.view(cameras, motions, n)
            free = np.isfinite(seen_m) & ~dilated(ids[n] > 0, edge_px)
            hidden[n] |= _sleeve(truth.frames[n], colors, hidden[n], free, edge_px)
    frames, depth, missing = truth.frames.copy(), known_m.copy(), hidden.copy()
    shadow, counts = 0, [int(hidden.sum())]

    def take(n: int, taken: np.ndarray, colors: np.ndarray, seen_m: np.ndarray) -> None:
        frames[n][taken], depth[n][taken] = colors[taken], seen_m[taken]
        missing[n] &= ~taken

    def fill(cloud: Cloud) -> None:
        for n in np.flatnonzero(missing.any(axis=(1, 2))).tolist():
            colors, seen_m, _ = cloud.view(cameras, motions, n)
            take(n, missing[n] & np.isfinite(seen_m), colors, seen_m)

    unclear = hidden | ~np.isfinite(known_m)
    for n in np.flatnonzero(unclear.any(axis=(1, 2))).tolist():
        colors, seen_m, _ = scene.view(cameras, motions, n)
        same = np.isfinite(seen_m) & np.isclose(seen_m, depth[n], rtol=0, atol=SAME_M)
        fixed = same & (ids[n] == 0) & ~hidden[n]
        shaded = fixed & _in_shadow(frames[n], colors, hidden[n])
        shadow += int(shaded.sum())
        take(n, shaded | (hidden[n] & np.isfinite(seen_m)), colors, seen_m)
        depth[n] = np.where(np.isfinite(depth[n]), depth[n], seen_m)
    counts.append(int(missing.sum()))
    around = _neighbors(cameras, frames, depth, ids, hidden, motions)
    if first is not None:
        fill(first)
    counts.append(int(missing.sum()))
    fill(around)
    counts.append(int(missing.sum()))
    for n in np.flatnonzero(missing.any(axis=(1, 2))).tolist():
        depth[n][missing[n]] = np.inf
        hole = missing[n].astype(np.uint8)
        frames[n] = cv2.inpaint(frames[n], hole, INPAINT_PX, cv2.INPAINT_TELEA)
    from_state, from_first, from_frames = -np.diff(counts)
    return Background(
        frames=frames,
        depth_m=depth,
        hidden=hidden,
        shadow=shadow,
        from_state=int(from_state),
        from_first_frame=int(from_first),
        from_frames=int(from_frames),
        unknown=counts[-1],
    )


def dilated(mask: Bool[np.ndarray, "h w"], pixels: int) -> Bool[np.ndarray, "h w"]:
    """Return a mask that is larger by some pixels on each side."""
    import cv2

    square = np.ones((2 * pixels + 1,) * 2, np.uint8)
    return cv2.dilate(mask.astype(np.uint8), square) > 0


def _sleeve(
    image: UInt8[np.ndarray, "h w 3"],
    colors: UInt8[np.ndarray, "h w 3"],
    hand: Bool[np.ndarray, "h w"],
    free: Bool[np.ndarray, "h w"],
    edge_px: int,
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels connected to a hand that differ from the state, with their edge.

    `free` marks the pixels that the state shows and that no object covers.
    """
    import cv2

    change = np.abs(image.astype(int) - colors).sum(axis=-1) > DIFFERENT
    near = dilated(hand, round(SLEEVE * image.shape[1]))
    _, parts = cv2.connectedComponents((hand | (change & near & free)).astype(np.uint8))
    own = np.isin(parts, np.unique(parts[hand])) & ~hand
    return dilated(own, edge_px // 2) & free


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
) -> Cloud:
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
    return Cloud(
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
