"""Writing of safetensors piece by piece: in bounded memory, resumable after an interruption.

A weight consists of pieces, such as the layers of a stack. Threads convert a few at a time, and
they are appended to a file named after the plan: the tensors, their sources and settings. The same
plan continues it. A file of ours has its plan in its header, so that a complete one is kept.
"""

from __future__ import annotations

import glob
import hashlib
import math
import mmap
import os
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from itertools import accumulate
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from egosim_jax.convert.finite import all_finite, is_floating, out_of_range
from egosim_jax.convert.source import INDEX
from egosim_jax.io.atomic import PART, sync
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.mapped import (
    BLANK,
    CODES,
    OURS,
    TensorInfo,
    header,
    map_ahead,
    read_arrays,
    read_metadata,
    read_safetensors,
)
from egosim_jax.io.run import write_json
from egosim_jax.runtime.progress import track_bytes
from egosim_jax.runtime.terminal import print_line
from egosim_jax.types import InputError

THREADS, AHEAD = 2, 3
"""Number of threads that convert pieces, and maximum number of pieces in memory."""
SYNC_BYTES = 256 << 20
"""Maximum number of bytes, in addition to one piece, that are not on disk yet."""
PLAN = "plan"
"""Metadata of our files: hash of the tensors, sources and settings of their conversion."""
MAX_FILE_BYTES = 5_000_000_000
"""Maximum size of a file in bytes; a larger network becomes several files."""


@dataclass(frozen=True, kw_only=True)
class Weight(TensorInfo):
    """An array to write, with functions that compute its pieces."""

    pieces: tuple[Callable[[], np.ndarray], ...]
    """Functions of equal parts along the first axis, or of the full array; cast to `dtype`."""
    names: tuple[str, ...] = ()
    """Name of each piece in error messages; empty for the weight's own name."""
    fix: str = "Store the weights as bfloat16 or float32, or omit the option. (--dtype)"
    """Fix of values beyond the range of `dtype`, for an error message."""

    @property
    def bytes(self) -> int:
        """Size in the file in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def in_memory(arrays: Mapping[str, np.ndarray]) -> list[Weight]:
    """Return named arrays as weights of one piece each."""
    return [
        Weight(name=name, shape=array.shape, dtype=array.dtype, pieces=(lambda a=array: a,))
        for name, array in arrays.items()
    ]


def write(
    target: Path,
    weights: Sequence[Weight],
    *,
    origin: Sequence[Path],
    metadata: Mapping[str, str],
    settings: Any = None,
) -> Iterator[int]:
    """Write the weights to `target`; yield the size of each piece when it is written.

    The pieces are computed from the files `origin` by these `settings`. An incomplete file of the
    same plan is continued, and a complete and intact one of ours is kept. `metadata` goes into the
    header. If a piece is damaged or not finite, also after its cast, no file remains.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    # Wide dtypes first, so that every weight is aligned to its item size.
    ordered = sorted(weights, key=lambda weight: (-weight.dtype.itemsize, weight.name))
    blank = dict.fromkeys((weight.name for weight in ordered), BLANK)
    plan = _plan(header(ordered, metadata, blank), origin, settings)
    if ours := metadata.get("format") == OURS:
        metadata = {**metadata, PLAN: plan}
        if _is_complete(target, plan):
            yield sum(weight.bytes for weight in ordered)
            return
    part = target.with_name(f"{target.name}.{plan[:16]}{PART}")
    for other in target.parent.glob(f"{glob.escape(target.name)}.*{PART}"):
        if other != part:
            other.unlink()
    try:
        with open(part, "r+b", opener=_open) as file:
            file.seek(len(header(ordered, metadata, blank if ours else None)))
            digests = yield from _append(file, ordered)
            file.seek(0)
            file.write(header(ordered, metadata, digests if ours else None))
            file.flush()
            os.fsync(file.fileno())
    except InputError:
        part.unlink()
        raise
    part.replace(target)
    sync(target.parent)


def _plan(header: bytes, origin: Sequence[Path], settings: Any) -> str:
    """Return a hash of the header, of path, size and time of the source files, and of settings."""
    files = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in origin]
    text = repr((version("egosim-jax"), files, settings))
    return hashlib.sha256(header + text.encode("utf-8", "surrogateescape")).hexdigest()


def _is_complete(target: Path, plan: str) -> bool:
    """Return True if a file of this plan exists, and all its values match their checksums."""
    try:
        if not target.is_file() or read_metadata(target).get(PLAN) != plan:
            return False
        for _ in read_arrays(read_safetensors(target).values()):
            pass
    except InputError:
        return False
    return True


