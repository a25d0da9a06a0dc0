"""Safetensors written piece by piece: little memory, and on from where it was stopped.

A weight is made of pieces, as a stack is of layers; the place of each in the file is known from the
start, so that what lies apart in the source is put together without being held. Beside the growing
file lies a log with the hash of each piece that is in it; the file takes its name when all are.
Those hashes are the checksums in its header, so that they cost nothing more.
"""

from __future__ import annotations

import hashlib
import math
import mmap
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from io import FileIO
from itertools import accumulate
from pathlib import Path

import numpy as np

from egosim_jax.io.atomic import sync
from egosim_jax.io.mapped import BLANK, Named, digest, header
from egosim_jax.types import InputError

WORKERS, AHEAD = 2, 3
"""Threads that prepare pieces, and pieces that are held at most."""


@dataclass(frozen=True, kw_only=True)
class Weight:
    """An array of the file, and how its pieces are come by."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    pieces: tuple[Callable[[], np.ndarray], ...]
    """Equal parts of it along the first axis, or itself; each is cast to `dtype`."""

    @property
    def bytes(self) -> int:
        """That it takes in the file."""
        return math.prod(self.shape) * self.dtype.itemsize


def write(
    target: Path, weights: Sequence[Weight], *, origin: Sequence[Path], about: Mapping[str, str]
) -> Iterator[int]:
    """Write the weights to `target`; yields the bytes of each piece when it is in the file.

    `origin` are the files that the pieces come from: a file that is half written goes on only if
    they have not changed. `about` goes into the header, which is sealed if the format is ours.
    Pieces that turn out to be damaged leave nothing behind.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    # The widest first, so that every weight lies at a multiple of its width.
    ordered = sorted(weights, key=lambda weight: (-weight.dtype.itemsize, weight.name))
    pieces = [(weight, piece) for weight in ordered for piece in weight.pieces]
    sizes = [weight.bytes // len(weight.pieces) for weight, _ in pieces]
    blank = _header(ordered, about, len(pieces) * [BLANK])
    plan = _plan(blank, origin)
    part, log = (target.with_name(target.name + end) for end in (".part", ".part.log"))
    try:
        with _open(part) as file, _open(log) as journal:
            done = _resume(file, journal, plan, start=len(blank), sizes=sizes)
            journal.truncate(0)  # first, so that no old log stands beside the new file
            if not done:
                file.truncate(0)
                file.truncate(len(blank) + sum(sizes))
            journal.write("\n".join([plan, *done, ""]).encode())
            yield sum(sizes[: len(done)])
            places = accumulate(sizes, initial=len(blank))
            left = list(zip(places, pieces, strict=False))[len(done) :]
            for size, checksum in zip(sizes[len(done) :], _put(left, file.fileno()), strict=True):
                journal.write(f"{checksum}\n".encode())
                done.append(checksum)
                yield size
            file.write(_header(ordered, about, done))
            os.fsync(file.fileno())
    except InputError:
        part.unlink()
        log.unlink()
        raise
    part.replace(target)
    log.unlink()
    sync(target.parent)


def _open(path: Path) -> FileIO:
    """A file of ours to read and write, made if need be; no link is followed."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    return FileIO(os.open(path, flags, 0o666), "r+")


def _header(weights: Sequence[Weight], about: Mapping[str, str], pieces: Sequence[str]) -> bytes:
    left = iter(pieces)
    checksums = {weight.name: [next(left) for _ in weight.pieces] for weight in weights}
    named = [Named(weight.name, weight.shape, weight.dtype) for weight in weights]
    return header(named, about, checksums)


def _plan(header: bytes, origin: Sequence[Path]) -> str:
    """What tells this file's making from another's."""
    files = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in origin]
    return hashlib.sha256(header + repr(files).encode("utf-8", "surrogateescape")).hexdigest()


def _resume(
    file: FileIO, journal: FileIO, plan: str, *, start: int, sizes: Sequence[int]
) -> list[str]:
    """The hashes of the pieces that a file of the same plan has, and that still are what they were.

    After a crash of the machine the log may know of pieces that never reached the disk.
    """
    lines = journal.read((1 + len(sizes)) * (len(BLANK) + 1)).split(b"\n")
    whole: list[str] = []
    if os.fstat(file.fileno()).st_size == start + sum(sizes) and lines[0] == plan.encode():
        places = accumulate(sizes, initial=start)
        for place, size, said in zip(places, sizes, lines[1:-1], strict=False):  # the last is torn
            if digest(os.pread(file.fileno(), size, place)).encode() != said:
                break
            whole.append(said.decode())
    journal.seek(0)
    return whole


def _put(pieces: Iterable, file: int) -> Iterator[str]:
    """Write the pieces at their places, a few at once; the hash of each when it is written."""
    with ThreadPoolExecutor(WORKERS) as pool:
        waiting: list[Future[str]] = []
        for place, piece in pieces:
            waiting.append(pool.submit(_put_one, file, place, *piece))
            if len(waiting) == AHEAD:
                yield waiting.pop(0).result()
        for future in waiting:
            yield future.result()


def _put_one(file: int, place: int, weight: Weight, piece: Callable[[], np.ndarray]) -> str:
    array = in_rows(piece().astype(weight.dtype, copy=False))
    data = array.reshape(-1).view(np.uint8).data
    written = 0
    while written < len(data):  # at most 2 GiB at once
        written += os.pwrite(file, data[written:], place + written)
    return digest(data)


def in_rows(x: np.ndarray) -> np.ndarray:
    """The array in row order; matrices by OpenCV, which is many times faster than NumPy."""
    import cv2

    bits = {1: np.uint8, 2: np.uint16, 4: np.float32}.get(x.itemsize)
    if x.ndim == 2 and bits and x.T.flags.c_contiguous and not x.flags.c_contiguous:
        # First a byte of each page, in order: a disk can read ahead of that, not of columns.
        x.T.reshape(-1).view(np.uint8)[:: mmap.PAGESIZE].max()
        return cv2.transpose(x.T.view(bits)).view(x.dtype)
    return np.ascontiguousarray(x)


def stored_as(kind: np.dtype, dtype: str | None) -> np.dtype:
    """What a weight of a dtype is stored as if asked for `dtype`; whole numbers stay."""
    import ml_dtypes

    floating = np.issubdtype(kind, np.floating) or kind.name.startswith(("bfloat", "float8"))
    if dtype is None or not floating:
        return kind
    return np.dtype(ml_dtypes.bfloat16) if dtype == "bfloat16" else np.dtype(dtype)
