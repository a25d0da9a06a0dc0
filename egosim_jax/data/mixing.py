"""Weighted mixtures of shards, such as DWM's hybrid of rendered and recorded data.

A mixture is a folder whose `mixture.json` names other folders of shards, relative to itself, and
their weights. It is read as one source: the parts' records, part after part. Training draws from
the parts in proportion to their weights and reshuffles a part after every pass over it. The
sequence depends on the seed alone (`data/loader.py`).
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from egosim_jax.data.manifest import MANIFEST, Manifest
from egosim_jax.data.records import Record
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.bounded import listing, quote, quote_path, read_json
from egosim_jax.io.run import write_json
from egosim_jax.types import InputError

MIXTURE = "mixture.json"
MAX_PARTS = 64
"""Maximum number of folders in a mixture."""


def open_shards(folder: Path) -> ShardReader | Mixture:
    """Open a folder of shards, or a mixture of such folders."""
    if not (folder / MIXTURE).is_file() or (folder / MANIFEST).is_file():
        return ShardReader(folder)
    parts = read_mixture(folder)
    return Mixture(folder, [ShardReader(part) for part in parts], list(parts.values()))


def write_mixture(folder: Path, parts: Mapping[Path, float]) -> None:
    """Write a mixture of folders and their weights; check that they can be mixed.

    Raises `InputError` if the folder holds shards itself.
    """
    if (folder / MANIFEST).exists():
        raise InputError(f"{quote_path(folder)} holds shards: choose another folder. (--out)")
    Mixture(folder, [ShardReader(part) for part in parts], list(parts.values()))
    listed = [
        {"shards": os.path.relpath(part.resolve(), folder.resolve()), "weight": weight}
        for part, weight in parts.items()
    ]
    write_json(folder / MIXTURE, {"parts": listed})


def read_mixture(folder: Path) -> dict[Path, float]:
    """Return the folders of a mixture and their weights. Raises `InputError` if it is invalid."""
    path = folder / MIXTURE
    written = read_json(path)
    listed = written.get("parts") if isinstance(written, dict) else None
    if not isinstance(listed, list) or not 0 < len(listed) <= MAX_PARTS:
        raise InputError(
            f"{quote_path(path)} has parts {quote(listed)}: it must be a list of 1 to {MAX_PARTS}."
        )
    parts: dict[Path, float] = {}
    for entry in listed:
        name, weight = (
            (entry.get("shards"), entry.get("weight")) if isinstance(entry, dict) else (None, None)
        )
        valid = isinstance(name, str) and name and "\0" not in name
        if not valid or isinstance(weight, bool) or not isinstance(weight, (int, float)):
            raise InputError(
                f"{quote_path(path)}: a part is {quote(entry)}: it must have shards, a folder, and "
                "weight, a number."
            )
        parts[folder / str(name)] = float(weight)
    if len(parts) < len(listed):
        raise InputError(f"{quote_path(path)} names a folder twice: every part must be unique.")
    return parts


class Mixture:
    """The concatenated records of several folders, and the folders' weights.

    Raises `InputError` for a weight that is not positive and for folders whose records differ in
    kind, size, grid or arrays.
    """

    def __init__(self, folder: Path, parts: Sequence[ShardReader], weights: Sequence[float]):
        self.folder, self.parts = folder, tuple(parts)
        self.weights = tuple(float(weight) for weight in weights)
        for part, weight in zip(self.parts, self.weights, strict=True):
            if not (weight > 0 and math.isfinite(weight)):
                raise InputError(
                    f"The weight of {quote_path(part.folder)} is {weight}: it must be a positive "
                    "number. Omit parts that you do not use. (--weights)"
                )
        first = self.parts[0].manifest
        for part in self.parts[1:]:
            _check_alike(self.parts[0], part)
        shards = tuple(shard for part in self.parts for shard in part.manifest.shards)
        self.manifest: Manifest = dataclasses.replace(first, shards=shards)

    def __len__(self) -> int:
        return self.manifest.records

    def __getitem__(self, index: int) -> Record:
        part, number = self._part(index)
        return part[number]

    def __iter__(self) -> Iterator[Record]:
        return (record for part in self.parts for record in part)

    def name(self, index: int) -> str:
        """Return file and position of a record, for messages."""
        part, number = self._part(index)
        return part.name(number)

    def _part(self, index: int) -> tuple[ShardReader, int]:
        """Return the part of a record, and its index there."""
        for part in self.parts:
            if 0 <= index < len(part):
                return part, index
            index -= len(part)
        raise IndexError(f"{self.folder} has no such record")


def _check_alike(first: ShardReader, other: ShardReader) -> None:
    """Raise `InputError` if records of two folders cannot be in one batch."""
    fields: dict[str, Any] = {
        name: (getattr(first.manifest, name), getattr(other.manifest, name))
        for name in ("kind", "spec", "grid", "arrays")
    }
    differing = [f"{n}: {a} and {b}" for n, (a, b) in fields.items() if a != b]
    if differing:
        raise InputError(
            f"{quote_path(first.folder)} and {quote_path(other.folder)} cannot be mixed, because "
            f"their records differ: {listing(differing)}. Pack or encode them alike. (--shards)"
        )
