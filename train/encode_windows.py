"""Windows of clips: their list, their decoding ahead of `encode.py`, and a record of each part."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egosim_jax.configs.model import ModelConfig
from egosim_jax.data.clip_files import prior_problem
from egosim_jax.data.manifest import MANIFEST
from egosim_jax.data.shards import ShardReader
from egosim_jax.data.transforms import decode_record, video_shape
from egosim_jax.io.bounded import named, read_json
from egosim_jax.io.decoding import Decoding
from egosim_jax.io.run import write_json
from egosim_jax.types import InputError, Triplet

READ_THREADS = min(8, os.cpu_count() or 1)
"""Number of threads that read clips during encoding."""
Window = tuple[int, int]
"""Record number and first frame of a window."""


def windows(source: ShardReader, *, frames: int, stride: int) -> list[Window]:
    """Return all windows of `frames` frames, `stride` frames apart.

    Reads every record of encoded videos; an unreadable record gets one window. Raises `InputError`
    if a clip is shorter than a window, or if the records are not clips with their target video.
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
        except InputError:  # `read_windows` reports it, with one window
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
    """A window of an unreadable clip."""

    window: Window
    """Record number and first frame."""
    message: str
    """Error message for the log."""


Example = tuple[Window, Mapping[str, Any], Triplet]
"""A window, the metadata of its record, and its triplet."""


def read_windows(
    source: ShardReader,
    jobs: Sequence[tuple[Path, Sequence[Window]]],
    config: ModelConfig,
    decoding: Decoding,
) -> Iterator[tuple[Path, list[Example | Damaged]]]:
    """Yield the clips of each job; threads read a job while the caller encodes the previous one."""
    with ThreadPoolExecutor(READ_THREADS) as pool:
        # One job ahead, not all of them: decoded clips are large.
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
        if problem := prior_problem(record.metadata.get("extra", {}), config.prior):
            raise InputError(problem)
        arrays: dict[str, Any] = decode_record(
            record.arrays, config.video, start=start, decoding=decoding, check_rate=True
        )
    except InputError as error:
        return Damaged(window, named(source.name(number), error))
    metadata = record.metadata
    names = {name: str(metadata.get(name, "")) for name in ("video_id", "prompt")}
    return window, metadata, Triplet(**names, **arrays)


@dataclass(frozen=True)
class PartWindows:
    """Windows of one part (a shard), stored in a JSON file next to the folder of the part."""

    windows: Sequence[Window]
    """Windows of the part, in order; empty if there is no file yet."""
    skipped: Sequence[Window]
    """Windows of unreadable clips, which the part skips."""

    @classmethod
    def read(cls, part: Path) -> PartWindows:
        """Read the file of a part."""
        path = part.with_suffix(".json")
        found = read_json(path) if path.exists() else {"windows": [], "skipped": []}
        windows, skipped = (
            [(number, start) for number, start in found[name]] for name in ("windows", "skipped")
        )
        return cls(windows, skipped)

    def write(self, part: Path) -> None:
        """Write the file of a part. Complete the part after its file, not before."""
        write_json(part.with_suffix(".json"), {"windows": self.windows, "skipped": self.skipped})

    @property
    def is_empty(self) -> bool:
        """True if all windows were skipped: the part has no shard."""
        return bool(self.windows) and self.windows == self.skipped

    def is_done(self, part: Path, todo: Sequence[Window]) -> bool:
        """Return True if a part is written and has the windows `todo`."""
        written = self.is_empty or (part / MANIFEST).exists()
        return written and self.windows == list(todo)
