"""Find the objects of an annotated clip: moved by hands, or standing on a measured surface."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Int32

from egosim_jax.annotate.config import AnnotateConfig, Estimators
from egosim_jax.annotate.hand_tracks import visible
from egosim_jax.annotate.record import Record
from egosim_jax.types import object_name
from egosim_jax.types.arrays import Mask

MOVED = "moved object"
"""Name of an object that a hand moves, if no network names it."""


def find_moved_objects(record: Record, estimators: Estimators, config: AnnotateConfig) -> Record:
    """Add `moved_ids` with pixels and names, and `contacts`: the objects that hands move.

    An object that a network segmented keeps its id. A sleeve counts as an arm.
    """
    from egosim_jax.perception.video.moved import find_moved

    ids, names = record.require("object_ids").copy(), dict(record.names or {})
    objects = []
    if record.hands is not None and visible(record.hands).any():
        depth_m = record.require("depth").depth_m[0]
        objects = find_moved(
            record.frames,
            record.moving,
            record.hands,
            record.cameras,
            depth_m,
            fps=float(record.fps),
        )
    numbers: list[int] = []
    contacts: list[tuple[int, int, int]] = []
    for moved in objects:
        inside, count = np.unique(ids[0][moved.first], return_counts=True)
        number = int(inside[count.argmax()])
        if moved.worn:
            number = -1
        elif number <= 0:
            number = max(int(ids.max()), *names, 0) + 1
            names[number] = MOVED if MOVED not in names.values() else f"{MOVED} {number}"
        ids[moved.shown & (ids == 0)] = number
        if number > 0:
            numbers.append(number)
            contacts += [(frame, side, number) for frame, side in moved.contacts]
    notes = {"moved": {number: int((ids[0] == number).sum()) for number in numbers}}
    return record.add(
        "objects", notes, object_ids=ids, names=names, moved_ids=np.array(numbers, np.int32),
        contacts=np.array(contacts, np.int32).reshape(-1, 3),
    )  # fmt: skip


def drop_unmeasured(
    standing: Int32[np.ndarray, "h w"], confident: Mask
) -> Int32[np.ndarray, "h w"]:
    """Set objects to 0 unless at least half of their pixels have confident depth.

    Completed depth has bumps on walls and at the image border that look like objects.
    """
    sizes = np.bincount(standing.ravel())
    measured = np.bincount(standing.ravel(), weights=confident.ravel(), minlength=len(sizes))
    return np.where((2 * measured >= sizes)[standing], standing, 0)


def join_objects(
    ids: Int32[np.ndarray, "h w"], names: Mapping[int, str], standing: Int32[np.ndarray, "h w"]
) -> tuple[Int32[np.ndarray, "h w"], dict[int, str]]:
    """Add standing objects to the ids and names of moved ones; merge those that overlap.

    An object whose pixels are mostly on a moved one is part of it.
    """
    joined, named = ids.copy(), dict(names)
    for number in range(1, int(standing.max()) + 1):
        region = standing == number
        if not region.any():
            continue
        numbers = np.unique(ids[region & (ids > 0)], return_counts=True)
        shared = int(numbers[1].max(initial=0))
        if 2 * shared > region.sum():
            new = int(numbers[0][numbers[1].argmax()])
        else:
            new = max(int(joined.max()), *named, 0) + 1
            named[new] = object_name(new, {})
        joined[region & (joined == 0)] = new
    return joined, named
