"""Safetensors written piece by piece: little memory, and on from where it was stopped.

A weight is made of pieces, as a stack is of layers; the place of each in the file is known from the
start, so that what lies apart in the source is put together without being held. Beside the growing
file lies a log with the hash of each piece that is in it; the file takes its name when all are. Its
own hash, over those of the pieces, stands in its header.
"""

from __future__ import annotations

import hashlib
import json
import math
import mmap
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path

import numpy as np

from egosim_jax.io.mapped import CODES
from egosim_jax.io.weights import HASH

WORKERS, AHEAD = 2, 3
"""Threads that prepare pieces, and pieces that are held at most."""
BLANK = b"0" * 64
"""Stands in the header where the hash will be."""


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
    they have not changed. `about` goes into the header.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    # The widest first, so that every weight lies at a multiple of its width.
    ordered = sorted(weights, key=lambda weight: (-weight.dtype.itemsize, weight.name))
    header = _header(ordered, about)
    pieces = [(weight, piece) for weight in ordered for piece in weight.pieces]
    sizes = [weight.bytes // len(weight.pieces) for weight, _ in pieces]
    part, log = (target.with_name(target.name + end) for end in (".part", ".part.log"))
    plan = _plan(header, origin)
    done = _resume(part, log, plan, start=len(header), sizes=sizes)
    if not done:
        log.unlink(missing_ok=True)  # first, so that no old log stands beside the new file
        part.write_bytes(header)
        os.truncate(part, len(header) + sum(sizes))
        log.write_text(plan + "\n", encoding="utf-8")
    before = sum(sizes[: len(done)])
    yield before
    with part.open("r+b") as file, log.open("a", encoding="utf-8") as journal:
        places = accumulate(sizes, initial=len(header))
        left = list(zip(places, pieces, strict=False))[len(done) :]
        for size, digest in zip(sizes[len(done) :], _put(left, file.fileno()), strict=True):
            journal.write(digest + "\n")
            journal.flush()
            done.append(digest)
            yield size
        file.seek(header.index(BLANK))
        file.write(hashlib.sha256("".join(done).encode()).hexdigest().encode())
        file.flush()
        os.fsync(file.fileno())
    part.replace(target)
    log.unlink()


def _header(weights: Sequence[Weight], about: Mapping[str, str]) -> bytes:
    codes = {name: code for code, name in CODES.items()}
    listed: dict[str, object] = {"__metadata__": {**about, HASH: BLANK.decode()}}
    end = 0
    for weight in weights:
        begin, end = end, end + weight.bytes
        listed[weight.name] = {
            "dtype": codes[weight.dtype.name],
            "shape": weight.shape,
            "data_offsets": [begin, end],
        }
    text = json.dumps(listed).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


def _plan(header: bytes, origin: Sequence[Path]) -> str:
    """What tells this file's making from another's."""
    files = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in origin]
    return hashlib.sha256(header + repr(files).encode()).hexdigest()


def _resume(part: Path, log: Path, plan: str, *, start: int, sizes: Sequence[int]) -> list[str]:
    """The hashes of the pieces that a file of the same plan has, and that still are what they were.

    After a crash of the machine the log may know of pieces that never reached the disk.
    """
    if not (part.exists() and log.exists() and part.stat().st_size == start + sum(sizes)):
        return []
    first, *lines = log.read_text(encoding="utf-8").split("\n")
    if first != plan:
        return []
    whole = []
    with part.open("rb") as file:
        file.seek(start)
        for size, digest in zip(sizes, lines[:-1], strict=False):  # the last is torn, or empty
            if hashlib.sha256(file.read(size)).hexdigest() != digest:
                break
            whole.append(digest)
    log.write_text("\n".join([plan, *whole, ""]), encoding="utf-8")
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
    return hashlib.sha256(data).hexdigest()


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