def _open(path: str, flags: int) -> int:
    """Open a file; create it if missing; do not follow symlinks."""
    return os.open(path, flags | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666)


def _append(file: BinaryIO, weights: Sequence[Weight]) -> Generator[int, None, dict[str, str]]:
    """Write the pieces that a file lacks behind its position; yield the size of each piece.

    Returns the SHA-256 of each weight. The last bytes of an incomplete file are written again:
    after a crash of the machine, they may not be on disk.
    """
    pieces = [(weight, number) for weight in weights for number in range(len(weight.pieces))]
    sizes = [weight.bytes // len(weight.pieces) for weight, _ in pieces]
    digests = {weight.name: hashlib.sha256() for weight in weights}
    safe = os.fstat(file.fileno()).st_size - SYNC_BYTES
    ends = accumulate(sizes[1:], initial=file.tell() + sum(sizes[:1]))
    done = sum(end <= safe for end in ends)
    for (weight, _), size in zip(pieces[:done], sizes, strict=False):
        digests[weight.name].update(file.read(size))
        yield size
    file.truncate()
    pending = 0
    converted = map_ahead(_converted, pieces[done:], threads=THREADS, ahead=AHEAD)
    for (weight, _), size in zip(pieces[done:], sizes[done:], strict=True):
        data = next(converted)
        if pending + size > SYNC_BYTES:
            file.flush()
            os.fsync(file.fileno())
            pending = 0
        file.write(data)
        pending += size
        digests[weight.name].update(data)
        del data  # or one more piece stays in memory
        yield size
    return {name: digest.hexdigest() for name, digest in digests.items()}


def _converted(piece: tuple[Weight, int]) -> memoryview:
    """Return the bytes of a piece in its weight's dtype. Raises `InputError` unless finite."""
    weight, number = piece
    name = weight.names[number] if weight.names else weight.name
    given = weight.pieces[number]()
    with np.errstate(over="ignore", invalid="ignore"):
        array = in_rows(given.astype(weight.dtype, copy=False))
    if not all_finite(array):
        raise out_of_range(given, weight.dtype, name=name, fix=weight.fix)
    return array.reshape(-1).view(np.uint8).data


def in_rows(x: np.ndarray) -> np.ndarray:
    """Return a C-contiguous copy; OpenCV transposes matrices many times faster than NumPy."""
    import cv2

    bits = {1: np.uint8, 2: np.uint16, 4: np.float32}.get(x.itemsize)
    if x.ndim == 2 and bits and x.T.flags.c_contiguous and not x.flags.c_contiguous:
        # Touch every page in order first: the kernel reads ahead for that, not for columns.
        x.T.reshape(-1).view(np.uint8)[:: mmap.PAGESIZE].max()
        return cv2.transpose(x.T.view(bits)).view(x.dtype)
    return np.ascontiguousarray(x)


def stored_as(kind: np.dtype, dtype: str | None) -> np.dtype:
    """Return the stored dtype of a weight of dtype `kind`; only floating dtypes are cast."""
    target = kind if dtype is None or not is_floating(kind) else np.dtype(dtype)
    if target not in CODES.values():
        raise InputError(f"safetensors cannot store {target}. Choose another dtype. (--dtype)")
    return target


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
    settings: Any = None,
) -> None:
    """Write a file of weights with progress (`write`); print its path."""
    total = sum(weight.bytes for weight in weights)
    pieces = write(target, weights, origin=origin, metadata=metadata, settings=settings)
    for _ in track_bytes(pieces, f"writing {target.name}", total=total):
        pass
    print_line(target)


def write_sharded(
    stem: Path, weights: Sequence[Weight], *, origin: Sequence[Path], settings: Any = None
) -> None:
    """Write one file; above 5 GB, several files and an index."""
    shards: list[list[Weight]] = [[]]
    for weight in weights:
        if shards[-1] and sum(w.bytes for w in shards[-1]) + weight.bytes > MAX_FILE_BYTES:
            shards.append([])
        shards[-1].append(weight)
    weight_map = {}
    for number, shard in enumerate(shards, start=1):
        end = f"-{number:05d}-of-{len(shards):05d}" if len(shards) > 1 else ""
        target = stem.with_name(f"{stem.name}{end}.safetensors")
        write_file(target, shard, origin=origin, metadata={"format": "pt"}, settings=settings)
        weight_map |= {weight.name: target.name for weight in shard}
    if len(shards) > 1:
        total = sum(weight.bytes for weight in weights)
        index = {"metadata": {"total_size": total}, "weight_map": weight_map}
        write_json(stem.with_name(f"{stem.name}{INDEX}"), index)
