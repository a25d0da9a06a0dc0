"""Which things the hands acted on: five stages, from names to a file.

1. Semantic: names say what is a hand or an arm, and what is held.
2. Spatial: the box around a thing overlaps that around a hand, IoU > 0.15.
3. Depth: the median depths of thing and hands differ by less than 0.15 m.
4. Temporal: between two frames in which it is acted on a thing is acted on; one that is out of
   sight from then on is gone.
5. Serialized: what was found goes into plain arrays and comes back from them.

Source: EgoSim, section 3.3 (interaction-aware filtering) and the released `processors.py`, in which
stages 3 and 4 are never reached.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float32, Int32

OVERLAP, DEPTH_GAP_M = 0.15, 0.15
"""Of stages 2 and 3."""
ABSENT = 2
"""A thing is gone if it was not seen for so many frames after it was last acted on."""
_HANDS, _HELD = re.compile(r"\b(hand|hands|arm|arms|person)\b"), re.compile(r"\bin hands?\b")

Box = tuple[int, int, int, int]
Touched = dict[int, Bool[np.ndarray, " f"]]


def is_hand(name: str) -> bool:
    """Whether the name is of a part of the wearer: by whole words, so no handle, no armchair."""
    return bool(_HANDS.search(name.lower())) and not is_held(name)


def is_held(name: str) -> bool:
    """Whether the name says that the thing is held: a cup in hand."""
    return bool(_HELD.search(name.lower()))


def touched(
    object_ids: Int32[np.ndarray, "f h w"],
    depth_m: Float32[np.ndarray, "f h w"],
    names: Mapping[int, str],
) -> Touched:
    """For each thing that hands acted on, the frames in which they did: stages 1 to 4."""
    found: Touched = {}
    for number in sorted(set(np.unique(object_ids).tolist()) & set(names)):
        if number > 0 and not is_hand(names[number]):
            frames = np.array(
                [
                    (ids == number).any()
                    and (is_held(names[number]) or _acted_on(number, ids, depth))
                    for ids, depth in zip(object_ids, depth_m, strict=True)
                ]
            )
            if frames.any():
                found[number] = _without_gaps(frames)
    return found


def gone(object_ids: Int32[np.ndarray, "f h w"], touched: Touched) -> set[int]:
    """The things that were out of sight from when they were last acted on to the end."""
    lost = set()
    for number, frames in touched.items():
        after = int(np.flatnonzero(frames)[-1]) + 1
        seen = (object_ids == number).any(axis=(1, 2))
        if len(seen) - after >= ABSENT and not seen[after:].any():
            lost.add(number)
    return lost


def _acted_on(
    number: int, ids: Int32[np.ndarray, "h w"], depth_m: Float32[np.ndarray, "h w"]
) -> bool:
    """Stages 2 and 3 in one frame, with any part of a hand."""
    thing = ids == number
    box, distance = _box(thing), _median(depth_m[thing])
    for part in np.unique(ids[ids < 0]):
        hand = ids == part
        if overlap(box, _box(hand)) > OVERLAP:
            gap = abs(distance - _median(depth_m[hand]))
            if np.isnan(gap) or gap < DEPTH_GAP_M:  # what is not known cannot exclude
                return True
    return False


def _without_gaps(frames: Bool[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
    first, last = np.flatnonzero(frames)[[0, -1]]
    return (np.arange(len(frames)) >= first) & (np.arange(len(frames)) <= last)


def _median(depths: Float32[np.ndarray, " n"]) -> float:
    known = depths[np.isfinite(depths) & (depths > 0)]
    return float(np.median(known)) if len(known) else float("nan")


def _box(mask: Bool[np.ndarray, "h w"]) -> Box:
    """First and one past the last row, first and one past the last column."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1


def overlap(a: Box, b: Box) -> float:
    """Intersection over union of two boxes: rows from and to, columns from and to."""
    height = max(0, min(a[1], b[1]) - max(a[0], b[0]))
    width = max(0, min(a[3], b[3]) - max(a[2], b[2]))
    areas = [(box[1] - box[0]) * (box[3] - box[2]) for box in (a, b)]
    return height * width / (sum(areas) - height * width)


def to_arrays(found: Mapping[int, Bool[np.ndarray, " f"]]) -> dict[str, np.ndarray]:
    """What `touched` found as arrays that any file can hold: stage 5."""
    numbers = np.array(sorted(found), np.int32)
    return {
        "touched_ids": numbers,
        "touched_frames": np.array([found[number] for number in numbers.tolist()], bool),
    }


def from_arrays(arrays: Mapping[str, np.ndarray]) -> Touched:
    """The same from arrays; `KeyError` if they are not there."""
    frames = arrays["touched_frames"].astype(bool)
    return dict(zip(arrays["touched_ids"].tolist(), frames, strict=True))
