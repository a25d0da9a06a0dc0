"""Files that the commands of `egosim-convert` write, apart from what they read."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from egosim_jax.convert.source import INDEX
from egosim_jax.convert.stream import Weight, write
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.run import write_json
from egosim_jax.runtime.progress import track_bytes
from egosim_jax.types import InputError

LARGEST = 5_000_000_000
"""Bytes of a file above which a network is written as several."""


def apart(out: Path, source: Path) -> None:
    """Raise `InputError` if the output is the input or inside it."""
    here, there = (Path(os.path.realpath(path)) for path in (out, source))
    if there in (here, *here.parents):
        raise InputError(
            f"{quote_path(out)} is {quote_path(source)} or inside it, which is the input: choose a "
            "separate output path. (--out)"
        )


def write_file(
    target: Path,
    weights: Sequence[Weight],
    *,
    origin: Sequence[Path],
    metadata: Mapping[str, str],
    keep_log: bool = False,
) -> None:
    """Write a file of weights with progress; print its path."""
    total = sum(weight.bytes for weight in weights)
    pieces = write(target, weights, origin=origin, metadata=metadata, keep_log=keep_log)
    for _ in track_bytes(pieces, f"writing {target.name}", total=total):
        pass
    print(quote_path(target))


def write_sharded(stem: Path, weights: Sequence[Weight], *, origin: Sequence[Path]) -> None:
    """Write one file or, above 5 GB, several and an index."""
    shards: list[list[Weight]] = [[]]
    for weight in weights:
        if shards[-1] and sum(w.bytes for w in shards[-1]) + weight.bytes > LARGEST:
            shards.append([])
        shards[-1].append(weight)
    weight_map = {}
    for number, shard in enumerate(shards, start=1):
        end = f"-{number:05d}-of-{len(shards):05d}" if len(shards) > 1 else ""
        target = stem.with_name(f"{stem.name}{end}.safetensors")
        write_file(target, shard, origin=origin, metadata={"format": "pt"})
        weight_map |= {weight.name: target.name for weight in shard}
    if len(shards) > 1:
        total = sum(weight.bytes for weight in weights)
        index = {"metadata": {"total_size": total}, "weight_map": weight_map}
        write_json(stem.with_name(f"{stem.name}{INDEX}"), index)
