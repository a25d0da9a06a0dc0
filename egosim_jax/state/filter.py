"""Interaction filter: which objects the hands acted on, and in which frames.

1. Semantic: names identify hands and arms, and held objects.
2. Spatial: the boxes of an object and a hand overlap, IoU > 0.15.
3. Depth: the median depths of object and hand differ by less than 0.15 m.
4. Temporal: an object is interacted with in all frames between its first and its last interaction.
   It has disappeared if it is invisible in all frames after the last.

Source: EgoSim, section 3.3 (interaction-aware filtering) and the released `processors.py`, which
never reaches stages 3 and 4.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float32, Int32

from egosim_jax.types.arrays import DepthMaps, IdMaps, Mask

MIN_BOX_IOU = 0.15
"""Minimum IoU of the boxes of an object and a hand that interact."""
MAX_DEPTH_GAP_M = 0.15
"""Maximum difference of the median depths of an object and a hand that interact, in meters."""
MIN_ABSENT_FRAMES = 2
"""An object has disappeared if it is invisible for this many frames after its last interaction."""
_HANDS, _HELD = re.compile(r"\b(hand|hands|arm|arms|person)\b"), re.compile(r"\bin hands?\b")

Box = tuple[int, int, int, int]
InteractedFrames = dict[int, Bool[np.ndarray, " f"]]


def is_hand(name: str) -> bool:
    """Return whether a name means a hand or arm, by whole words: not `handle` or `armchair`."""
    return bool(_HANDS.search(name.lower())) and not is_held(name)


def is_held(name: str) -> bool:
    """Return whether a name says that the object is held, as in `cup in hand`."""
    return bool(_HELD.search(name.lower()))


def interacted_frames(
    object_ids: IdMaps, depth_m: DepthMaps, names: Mapping[int, str]
) -> InteractedFrames:
    """Return the frames in which hands acted on each object; objects without any are absent."""
    frames_of: InteractedFrames = {}
    for number in sorted(set(np.unique(object_ids).tolist()) & set(names)):
        if number > 0 and not is_hand(names[number]):
            frames = np.array(
                [
                    (ids == number).any()
                    and (is_held(names[number]) or is_interacting(number, ids, depth))
                    for ids, depth in zip(object_ids, depth_m, strict=True)
                ]
            )
            if frames.any():
                frames_of[number] = fill_gaps(frames)
    return frames_of


def disappeared_objects(object_ids: IdMaps, interactions: InteractedFrames) -> set[int]:
    """Return the objects that are invisible in all frames after their last interaction."""
    lost = set()
    for number, frames in interactions.items():
        after = int(np.flatnonzero(frames)[-1]) + 1
        seen = (object_ids == number).any(axis=(1, 2))
        if len(seen) - after >= MIN_ABSENT_FRAMES and not seen[after:].any():
            lost.add(number)
    return lost


def is_interacting(
    number: int, ids: Int32[np.ndarray, "h w"], depth_m: Float32[np.ndarray, "h w"]
) -> bool:
    """Return whether an object and any hand or arm interact in one frame (stages 2 and 3)."""
    instance = ids == number
    box, distance = mask_box(instance), _median(depth_m[instance])
    for number_of_hand in np.unique(ids[ids < 0]):
        hand = ids == number_of_hand
        if box_iou(box, mask_box(hand)) > MIN_BOX_IOU:
            gap = abs(distance - _median(depth_m[hand]))
            if np.isnan(gap) or gap < MAX_DEPTH_GAP_M:  # unknown depth excludes nothing
                return True
    return False


def fill_gaps(frames: Bool[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    """Return a mask of all frames from the first to the last one set in `frames`."""
    first, last = np.flatnonzero(frames)[[0, -1]]
    return (np.arange(len(frames)) >= first) & (np.arange(len(frames)) <= last)


def _median(depths: Float32[np.ndarray, " n"]) -> float:
    finite = depths[np.isfinite(depths) & (depths > 0)]
    return float(np.median(finite)) if len(finite) else float("nan")


def mask_box(mask: Mask) -> Box:
    """Return first column and row of a mask, and one past the last ones."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def box_iou(a: Sequence[int | float], b: Sequence[int | float]) -> float:
    """Return the intersection over union of two boxes (first column and row, last ones)."""
    width = max(0.0, min(a[2], b[2]) - max(a[0], b[0]))
    height = max(0.0, min(a[3], b[3]) - max(a[1], b[1]))
    areas = [(box[2] - box[0]) * (box[3] - box[1]) for box in (a, b)]
    union = sum(areas) - width * height
    return width * height / union if union > 0 else 0.0
