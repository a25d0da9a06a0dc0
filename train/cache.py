"""Encode clips once, so that training steps read latents and embeddings instead of videos.

Every window of a clip is a record of its own, since the causal VAE encodes a window's first frame
alone. The manifest's provenance names the config and the hashes of the encoders' weights.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.data.transforms import decode_record, record_length
from egosim_jax.generator import Generator, batches
from egosim_jax.types import InputError, Triplet


def windows(source: ShardReader, *, frames: int, stride: int) -> list[tuple[int, int]]:
    """Record number and first frame of every window of `frames` frames, `stride` apart.

    Reads every record. Raises `InputError` if a clip is shorter than a window.
    """
    found = []
    for number, record in enumerate(source):
        last = record_length(record.arrays) - frames
        if last < 0:
            raise InputError(
                f"{source.name(number)} has {last + frames} frames; a window needs {frames}."
            )
        found += [(number, start) for start in range(0, last + 1, stride)]
    return found


def cache(
    generator: Generator,
    *,
    source: ShardReader,
    todo: Sequence[tuple[int, int]],
    out: Path,
    batch_size: int,
    provenance: Mapping[str, Any],
    overwrite: bool = False,
) -> Iterator[tuple[int, int]]:
    """Write latents shards; yields each window of `todo` once it is encoded.

    `source` holds videos or frames with a truth, `todo` the windows of it that are wanted.
    """
    spec = generator.config.video
    with ShardWriter(
        out, kind="latents", spec=spec, provenance=provenance, overwrite=overwrite
    ) as writer:
        for batch in batches(todo, batch_size):
            filled = [*batch, *[batch[-1]] * (batch_size - len(batch))]
            examples = generator.cache([_triplet(source, *window, generator) for window in filled])
            for (number, start), arrays in zip(batch, examples, strict=False):
                writer.add(arrays, {**source[number].metadata, "start": start})
                yield number, start


def _triplet(source: ShardReader, number: int, start: int, generator: Generator) -> Triplet:
    record = source[number]
    arrays: dict[str, Any] = decode_record(record.arrays, generator.config.video, start=start)
    return Triplet(
        video_id=str(record.metadata["video_id"]),
        prompt=str(record.metadata["prompt"]),
        **arrays,
    )
