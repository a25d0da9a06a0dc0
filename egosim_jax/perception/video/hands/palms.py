"""Palm detection: tiles of a frame, anchors, decoding, and weighted non-maximum suppression.

The detector's input is 192 x 192 pixels. Its outputs are relative to 2016 anchors at cell centers:
two per cell of a 24 x 24 grid, and six per cell of a 12 x 12 grid (MediaPipe's SSD).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from egosim_jax.types.arrays import RgbImage

INPUT = 192
"""Height and width of the detector's input in pixels."""
PALM_KEYPOINTS = 7
"""Number of keypoints of a palm: wrist, four knuckles, two of the thumb."""
MAX_IOU = 0.3
"""Maximum intersection over union (IoU) of detections of different palms."""
_GRIDS = ((24, 2), (12, 6))
_POSITIONS = [0, *range(2, 2 + PALM_KEYPOINTS)]
"""Rows of a detection with positions (center and keypoints); row 1 is the size."""
_MAX_LOGIT = 100.0


@dataclass(frozen=True)
class Tile:
    """Square part of a frame for one run of the detector."""

    left_px: int
    """Column of the left edge; negative if the tile is wider than the frame."""
    top_px: int
    """Row of the upper edge."""
    size_px: int
    """Length of the sides in pixels."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Palms:
    """Detected palms of one frame, in pixels."""

    boxes_px: Float[np.ndarray, "n 4"]
    """Column and row of the center, width and height."""
    keypoints_px: Float[np.ndarray, "n 7 2"]
    """Columns and rows of the palm's keypoints."""
    score: Float[np.ndarray, " n"]
    """Confidence from 0 to 1, in decreasing order."""


def make_anchors() -> Float32[np.ndarray, "2016 2"]:
    """Return the centers of the detector's anchors, from 0 to 1 across its input."""
    grids = []
    for cells, repeats in _GRIDS:
        row, column = np.mgrid[:cells, :cells]
        centers = (np.stack([column, row], axis=-1).reshape(-1, 2) + 0.5) / cells
        grids.append(np.repeat(centers, repeats, axis=0))
    return np.concatenate(grids).astype(np.float32)


def make_tiles(height: int, width: int) -> list[Tile]:
    """Return the tiles of a frame: one around the frame, and squares along its longer side."""
    long, short = max(height, width), min(height, width)
    tiles = [Tile((width - long) // 2, (height - long) // 2, long)]
    if long > 1.2 * short:
        count = int(np.ceil(long / short))
        for start in np.linspace(0, long - short, count):
            left, top = (round(start), 0) if width > height else (0, round(start))
            tiles.append(Tile(left, top, short))
    return tiles


def cut_tile(frame: RgbImage, tile: Tile) -> UInt8[np.ndarray, "192 192 3"]:
    """Return a tile at the detector's size, zero outside the frame."""
    height, width = frame.shape[:2]
    left, top = tile.left_px, tile.top_px
    inside = frame[max(top, 0) : top + tile.size_px, max(left, 0) : left + tile.size_px]
    padded = cv2.copyMakeBorder(
        inside,
        max(-top, 0),
        max(top + tile.size_px - height, 0),
        max(-left, 0),
        max(left + tile.size_px - width, 0),
        cv2.BORDER_CONSTANT,
    )
    return cv2.resize(padded, (INPUT, INPUT), interpolation=cv2.INTER_AREA)


def decode_palms(
    boxes: Float32[np.ndarray, "b 2016 18"],
    logits: Float32[np.ndarray, "b 2016"],
    tiles: list[Tile],
    *,
    min_score: float,
) -> Palms:
    """Return the palms of one frame from the detector's outputs for its tiles."""
    anchors = make_anchors()
    score = 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -_MAX_LOGIT, _MAX_LOGIT)))
    found_boxes, found_scores = [], []
    for box, tile_score, tile in zip(boxes, score, tiles, strict=True):
        kept = tile_score >= min_score
        values = box[kept].reshape(-1, 2 + PALM_KEYPOINTS, 2).astype(np.float64) / INPUT
        values[:, _POSITIONS] += anchors[kept, None]
        values *= tile.size_px
        values[:, _POSITIONS] += np.array([tile.left_px, tile.top_px]) - 0.5
        found_boxes.append(values)
        found_scores.append(tile_score[kept])
    return merge_overlapping(np.concatenate(found_boxes), np.concatenate(found_scores))


def merge_overlapping(values: Float[np.ndarray, "n 9 2"], score: Float[np.ndarray, " n"]) -> Palms:
    """Merge overlapping detections into their mean, weighted by score.

    `values` has center, size and keypoints. A merged detection keeps the highest score.
    """
    merged, scores = [], []
    order = np.argsort(-score, kind="stable")
    while len(order):
        same = _iou(values[order[0]], values[order]) > MAX_IOU
        same[0] = True
        group = order[same]
        merged.append(np.average(values[group], axis=0, weights=score[group]))
        scores.append(score[order[0]])
        order = order[~same]
    palms = np.array(merged).reshape(-1, 2 + PALM_KEYPOINTS, 2)
    return Palms(
        boxes_px=palms[:, :2].reshape(-1, 4), keypoints_px=palms[:, 2:], score=np.array(scores)
    )


def _iou(one: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the intersection over union (IoU) of one box with others."""
    low = np.maximum(one[0] - one[1] / 2, others[:, 0] - others[:, 1] / 2)
    high = np.minimum(one[0] + one[1] / 2, others[:, 0] + others[:, 1] / 2)
    shared = np.clip(high - low, 0, None).prod(-1)
    return shared / np.maximum(one[1].prod() + others[:, 1].prod(-1) - shared, 1e-12)
