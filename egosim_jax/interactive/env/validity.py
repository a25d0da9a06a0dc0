"""Agreement of generated frames with the state, where no hand acts.

A model may repaint the background, or fade an object that no hand touches. Both are compared with
the view of the state before the clip. Pixels near hands and arms are skipped.
"""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from egosim_jax.perception.video.silhouettes import HandShape, hand_silhouette
from egosim_jax.rendering import Renderer
from egosim_jax.simulation.simulator import Step
from egosim_jax.types import Action, SceneState, View

MAX_LEVELS = 25
"""Maximum color difference (0 to 255) of a pixel that agrees with the state."""
SKELETON_MARGIN = 0.08
"""Margin around a skeleton in which the background may change, as a fraction of the width."""
ARM_MARGIN = 0.02
"""Margin around a hand and its forearm in which objects may change, as a fraction of the width."""
BLUR = 0.01
"""Radius of the blur in which objects are compared, as a fraction of the width.

Generated frames are softer than points: stripes would disagree without it."""
TOUCH_M = 0.05
"""Distance from a joint to the box around an object within which a hand may touch it, in meters."""
MIN_OBJECT_PIXELS = 100
"""Minimum number of pixels of an object over all frames of a clip."""


def validity(state: SceneState, step: Step, action: Action, renderer: Renderer) -> dict[str, float]:
    """Return the share of pixels that agree with the state, from 0 to 1, of two kinds.

    `validity` is of the background. `object_validity` is of the object that agrees least, of those
    that no hand touches, and `least_valid_object` its id; `state` is the state before the step.
    Without such pixels, a figure is absent.
    """
    view, frames = step.view, step.clip.frames
    skeletons = renderer.draw_hands(action.joints_m, action.cameras, kind=action.kind)[1]
    steady = _agree(frames, view.frames)[steady_pixels(view, np.isfinite(skeletons))]
    arms = hand_silhouette(action.joints_m, action.kind, action.cameras, HandShape()) >= 0
    seen = (view.mask == 0) & ~_widen(arms, ARM_MARGIN)
    agree = _agree(_blur(frames), _blur(view.frames))
    shares: dict[int, float] = {}
    for number in untouched(state, step.state, action.joints_m):
        pixels = seen & _without_outline(view.object_ids == number)
        if np.count_nonzero(pixels) >= MIN_OBJECT_PIXELS:
            shares[number] = float(agree[pixels].mean())
    figures = {"validity": float(steady.mean())} if steady.size else {}
    if shares:
        least = min(shares, key=shares.__getitem__)
        figures |= {"object_validity": shares[least], "least_valid_object": least}
    return figures


def steady_pixels(view: View, hands: Bool[np.ndarray, "f h w"]) -> Bool[np.ndarray, "f h w"]:
    """Return the mask of background pixels of a view in which nothing should move."""
    return (view.mask == 0) & ~_widen((view.object_ids != 0) | hands, SKELETON_MARGIN)


def untouched(
    before: SceneState, after: SceneState, joints_m: Float[np.ndarray, "f n j 3"]
) -> list[int]:
    """Return the ids of the objects that did not move, and that no hand came near."""
    joints = joints_m[np.isfinite(joints_m).all(axis=-1)]
    still = []
    for number in np.unique(before.object_ids[before.object_ids > 0]).tolist():
        poses = [s.world_from_object.get(number, np.eye(4)) for s in (before, after)]
        points = before.points_m[before.object_ids == number]
        if np.allclose(*poses, atol=1e-6) and not _is_near(joints, points):
            still.append(number)
    return still


def _is_near(joints_m: Float[np.ndarray, "k 3"], points_m: Float[np.ndarray, "m 3"]) -> bool:
    """Return True if a joint is within `TOUCH_M` of the box around an object."""
    low, high = points_m.min(axis=0) - TOUCH_M, points_m.max(axis=0) + TOUCH_M
    return bool(((joints_m >= low) & (joints_m <= high)).all(axis=1).any())


def _agree(
    frames: UInt8[np.ndarray, "f h w 3"], view: UInt8[np.ndarray, "f h w 3"]
) -> Bool[np.ndarray, "f h w"]:
    return np.abs(frames.astype(np.int16) - view).max(axis=-1) <= MAX_LEVELS


def _blur(frames: UInt8[np.ndarray, "f h w 3"]) -> UInt8[np.ndarray, "f h w 3"]:
    size = _size(frames.shape[2], BLUR)
    return np.stack([cv2.blur(frame, (size, size)) for frame in frames])


def _widen(masks: Bool[np.ndarray, "f h w"], margin: float) -> Bool[np.ndarray, "f h w"]:
    square = np.ones((_size(masks.shape[2], margin),) * 2, np.uint8)
    return np.stack([cv2.dilate(mask.astype(np.uint8), square) for mask in masks]) > 0


def _without_outline(masks: Bool[np.ndarray, "f h w"]) -> Bool[np.ndarray, "f h w"]:
    square = np.ones((3, 3), np.uint8)
    return np.stack([cv2.erode(mask.astype(np.uint8), square) for mask in masks]) > 0


def _size(width: int, fraction: float) -> int:
    """Return the side of a square in pixels, around a center, from a fraction of the width."""
    return 2 * round(fraction * width) + 1
