"""Crops of the recorded images that the clips of a folder show, by data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from egosim_jax.data.windows import Window
from egosim_jax.evaluation.cache import ScoreCache
from egosim_jax.evaluation.measures import VERSION
from egosim_jax.evaluation.methods import Folder, without_border
from egosim_jax.evaluation.registration import (
    FRAMES,
    TRUE_FRAMES,
    WHOLE,
    Edges,
    Found,
    Pair,
    find_crop,
    places,
)
from egosim_jax.io.digest import fingerprint, sha256
from egosim_jax.io.video import VideoInfo, probe_video, read_video

CLIPS, MAX_FRAMES = 8, 64
"""Maximum number of clips from which a crop is found, and of the frames read of each."""


def find_crops(
    folder: Folder, lengths: Mapping[Window, VideoInfo], *, cache: ScoreCache, every: bool
) -> list[str]:
    """Find the crop of each data set's clips of one size; store it in the folder.

    Without `every`, images of the ground truth's size show all of it. Returns the crops in words.
    """
    groups: dict[tuple[str, int, int, int, int], list[tuple[Window, Path]]] = {}
    for window, info in lengths.items():
        path = window.files.target
        if path is None or not path.exists():
            continue
        truth = probe_video(path)
        blank = np.broadcast_to(np.uint8(0), (info.height, info.width))
        size = without_border(blank, truth.height, truth.width).shape
        if every or size != (truth.height, truth.width):
            key = (window.files.extra.get("dataset", ""), *size, truth.height, truth.width)
            groups.setdefault(key, []).append((window, path))
    lines = []
    for (dataset, _, _, height, width), clips in groups.items():
        result = _find(folder, clips[:CLIPS], lengths, cache)
        folder.crops.update({window.output_id: result.crop for window, _ in clips})
        evidence = f"correlation {result.correlation:.3f}, {len(clips[:CLIPS])} clips"
        if not result.found:
            text = "no crop was found; the images are stretched to the whole"
        elif result.crop == WHOLE:
            text = "the whole image"
        else:
            edges = result.crop.pixels(height, width)
            left, top, right, bottom = (f"{edge + 0:.1f}" for edge in np.round(edges, 1))
            text = f"columns {left} to {right}, rows {top} to {bottom} of {width}x{height}"
        name = f"{folder.name}, {dataset}" if dataset else folder.name
        lines.append(f"{name}: {text} ({evidence})")
    return lines


def _find(
    folder: Folder,
    clips: Sequence[tuple[Window, Path]],
    lengths: Mapping[Window, VideoInfo],
    cache: ScoreCache,
) -> Found:
    """Return the crop of some clips, cached or computed."""
    content = [[sha256(folder.file(w)), sha256(path), w.start] for w, path in clips]
    key = fingerprint(["crop", VERSION, content])
    cached = cache.get(key)
    if cached is None:
        found = find_crop(
            [_pair(folder.file(w), path, w.start, lengths[w].frames) for w, path in clips]
        )
        cached = {**found.crop._asdict(), "correlation": found.correlation}
        cache.put(key, {**cached, "found": float(found.found)})
        return found
    crop = Edges(*(cached[name] for name in Edges._fields))
    return Found(crop, cached["correlation"], bool(cached["found"]))


def _pair(video: Path, truth: Path, start: int, count: int) -> Pair:
    """Return frames of a method's clip and of its ground truth, over equal times."""
    count = min(count, MAX_FRAMES)
    true = read_video(truth, start=start, stop=start + count).frames
    taken = np.unique(places(TRUE_FRAMES, min(count, len(true)))).tolist()
    chosen = [taken[place] for place in np.unique(places(FRAMES, len(taken)))]
    border = partial(without_border, height=true.shape[1], width=true.shape[2])
    frames = read_video(video, stop=count, each=border).frames
    return frames[chosen], true[taken]
