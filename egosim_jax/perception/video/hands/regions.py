"""Square regions of hands, their crops, and the mapping of keypoints back to the image.

A region comes from a palm or from keypoints. Its rotation makes the middle finger point up in the
crop, as in the landmark network's training (MediaPipe Hands, Zhang et al. 2020). Pixel centers are
at integer coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.types.arrays import RgbImage

CROP = 224
"""Height and width of the landmark network's input in pixels."""
_SIZED_BY = np.array([0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18])


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Regions:
    """Rotated squares in images."""

    center_px: Float[np.ndarray, "n 2"]
    """Columns and rows of the centers in pixels."""
    size_px: Float[np.ndarray, " n"]
    """Lengths of the sides in pixels."""
    angle: Float[np.ndarray, " n"]
    """Clockwise rotation in radians from the crop to the image."""


def regions_of_palms(
    boxes_px: Float[np.ndarray, "n 4"], keypoints_px: Float[np.ndarray, "n 7 2"]
) -> Regions:
    """Return the hand regions of detected palms; boxes are center and size."""
    angle = _upright(keypoints_px[:, 0], keypoints_px[:, 2])
    return _enlarged(boxes_px[:, :2], boxes_px[:, 2:], angle, shift=-0.5, scale=2.6)


def regions_of_joints(joints_px: Float[np.ndarray, "n 21 2"]) -> Regions:
    """Return the hand regions of keypoints, for the same or an adjacent frame."""
    knuckles = (joints_px[:, 5] + joints_px[:, 13] + 2 * joints_px[:, 9]) / 4
    angle = _upright(joints_px[:, 0], knuckles)
    palm = joints_px[:, _SIZED_BY]
    middle = (palm.min(1) + palm.max(1)) / 2
    inside = np.einsum("nij,nkj->nki", _turn(-angle), palm - middle[:, None])
    low, high = inside.min(1), inside.max(1)
    center = middle + np.einsum("nij,nj->ni", _turn(angle), (low + high) / 2)
    return _enlarged(center, high - low, angle, shift=-0.1, scale=2.0)


def crop_region(frame: RgbImage, regions: Regions, index: int) -> UInt8[np.ndarray, "224 224 3"]:
    """Return the upright crop of one region; zero outside the image."""
    to_image = regions.size_px[index] / CROP * _turn(regions.angle[index : index + 1])[0]
    center = regions.center_px[index] - to_image @ np.full(2, (CROP - 1) / 2)
    matrix = np.concatenate([to_image, center[:, None]], axis=1)
    return cv2.warpAffine(
        frame,
        matrix,
        (CROP, CROP),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
    )


def joints_in_image(
    regions: Regions, joints_crop: Float[np.ndarray, "n 21 2"]
) -> Float[np.ndarray, "n 21 2"]:
    """Return image pixels of keypoints from crop pixels, which span 0 to 224 edge to edge."""
    inside = (joints_crop / CROP - 0.5) * regions.size_px[:, None, None]
    return regions.center_px[:, None] + np.einsum("nij,nkj->nki", _turn(regions.angle), inside)


def unrotate(
    regions: Regions, joints_m: Float[np.ndarray, "n 21 3"]
) -> Float[np.ndarray, "n 21 3"]:
    """Return keypoints in camera axes from keypoints in the crop's axes."""
    turned = np.einsum("nij,nkj->nki", _turn(regions.angle), joints_m[..., :2])
    return np.concatenate([turned, joints_m[..., 2:]], axis=-1)


def _upright(wrist_px: np.ndarray, knuckle_px: np.ndarray) -> np.ndarray:
    """Return the clockwise angle in the image from up to the wrist-knuckle direction."""
    right, down = (knuckle_px - wrist_px).T
    return np.arctan2(right, -down)


def _turn(angle: np.ndarray) -> np.ndarray:
    """Return matrices `n 2 2` that rotate clockwise in an image with rows downward."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)


def _enlarged(
    center: np.ndarray, size: np.ndarray, angle: np.ndarray, *, shift: float, scale: float
) -> Regions:
    moved = np.einsum("nij,j->ni", _turn(angle), [0, shift]) * size[:, 1:]
    return Regions(center_px=center + moved, size_px=scale * size.max(1), angle=angle)
