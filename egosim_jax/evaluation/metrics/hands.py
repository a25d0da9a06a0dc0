"""Agreement of detected hands with the ground truth: keypoint error, recall and IoU.

Keypoints are in pixels: 21 per hand, as in MediaPipe and MANO, left hand first (`f 2 21 2`). They
are NaN where a hand was not found.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float


def keypoint_errors(
    found_px: Float[np.ndarray, "f 2 21 2"], target_px: Float[np.ndarray, "f 2 21 2"]
) -> Float[np.ndarray, " n"]:
    """Return the mean keypoint distance in pixels of each hand found in both videos."""
    distances = np.linalg.norm(found_px - target_px, axis=-1).mean(axis=-1)
    return distances[np.isfinite(distances)]


def hand_recall(
    found_px: Float[np.ndarray, "f 2 21 2"], target_px: Float[np.ndarray, "f 2 21 2"]
) -> float:
    """Return the fraction of the target's hands found in the video; NaN without target hands."""
    shown, there = _present(target_px), _present(found_px)
    return float((shown & there).sum() / shown.sum()) if shown.any() else float("nan")


def hand_iou(
    found_px: Float[np.ndarray, "f 2 21 2"],
    target_px: Float[np.ndarray, "f 2 21 2"],
    *,
    height: int,
    width: int,
) -> float:
    """Return the IoU of the hands' convex hulls, averaged over the frames with a target hand.

    A missing hand has no area. NaN if no frame of the target has a hand.
    """
    values = []
    for here, there in zip(found_px, target_px, strict=True):
        target = hull_mask(there, height, width)
        if target.any():
            hull = hull_mask(here, height, width)
            values.append((hull & target).sum() / (hull | target).sum())
    return float(np.mean(values)) if values else float("nan")


def hull_mask(
    joints_px: Float[np.ndarray, "2 21 2"], height: int, width: int
) -> Bool[np.ndarray, "height width"]:
    """Return the pixels inside the convex hull of either hand's keypoints."""
    import cv2

    mask = np.zeros((height, width), np.uint8)
    for joints in joints_px:
        if np.isfinite(joints).all():
            hull = cv2.convexHull(joints.round().astype(np.int32))
            cv2.fillConvexPoly(mask, hull, 1)
    return mask > 0


def _present(joints_px: Float[np.ndarray, "f 2 21 2"]) -> Bool[np.ndarray, "f 2"]:
    return np.asarray(np.isfinite(joints_px).all(axis=(2, 3)))
