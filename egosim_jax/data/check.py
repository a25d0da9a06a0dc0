"""Verification of shards: hashes, counts, shapes and videos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from array_record.python.array_record_module import ArrayRecordReader

from egosim_jax.data.clip_files import is_safe_id
from egosim_jax.data.manifest import ArrayInfo, Manifest, ShardInfo, file_problems, read_manifest
from egosim_jax.data.records import Record, RecordError, from_bytes
from egosim_jax.io.bounded import named, quote
from egosim_jax.io.digest import sha256
from egosim_jax.io.images import decode_image
from egosim_jax.io.video import read_video
from egosim_jax.types import InputError, VideoGrid


def check(folder: Path) -> Iterator[tuple[ShardInfo, list[str]]]:
    """Yield each shard of a folder with its problems; every problem names the file.

    Compares size and SHA-256 with the manifest, reads every record, compares its arrays with the
    manifest and with each other, decodes all videos and images and searches for non-finite
    numbers. Raises `InputError`
    if the manifest is missing or invalid.
    """
    manifest = read_manifest(folder)
    for shard in manifest.shards:
        yield shard, _shard_problems(folder, shard, manifest)


def _shard_problems(folder: Path, shard: ShardInfo, manifest: Manifest) -> list[str]:
    path = folder / shard.file
    problems = file_problems(folder, shard)
    if problems:
        return problems
    if sha256(path) != shard.sha256:
        problems.append(f"{path}: its SHA-256 differs from the manifest")
    try:
        reader = ArrayRecordReader(str(path))
        if reader.num_records() != shard.records:
            problems.append(f"{path}: {reader.num_records()} records, expected {shard.records}")
        for index in range(reader.num_records()):
            name = f"{path}, record {index}"
            problems += [f"{name}: {line}" for line in _read_problems(reader, index, manifest)]
        reader.close()
    except RuntimeError as error:
        problems.append(named(str(path), error))
    return problems


def _read_problems(reader: ArrayRecordReader, index: int, manifest: Manifest) -> list[str]:
    try:
        record = from_bytes(reader.read([index])[0])
    except (RuntimeError, RecordError) as error:
        return [f"cannot be read: {error}"]
    return _record_problems(record, manifest)


def _record_problems(record: Record, manifest: Manifest) -> list[str]:
    video_id = record.metadata.get("video_id")
    problems = []
    if not isinstance(video_id, str) or not is_safe_id(video_id):
        problems.append(f"video_id {quote(video_id)} is not a valid file name")
    problems += _shape_problems(record.arrays, manifest.arrays)
    if manifest.kind == "videos":
        problems += _video_problems(record.arrays, manifest.grid)
    else:
        if manifest.kind == "frames" and manifest.spec is not None:
            spec = manifest.spec
            sizes = {name: a.shape[:3] for name, a in record.arrays.items() if a.ndim >= 3}
            sizes |= {n: (spec.frames, *s[:2]) for n, s in sizes.items() if n == "first_frame"}
            problems += _differing({"spec": (spec.frames, spec.height, spec.width), **sizes})
        problems += [
            f"{name} has values that are not finite"
            for name, array in record.arrays.items()
            if not np.isfinite(array.astype(np.float32)).all()
        ]
    return problems


def _shape_problems(
    arrays: Mapping[str, np.ndarray], expected: Mapping[str, ArrayInfo]
) -> list[str]:
    problems = []
    for name in sorted(arrays.keys() | expected.keys()):
        if name not in arrays or name not in expected:
            where = "the manifest" if name in arrays else "the record"
            problems.append(f"{name} is missing in {where}")
            continue
        array, info = arrays[name], expected[name]
        fits = len(array.shape) == len(info.shape) and all(
            axis in (None, size) for size, axis in zip(array.shape, info.shape, strict=True)
        )
        if not fits or array.dtype.name != info.dtype:
            problems.append(
                f"{name} is {array.dtype.name} {array.shape}, expected {info.dtype} {info.shape}"
            )
    return problems


def _video_problems(arrays: Mapping[str, np.ndarray], grid: VideoGrid) -> list[str]:
    problems, sizes = [], {}
    for name, array in arrays.items():
        try:
            if name == "first_frame":
                decode_image(array.tobytes(), name=name)
            else:
                sizes[name] = read_video(array.tobytes(), name=name).frames.shape[:3]
                grid.check_frames(sizes[name][0], what=name, fix="pack the clip again")
        except InputError as error:
            problems.append(str(error))
    return problems + _differing(sizes)


def _differing(sizes: Mapping[str, tuple[int, ...]]) -> list[str]:
    """Return a problem if frames, heights or widths disagree."""
    disagree = len(set(sizes.values())) > 1
    return [f"the frames and sizes disagree: {dict(sizes)}"] if disagree else []
