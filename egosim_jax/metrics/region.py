"""Whether the right things are where they should be: silhouettes and places read off by color.

A thing of color c that is lit by s shows s * c. Where the scene without hands and without the
thing they move is known, each pixel belongs to whichever comes nearest to its color: that
background in some light, {s * b : 0.45 <= s <= 1.15}, or one of the colors of hands and thing. The
same rule reads the truth and the generated video; on the truth, where ids are known, it says how
far it can be trusted.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from numpy.lib.stride_tricks import sliding_window_view

from egosim_jax.metrics.image import decibels

SHADES = (0.45, 1.15)
"""Least and greatest light on a surface."""
LEAST_SEEN_PX = 20
"""Frames in which fewer pixels of a thing are visible say nothing about where it is."""
NEAR = 0.12
"""Share of the width around the median pixel of a thing in which its pixels count."""


def label(
    video: UInt8[np.ndarray, "f h w 3"],
    background: UInt8[np.ndarray, "f h w 3"],
    paints: Mapping[int, tuple[int, int, int]],
) -> Int[np.ndarray, "f h w"]:
    """What each pixel shows: an id of `paints`, which are RGB by id, or 0 for the background."""
    pixels = video.astype(np.float32)
    numbers = np.array([0, *paints])
    colors = [background, *(np.array(color) for color in paints.values())]
    distances = [_distance(pixels, color.astype(np.float32)) for color in colors]
    return numbers[np.argmin(distances, axis=0)]


def _distance(
    pixels: Float[np.ndarray, "f h w 3"], color: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "f h w"]:
    """Squared distance from a color in the light that brings it nearest."""
    strength = np.maximum(np.square(color).sum(axis=-1), 1e-6)
    shade = np.clip((pixels * color).sum(axis=-1) / strength, *SHADES)
    return np.square(pixels - shade[..., None] * color).sum(axis=-1)


def opened(silhouette: Bool[np.ndarray, "f h w"]) -> Bool[np.ndarray, "f h w"]:
    """The silhouette without what no 3 x 3 square fits into: lines along blurred edges, specks."""

    def around(mask: Bool[np.ndarray, "f h w"]) -> Bool[np.ndarray, "f h w 3 3"]:
        padded = np.pad(mask, ((0, 0), (1, 1), (1, 1)), mode="edge")
        return sliding_window_view(padded, (3, 3), axis=(1, 2))

    eroded = np.min(around(silhouette), axis=(3, 4))
    return np.max(around(eroded), axis=(3, 4))


def region_psnr(
    video: UInt8[np.ndarray, "f h w 3"],
    truth: UInt8[np.ndarray, "f h w 3"],
    region: Bool[np.ndarray, "f h w"],
) -> float:
    """PSNR in dB over the pixels of a region in all frames together; NaN if there are none."""
    if not region.any():
        return float("nan")
    return float(decibels(np.square(video[region].astype(np.float64) - truth[region]).mean()))


def silhouette_iou(found: Bool[np.ndarray, "f h w"], truth: Bool[np.ndarray, "f h w"]) -> float:
    """Intersection over union, averaged over the frames in which the truth has any; else NaN."""
    shown = truth.any(axis=(1, 2))
    both = (found & truth).sum(axis=(1, 2))[shown]
    either = (found | truth).sum(axis=(1, 2))[shown]
    return float((both / either).mean()) if shown.any() else float("nan")


def centroid_errors(
    found: Bool[np.ndarray, "f h w"], truth: Bool[np.ndarray, "f h w"]
) -> Float[np.ndarray, " g"]:
    """Distances in pixels between the centroids of two silhouettes.

    One for each frame in which the truth is seen well; a thing that is not found at all counts as
    a picture's width away.
    """
    width = truth.shape[2]
    errors = []
    for here, there in zip(found, truth, strict=True):
        if there.sum() >= LEAST_SEEN_PX:
            gap = _centroid(here) - _centroid(there) if here.any() else np.array([width, 0.0])
            errors.append(np.hypot(*gap))
    return np.array(errors)


def _centroid(silhouette: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, " 2"]:
    """Of the pixels around the median one: stray pixels of a like color do not count."""
    pixels = np.argwhere(silhouette)
    gaps = np.linalg.norm(pixels - np.median(pixels, axis=0), axis=1)
    near = gaps <= max(NEAR * silhouette.shape[1], gaps.min())
    return pixels[near].mean(axis=0)
