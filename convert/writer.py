"""Writing of safetensors piece by piece: in bounded memory, resumable after an interruption.

A weight consists of pieces, such as the layers of a stack. Their offsets in the file are known in
advance; a few at a time are read, converted and written. A log next to the growing file has the
hash of each written piece. The file gets its name when it is complete. The same hashes are the
checksums in its header.
"""

from __future__ import annotations

import hashlib
import math
import mmap
import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from io import FileIO
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.convert.finite import all_finite, is_floating, out_of_range
from egosim_jax.convert.source import INDEX
from egosim_jax.io.atomic import LOG, PART, sync
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.mapped import (
    BLANK,
    CODES,
    HASH,
    TensorInfo,
    digest,
    header,
    read_metadata,
    weights_hash,
)
from egosim_jax.io.run import write_json
from egosim_jax.runtime.progress import track_bytes
from egosim_jax.types import InputError

WORKERS, AHEAD = 2, 3
"""Number of threads that prepare pieces, and maximum number of pieces in memory."""
MAX_FILE_BYTES = 5_000_000_000
"""Maximum size of a file in bytes; a larger network becomes several files."""


@dataclass(frozen=True, kw_only=True)
class Weight:
    """An array to write, with functions that compute its pieces."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
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
    keep_log: bool = False,
) -> Iterator[int]:
    """Write the weights to `target`; yield the size of each piece when it is written.

    The pieces are read from the files `origin`; an incomplete file is resumed only if they have not
    changed. With `keep_log`, the log of a complete file stays, so the same call recognizes the file
    and does not write it again. `metadata` goes into the header, which is sealed if the format is
    ours. If a piece is damaged or not finite, also after its cast, no file remains.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    # Wide dtypes first, so that every weight is aligned to its item size.
    ordered = sorted(weights, key=lambda weight: (-weight.dtype.itemsize, weight.name))
    pieces = [(weight, number) for weight in ordered for number in range(len(weight.pieces))]
    sizes = [weight.bytes // len(weight.pieces) for weight, _ in pieces]
    blank = _header(ordered, metadata, len(pieces) * [BLANK], BLANK)
    plan = _fingerprint(blank, origin)
    part, log = (target.with_name(target.name + end) for end in (PART, LOG))
    if keep_log and _complete(
        target, log, plan, lambda *hashes: _header(ordered, metadata, *hashes), len(pieces)
    ):
        yield sum(sizes)
        return
    try:
        with _open(part) as file, _open(log) as journal:
            whole = _Digests([weight.name for weight, _ in pieces])
            done = _resume(file, journal, plan, start=len(blank), sizes=sizes, whole=whole)
            journal.truncate(0)  # first, so that an old log never describes a new file
            if not done:
                file.truncate(0)
                file.truncate(len(blank) + sum(sizes))
            journal.write("\n".join([plan, *done, ""]).encode())
            yield sum(sizes[: len(done)])
            offsets = accumulate(sizes, initial=len(blank))
            left = list(zip(offsets, pieces, strict=False))[len(done) :]
            put = _put(left, file.fileno())
            for size, (checksum, data) in zip(sizes[len(done) :], put, strict=True):
                journal.write(f"{checksum}\n".encode())
                done.append(checksum)
                whole.add(checksum, data)
                del data  # or one more piece stays in memory
                yield size
            file.write(_header(ordered, metadata, done, whole.hash_of(ordered)))
            os.fsync(file.fileno())
    except InputError:
        part.unlink()
        log.unlink()
        raise
    part.replace(target)
    if not keep_log:
        log.unlink()
    sync(target.parent)


class _Digests:
    """SHA-256 of each complete weight, from its pieces in order."""

    def __init__(self, names: Sequence[str]):
        """Take the name of the weight of each piece."""
        self._left = list(reversed(names))
        self._pieces = Counter(names)
        self._hashes: dict[str, Any] = {}
        self._digests: dict[str, str] = {}

    def add(self, checksum: str, data: bytes | memoryview) -> None:
        """Add the next piece and its own hash."""
        name = self._left.pop()
        if self._pieces[name] == 1:
            self._digests[name] = checksum
            return
        self._hashes.setdefault(name, hashlib.sha256()).update(data)

    def hash_of(self, weights: Sequence[Weight]) -> str:
        """Return the `weights_hash` of the weights."""
        digests = {name: total.hexdigest() for name, total in self._hashes.items()}
        return weights_hash(_infos(weights), self._digests | digests)


def _complete(
    target: Path,
    log: Path,
    plan: str,
    header_of: Callable[[Sequence[str], str], bytes],
    pieces: int,
) -> bool:
    """Return True if a file has the header of the logged pieces, and the log is of the plan."""
    if not (target.is_file() and log.is_file()):
        return False
    logged, *checksums = log.read_text().split("\n")[:-1]
    if logged != plan or len(checksums) != pieces:
        return False
    try:
        hashed = read_metadata(target).get(HASH, BLANK)
    except InputError:
        return False
    expected = header_of(checksums, hashed)
    with target.open("rb") as file:
        return file.read(len(expected)) == expected


def _open(path: Path) -> FileIO:
    """Open a file to read and write; create it if missing; do not follow symlinks."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    return FileIO(os.open(path, flags, 0o666), "r+")


def _infos(weights: Sequence[Weight]) -> list[TensorInfo]:
    return [TensorInfo(weight.name, weight.shape, weight.dtype) for weight in weights]


def _header(
    weights: Sequence[Weight], metadata: Mapping[str, str], pieces: Sequence[str], hashed: str
) -> bytes:
    left = iter(pieces)
    checksums = {weight.name: [next(left) for _ in weight.pieces] for weight in weights}
    return header(_infos(weights), metadata, checksums, hashed)


def _fingerprint(header: bytes, origin: Sequence[Path]) -> str:
    """Return a hash of the header and of path, size and time of the source files."""
    files = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in origin]
    return hashlib.sha256(header + repr(files).encode("utf-8", "surrogateescape")).hexdigest()


def _resume(
    file: FileIO, journal: FileIO, plan: str, *, start: int, sizes: Sequence[int], whole: _Digests
) -> list[str]:
    """Return the hashes of the valid leading pieces of an incomplete file; add them to `whole`.

    The file must be of the same plan.
    After a crash of the machine, the log may list pieces that never reached the disk.
    """
    lines = journal.read((1 + len(sizes)) * (len(BLANK) + 1)).split(b"\n")
    valid: list[str] = []
    if os.fstat(file.fileno()).st_size == start + sum(sizes) and lines[0] == plan.encode():
        offsets = accumulate(sizes, initial=start)
        # The last line may be incomplete.
        for offset, size, logged in zip(offsets, sizes, lines[1:-1], strict=False):
            data = os.pread(file.fileno(), size, offset)
            if digest(data).encode() != logged:
                break
            valid.append(logged.decode())
            whole.add(valid[-1], data)
    journal.seek(0)
    return valid


def _put(pieces: Iterable, file: int) -> Iterator[tuple[str, memoryview]]:
    """Write the pieces at their offsets, a few in parallel; yield hashes and bytes in order."""
    with ThreadPoolExecutor(WORKERS) as pool:
        waiting: list[Future[tuple[str, memoryview]]] = []
        for offset, piece in pieces:
            waiting.append(pool.submit(_put_one, file, offset, *piece))
            if len(waiting) == AHEAD:
                yield waiting.pop(0).result()
        for future in waiting:
            yield future.result()


def _put_one(file: int, offset: int, weight: Weight, number: int) -> tuple[str, memoryview]:
    name = weight.names[number] if weight.names else weight.name
    given = weight.pieces[number]()
    with np.errstate(over="ignore", invalid="ignore"):
        array = in_rows(given.astype(weight.dtype, copy=False))
    if not all_finite(array):
        raise out_of_range(given, weight.dtype, name=name, fix=weight.fix)
    data = array.reshape(-1).view(np.uint8).data
    written = 0
    while written < len(data):  # a call writes at most 2 GiB
        written += os.pwrite(file, data[written:], offset + written)
    return digest(data), data


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
    keep_log: bool = False,
) -> None:
    """Write a file of weights with progress; print its path."""
    total = sum(weight.bytes for weight in weights)
    pieces = write(target, weights, origin=origin, metadata=metadata, keep_log=keep_log)
    for _ in track_bytes(pieces, f"writing {target.name}", total=total):
        pass
    print(quote_path(target))


def write_sharded(stem: Path, weights: Sequence[Weight], *, origin: Sequence[Path]) -> None:
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
        write_file(target, shard, origin=origin, metadata={"format": "pt"})
        weight_map |= {weight.name: target.name for weight in shard}
    if len(shards) > 1:
        total = sum(weight.bytes for weight in weights)
        index = {"metadata": {"total_size": total}, "weight_map": weight_map}
        write_json(stem.with_name(f"{stem.name}{INDEX}"), index)
