"""Silhouettes and positions of hands and objects, segmented by color.

An object of color c under light s has pixels of color s * c. Given the background (the scene
without hands and manipulated object), each pixel gets the label of the nearest color: the
background under some light, {s * b : 0.45 <= s <= 1.15}, or a color of the hands or the object.
The same rule labels the ground truth and the generated video. Its accuracy can be measured on the
ground truth, whose ids are known.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from egosim_jax.evaluation.metrics.image import decibels

SHADES = (0.45, 1.15)
"""Minimum and maximum light on a surface."""
MIN_VISIBLE_PX = 20
"""Minimum number of pixels of an object in a frame for it to count as visible."""
RIGHT_LEVELS = 30
"""Maximum difference of a pixel that counts as right, in 8-bit levels."""
MOVING_M = 0.001
"""Minimum motion of an object between two frames in which it moves, in meters."""
CENTROID_RADIUS = 0.12
"""Radius around an object's median pixel for its centroid, as a fraction of the width."""


def label(
    video: UInt8[np.ndarray, "f h w 3"],
    background: UInt8[np.ndarray, "f h w 3"],
    paints: Mapping[int, tuple[int, int, int]],
) -> Int[np.ndarray, "f h w"]:
    """Return the label of each pixel: an id of `paints`, RGB by id, or 0 for the background."""
    pixels = video.astype(np.float32)
    numbers = np.array([0, *paints])
    colors = [background, *(np.array(color) for color in paints.values())]
    distances = [_distance(pixels, color.astype(np.float32)) for color in colors]
    return numbers[np.argmin(distances, axis=0)]


def find(
    number: int,
    video: UInt8[np.ndarray, "f h w 3"],
    background: UInt8[np.ndarray, "f h w 3"],
    paints: Mapping[int, tuple[int, int, int]],
) -> Bool[np.ndarray, "f h w"]:
    """Return the opened silhouette of body `number` in a video.

    A pixel belongs to the body with the nearest color among the background and all of `paints`,
    because hands and other bodies may also be misplaced in the video.
    """
    return open_mask(label(video, background, paints) == number)


def _distance(
    pixels: Float[np.ndarray, "f h w 3"], color: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "f h w"]:
    """Return the squared distance to a color under the best light."""
    strength = np.maximum(np.square(color).sum(axis=-1), 1e-6)
    shade = np.clip((pixels * color).sum(axis=-1) / strength, *SHADES)
    return np.square(pixels - shade[..., None] * color).sum(axis=-1)


def open_mask(mask: Bool[np.ndarray, "f h w"]) -> Bool[np.ndarray, "f h w"]:
    """Return masks without lines and specks narrower than 3 pixels (morphological opening)."""
    import cv2

    square = np.ones((3, 3), np.uint8)
    opened = [cv2.morphologyEx(m.astype(np.uint8), cv2.MORPH_OPEN, square) for m in mask]
    return np.stack(opened) > 0


def region_psnr(
    video: UInt8[np.ndarray, "f h w 3"],
    target: UInt8[np.ndarray, "f h w 3"],
    region: Bool[np.ndarray, "f h w"],
) -> float:
    """Return the PSNR in dB over the pixels of a region in all frames; NaN if it is empty."""
    return float(decibels(np.asarray(squared_error(video, target, region))))


def squared_error(
    video: UInt8[np.ndarray, "f h w 3"],
    target: UInt8[np.ndarray, "f h w 3"],
    region: Bool[np.ndarray, "f h w"],
) -> float:
    """Return the mean squared error in 8-bit levels over a region; NaN if it is empty."""
    if not region.any():
        return float("nan")
    return float(np.square(video[region].astype(np.float64) - target[region]).mean())


def right_share(
    video: UInt8[np.ndarray, "f h w 3"],
    target: UInt8[np.ndarray, "f h w 3"],
    region: Bool[np.ndarray, "f h w"],
) -> float:
    """Return the share of a region's pixels within 30 levels of the target; NaN if it is empty."""
    if not region.any():
        return float("nan")
    gaps = np.abs(video[region].astype(int) - target[region]).max(axis=-1)
    return float((gaps <= RIGHT_LEVELS).mean())


def held_and_released(
    path: Float[np.ndarray, "f 4 4"],
) -> tuple[Bool[np.ndarray, " f"], Bool[np.ndarray, " f"]]:
    """Return the frames in which an object moves, and the frames after it came to rest."""
    moving = np.zeros(len(path), bool)
    moving[1:] = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1) > MOVING_M
    after = np.zeros(len(path), bool)
    if moving.any():
        after[np.flatnonzero(moving)[-1] + 1 :] = True
    return moving, after


def silhouette_iou(
    silhouettes: Bool[np.ndarray, "f h w"], target: Bool[np.ndarray, "f h w"]
) -> float:
    """Return the IoU, averaged over the frames with target pixels; NaN without such frames."""
    shown = target.any(axis=(1, 2))
    both = (silhouettes & target).sum(axis=(1, 2))[shown]
    either = (silhouettes | target).sum(axis=(1, 2))[shown]
    return float((both / either).mean()) if shown.any() else float("nan")


def centroid_errors(
    silhouettes: Bool[np.ndarray, "f h w"], target: Bool[np.ndarray, "f h w"]
) -> Float[np.ndarray, " g"]:
    """Return the distances in pixels between the centroids of two silhouettes.

    There is one distance per frame with a visible target. An empty silhouette counts as one image
    width away.
    """
    width = target.shape[2]
    shown = _visible(target)
    errors = []
    for here, there in zip(silhouettes[shown], target[shown], strict=True):
        gap = _centroid(here) - _centroid(there) if here.any() else np.array([width, 0.0])
        errors.append(np.hypot(*gap))
    return np.array(errors)


def lost_share(silhouettes: Bool[np.ndarray, "f h w"], target: Bool[np.ndarray, "f h w"]) -> float:
    """Return the fraction of frames with a visible but lost target; NaN if it is never visible."""
    shown = _visible(target)
    return float((~silhouettes[shown].any(axis=(1, 2))).mean()) if shown.any() else float("nan")


def _visible(silhouettes: Bool[np.ndarray, "f h w"]) -> Bool[np.ndarray, " f"]:
    """Return True for frames with enough visible pixels."""
    return silhouettes.sum(axis=(1, 2)) >= MIN_VISIBLE_PX


def _centroid(silhouette: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, " 2"]:
    """Return the centroid of the pixels near the median pixel, without stray pixels."""
    pixels = np.argwhere(silhouette)
    gaps = np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1)
    near = gaps <= max(CENTROID_RADIUS * silhouette.shape[1], gaps.min())
    return pixels[near].mean(axis=0)
