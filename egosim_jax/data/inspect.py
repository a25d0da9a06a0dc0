"""Inspection of shards: clips for a contact sheet, and statistics of each split."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from egosim_jax.data.shards import ShardReader
from egosim_jax.data.sheet import SheetClip
from egosim_jax.data.transforms import decode_record, video_shape
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError, VideoSpec


@dataclass
class SplitStatistics:
    """Number, lengths and prompts of the records of a split."""

    records: int = 0
    """Number of records of the shards."""
    lengths: Counter[int] = field(default_factory=Counter)
    """Number of records by their number of frames."""
    words: int = 0
    """Number of words of all prompts."""


def choose_clips(
    reader: ShardReader, *, by: Sequence[str], streams: Collection[str], limit: int, moments: int
) -> list[SheetClip]:
    """Decode videos of one clip per combination of values in the columns `by`.

    Without columns, decode videos of the first `limit` clips, in order. Keep `moments` frames of
    each video, evenly spaced from the first to the last, at the clip's own size. Raises
    `InputError` for latents and for unknown columns.
    """
    if reader.manifest.kind == "latents":
        raise InputError(f"{reader.folder} holds latents, not videos or frames. (--shards)")
    clips: dict[tuple[Any, ...], SheetClip] = {}
    for number, record in enumerate(track(reader, "reading", total=len(reader))):
        extra = record.metadata.get("extra", {})
        unknown = [name for name in by if name not in extra]
        if unknown:
            columns = ", ".join(sorted(extra)) or "none"
            raise InputError(f"The clips have no column {', '.join(unknown)}; known: {columns}.")
        key = tuple(extra[name] for name in by) if by else (number,)
        if key not in clips:
            frames, height, width = video_shape(record.arrays)
            spec = VideoSpec(frames=frames, height=height, width=width)
            kept = np.linspace(0, frames - 1, moments).round().astype(int)
            videos = decode_record(record.arrays, spec)
            shown = [videos[name][kept] for name in streams if name in videos]
            clips[key] = SheetClip(str(record.metadata.get("prompt", "")), shown)
        if len(clips) == limit:
            break
    return [clips[key] for key in sorted(clips)]


def split_statistics(reader: ShardReader) -> dict[str, SplitStatistics]:
    """Return the statistics of every split, sorted by name."""
    splits: dict[str, SplitStatistics] = {}
    for record in track(reader, "reading", total=len(reader)):
        name = str(record.metadata.get("extra", {}).get("split", "all"))
        split = splits.setdefault(name, SplitStatistics())
        split.records += 1
        split.lengths[video_shape(record.arrays)[0]] += 1
        split.words += len(str(record.metadata.get("prompt", "")).split())
    return dict(sorted(splits.items()))
