"""The manifest of a folder of shards: kind, arrays, files with their hashes, and provenance.

Reading trusts nothing. The manifest holds its own SHA-256, the type of every field is checked, and
file names must match a pattern.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from egosim_jax.data.records import DTYPES
from egosim_jax.io.bounded import check_version, quote, quote_path, quote_text, read_json
from egosim_jax.io.run import plain, write_json
from egosim_jax.types import InputError, VideoGrid, VideoSpec

RecordKind = Literal["videos", "frames", "latents"]

VERSION = 1
MANIFEST = "manifest.json"
SEAL = "manifest_sha256"
"""Key of the hash of all other fields of a manifest."""
SHARD_NAME = re.compile(r"shard-\d{5}\.array_record")


@dataclass(frozen=True, kw_only=True)
class ArrayInfo:
    """Dtype and shape of one array in all records."""

    dtype: str
    """Name of the dtype."""
    shape: tuple[int | None, ...]
    """Length of each axis; None where records differ."""


@dataclass(frozen=True, kw_only=True)
class ShardInfo:
    """Name, size and hash of one file of records."""

    file: str
    """File name in the folder."""
    records: int
    """Number of records in the shard."""
    size: int
    """Size of the shard in bytes."""
    sha256: str
    """SHA-256 of the file in hexadecimal."""


@dataclass(frozen=True, kw_only=True)
class Manifest:
    """The description of a folder of shards."""

    version: int = VERSION
    """Version of the format."""
    kind: RecordKind
    """Kind of the records."""
    spec: VideoSpec | None
    """Length and size of frames, or of the videos that latents encode; None for videos."""
    grid: VideoGrid
    """Latent grid of the videos."""
    arrays: Mapping[str, ArrayInfo]
    """Arrays of every record, by name."""
    shards: tuple[ShardInfo, ...]
    """Files, in the order of their records."""
    provenance: Mapping[str, Any]
    """Source of the records: config, hashes of the encoder weights, ..."""

    @property
    def records(self) -> int:
        """Number of records in all shards."""
        return sum(shard.records for shard in self.shards)

    @property
    def fps(self) -> int | None:
        """Frame rate of all clips; None for videos, and if frames were taken at other rates."""
        rule = self.provenance.get("resampling", "first")
        return self.spec.fps if self.spec is not None and rule in ("first", "rate") else None

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the hashes of all shards: equal if and only if the records are equal."""
        return hashlib.sha256("".join(shard.sha256 for shard in self.shards).encode()).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """Read and validate a folder's manifest. Raises `InputError` if it is missing or invalid."""
    path = folder / MANIFEST
    if not path.is_file():
        raise InputError(f"{quote_path(folder)} is not a dataset: it has no {MANIFEST}.")
    return parse_manifest(read_json(path), quote_path(path))


def parse_manifest(fields: Any, name: str) -> Manifest:
    """Validate the JSON of a manifest. Raises `InputError`, naming `name`, if it is invalid."""
    try:
        manifest = _manifest(fields, name)
    except InputError:
        raise
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        reason = quote_text(f"{type(error).__name__}: {error}")
        raise InputError(f"{name} is not a manifest of shards: {reason}.") from error
    if fields.pop(SEAL, None) != sealed(fields):
        raise InputError(
            f"{name} was modified after it was written: its {SEAL} does not match. Restore it."
        )
    return manifest


def _manifest(fields: Any, name: str) -> Manifest:
    """Build a manifest from JSON. Raises `InputError`, `TypeError` and others for wrong types."""
    check_version(fields["version"], VERSION, source=name)
    kind, spec = fields["kind"], fields["spec"]
    if kind not in get_args(RecordKind):
        raise InputError(
            f"{name} has kind {quote(kind)}; supported are {', '.join(get_args(RecordKind))}."
        )
    shards = tuple(ShardInfo(**shard) for shard in fields["shards"])
    for shard in shards:
        if not (isinstance(shard.file, str) and isinstance(shard.sha256, str)):
            raise TypeError("a shard has no file name or sha256")
        if not (type(shard.size) is type(shard.records) is int and 0 <= shard.size < 1 << 48):
            raise TypeError("the size or number of records of a shard is not an integer")
    unsafe = [quote(shard.file) for shard in shards if not SHARD_NAME.fullmatch(shard.file)]
    files = {shard.file for shard in shards}
    if unsafe or len(files) < max(1, len(shards)) or any(shard.records < 1 for shard in shards):
        raise InputError(
            f"{name} must list unique shards named like shard-00000.array_record with at least "
            f"one record each, not {', '.join(unsafe[:8]) or 'none, duplicate or empty ones'}."
        )
    arrays = {
        key: ArrayInfo(dtype=info["dtype"], shape=tuple(info["shape"]))
        for key, info in fields["arrays"].items()
    }
    axes = [axis for info in arrays.values() for axis in info.shape]
    if any(axis is not None and (type(axis) is not int or axis < 0) for axis in axes):
        raise TypeError("a shape has an axis that is not a count")
    if any(info.dtype not in DTYPES for info in arrays.values()):
        raise TypeError("an array has an unsupported dtype")
    if spec is not None and not all(type(value) is int for value in spec.values()):
        raise TypeError("a field of the spec is not an integer")
    grid = VideoGrid(**fields["grid"])
    if any(type(value) is not int or value < 1 for value in vars(grid).values()):
        raise TypeError("a stride of the grid is not a positive integer")
    video = None if spec is None else VideoSpec(**spec)
    if video is not None:
        grid.check(video)
    return Manifest(
        kind=kind,
        spec=video,
        grid=grid,
        arrays=arrays,
        shards=shards,
        provenance=dict(fields["provenance"].items()),
    )


def file_problems(folder: Path, shard: ShardInfo) -> list[str]:
    """List how a shard's file differs from the manifest, without reading the file."""
    path = folder / shard.file
    if not path.is_file() or path.is_symlink():
        return [f"{path}: missing"]
    size = path.stat().st_size
    return [] if size == shard.size else [f"{path}: {size} bytes, expected {shard.size}"]


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of a folder, with the hash of its fields."""
    fields = plain(dataclasses.asdict(manifest))
    write_json(folder / MANIFEST, {**fields, SEAL: sealed(fields)})


def sealed(fields: Mapping[str, Any]) -> str:
    """Return the hash of a manifest's other fields, which `SEAL` names."""
    return hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
