"""Windows of the clips of a dataset, read by threads ahead of what encodes them (`encode.py`)."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egosim_jax.configs.model import ModelConfig
from egosim_jax.data.records import RecordError
from egosim_jax.data.shards import ShardReader
from egosim_jax.data.transforms import decode_record, video_shape
from egosim_jax.io.decoding import Decoding
from egosim_jax.train.encoded_parts import Window
from egosim_jax.types import InputError, Triplet

READ_THREADS = min(8, os.cpu_count() or 1)
"""Threads that read clips while others are encoded."""


def windows(source: ShardReader, *, frames: int, stride: int) -> list[Window]:
    """Return every window of `frames` frames, `stride` apart.

    Reads every record of encoded videos; one that cannot be read has one window. Raises
    `InputError` if a clip is shorter than a window, or if the records are not clips with their
    target video.
    """
    manifest = source.manifest
    if manifest.kind == "latents" or "target" not in manifest.arrays:
        raise InputError(
            f"{source.folder} holds {manifest.kind} of {', '.join(manifest.arrays)}; expected "
            "videos or frames with their target. (--shards)"
        )
    known = manifest.arrays["prior"].shape[0] if manifest.kind == "frames" else None
    found = []
    for number in range(len(source)):
        try:
            last = (known or video_shape(source[number].arrays)[0]) - frames
        except InputError:  # reported when the window is read
            found.append((number, 0))
            continue
        if last < 0:
            raise InputError(
                f"{source.name(number)} has {last + frames} frames; a window needs {frames}."
            )
        found += [(number, start) for start in range(0, last + 1, stride)]
    return found


@dataclass(frozen=True)
class Damaged:
    """A window of a clip that cannot be read."""

    window: Window
    """Record number and first frame."""
    message: str
    """Error of the clip, for the log."""


Example = tuple[Window, Mapping[str, Any], Triplet]
"""A window with the metadata of its record and its triplet."""


def read_windows(
    source: ShardReader,
    jobs: Sequence[tuple[Path, Sequence[Window]]],
    config: ModelConfig,
    decoding: Decoding,
) -> Iterator[tuple[Path, list[Example | Damaged]]]:
    """Yield the clips of each job, read while the job before is encoded."""
    with ThreadPoolExecutor(READ_THREADS) as pool:
        before: tuple[Path, list[Future[Example | Damaged]]] | None = None
        for part, batch in jobs:
            now = (
                part,
                [pool.submit(_example, source, window, config, decoding) for window in batch],
            )
            if before is not None:
                yield before[0], [future.result() for future in before[1]]
            before = now
        if before is not None:
            yield before[0], [future.result() for future in before[1]]


def _example(
    source: ShardReader, window: Window, config: ModelConfig, decoding: Decoding
) -> Example | Damaged:
    number, start = window
    try:
        record = source[number]
        arrays: dict[str, Any] = decode_record(
            record.arrays, config.video, start=start, decoding=decoding
        )
    except RecordError as error:
        return Damaged(window, str(error))
    except InputError as error:
        return Damaged(window, f"{source.name(number)}: {error}")
    metadata = record.metadata
    names = {name: str(metadata.get(name, "")) for name in ("video_id", "prompt")}
    return window, metadata, Triplet(**names, **arrays)
