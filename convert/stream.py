"""A weights file written piece by piece: little memory, and on from where it was stopped.

The file is safetensors in our names. A piece is one layer of one of our weights; its place is known
from the start, so that layers that lie apart in the source are stacked without being held. Beside
the growing file lies a log with the hash of each piece that is in it; the file takes its name when
all are. Its own hash, over those of the pieces, stands in its header.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egosim_jax.convert.pth import Tensor
from egosim_jax.convert.rules import Leaf, Rule
from egosim_jax.convert.source import CODES
from egosim_jax.io.weights import HASH

WORKERS, AHEAD = 2, 3
"""Threads that prepare pieces, and pieces that are held at most."""


@dataclass(frozen=True, kw_only=True)
class Piece:
    """One layer of one weight, and where it goes."""

    tensor: Tensor
    rule: Rule
    dtype: np.dtype
    offset: int
    """In the file."""
    bytes: int


def write(
    target: Path,
    leaves: Mapping[str, Leaf],
    tensors: Mapping[str, Tensor],
    *,
    files: Sequence[Path],
    dtype: str | None,
    about: Mapping[str, str],
) -> Iterator[int]:
    """Write the leaves to `target`; yields the bytes of each piece when it is in the file.

    `files` are where the tensors come from: a file that is half written goes on only if they have
    not changed. `dtype` casts floating weights; by default they keep their own. `about` goes into
    the header.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    header, pieces = _layout(leaves, tensors, dtype, about)
    part, log = (target.with_name(target.name + end) for end in (".part", ".part.log"))
    origin = [(str(file), file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    plan = hashlib.sha256(header + repr(origin).encode()).hexdigest()
    done = _resume(part, log, plan, size=len(header) + sum(piece.bytes for piece in pieces))
    if not done:
        part.write_bytes(header)
        os.truncate(part, len(header) + sum(piece.bytes for piece in pieces))
        log.write_text(plan + "\n", encoding="utf-8")
    yield sum(piece.bytes for piece in pieces[: len(done)])
    with part.open("r+b") as file, log.open("a", encoding="utf-8") as journal:
        for piece, (data, digest) in zip(
            pieces[len(done) :], _prepared(pieces[len(done) :]), strict=True
        ):
            file.seek(piece.offset)
            file.write(data)
            file.flush()
            journal.write(digest + "\n")
            journal.flush()
            done.append(digest)
            yield piece.bytes
        whole = hashlib.sha256("".join(done).encode()).hexdigest()
        file.seek(header.index(_blank()))
        file.write(whole.encode())
        file.flush()
        os.fsync(file.fileno())
    part.replace(target)
    log.unlink()


def _blank() -> bytes:
    return b"0" * 64


def _layout(
    leaves: Mapping[str, Leaf],
    tensors: Mapping[str, Tensor],
    dtype: str | None,
    about: Mapping[str, str],
) -> tuple[bytes, list[Piece]]:
    """The file's header, and its pieces in order."""
    codes = {name: code for code, name in CODES.items()}
    kinds = {path: _cast(leaf.dtype, dtype) for path, leaf in leaves.items()}
    # The widest first, so that every weight lies at a multiple of its width.
    order = sorted(leaves, key=lambda path: (-kinds[path].itemsize, path))
    listed: dict[str, object] = {"__metadata__": {**about, HASH: _blank().decode()}}
    places, end = {}, 0
    for path in order:
        begin, kind = end, kinds[path]
        end += math.prod(leaves[path].shape) * kind.itemsize
        places[path] = begin
        listed[path] = {
            "dtype": codes[kind.name],
            "shape": leaves[path].shape,
            "data_offsets": [begin, end],
        }
    text = json.dumps(listed).encode()
    text += b" " * (-len(text) % 8)
    header = len(text).to_bytes(8, "little") + text
    pieces = []
    for path in order:
        leaf, kind = leaves[path], kinds[path]
        size = math.prod(leaf.shape) * kind.itemsize // len(leaf.names)
        pieces += [
            Piece(
                tensor=tensors[name],
                rule=leaf.rule,
                dtype=kind,
                offset=len(header) + places[path] + layer * size,
                bytes=size,
            )
            for layer, name in enumerate(leaf.names)
        ]
    return header, pieces


def _cast(kind: np.dtype, dtype: str | None) -> np.dtype:
    """What a weight of this dtype is stored as; whole numbers stay."""
    import ml_dtypes

    floating = np.issubdtype(kind, np.floating) or kind.name.startswith(("bfloat", "float8"))
    if dtype is None or not floating:
        return kind
    return np.dtype(ml_dtypes.bfloat16) if dtype == "bfloat16" else np.dtype(dtype)


def _resume(part: Path, log: Path, plan: str, *, size: int) -> list[str]:
    """The hashes of the pieces that a file of the same plan already has."""
    if not (part.exists() and log.exists() and part.stat().st_size == size):
        return []
    first, *lines = log.read_text(encoding="utf-8").split("\n")
    return lines[:-1] if first == plan else []  # the last line may be torn, or is empty


def _prepared(pieces: Sequence[Piece]) -> Iterator[tuple[memoryview, str]]:
    """The bytes of each piece and their hash, a few ahead of the one that is written."""
    with ThreadPoolExecutor(WORKERS) as pool:
        waiting: list[Future[tuple[memoryview, str]]] = []
        for piece in pieces:
            waiting.append(pool.submit(_prepare, piece))
            if len(waiting) == AHEAD:
                yield waiting.pop(0).result()
        for future in waiting:
            yield future.result()


def _prepare(piece: Piece) -> tuple[memoryview, str]:
    ours = _contiguous(piece.rule.ours(piece.tensor.array()))
    data = ours.astype(piece.dtype, copy=False).view(np.uint8).reshape(-1).data
    return data, hashlib.sha256(data).hexdigest()


def _contiguous(x: np.ndarray) -> np.ndarray:
    """The array in row order; matrices by OpenCV, which is many times faster than NumPy."""
    import cv2

    bits = {1: np.uint8, 2: np.uint16, 4: np.float32}.get(x.itemsize)
    if x.ndim == 2 and bits and x.T.flags.c_contiguous and not x.flags.c_contiguous:
        return cv2.transpose(x.T.view(bits)).view(x.dtype)
    return np.ascontiguousarray(x)
