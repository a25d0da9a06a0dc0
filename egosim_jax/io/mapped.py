"""Memory-mapped tensors of safetensors files.

The safetensors library reads and checks headers. Opening a file reads only its header; values are
paged in on access, as views of the file in any dtype. Files of egosim_jax have the SHA-256 of each
tensor, and of the names, dtypes, shapes and values of all. The header is verified when it is read,
a tensor when its values are first accessed.
"""

from __future__ import annotations

import hashlib
import json
import math
import mmap
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, TypeVar

import ml_dtypes
import numpy as np
from safetensors import SafetensorError, safe_open

from egosim_jax.io.bounded import (
    MAX_JSON_BYTES,
    open_regular,
    parse_json,
    quote,
    quote_path,
    quote_text,
)
from egosim_jax.types import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")
CODES = {
    code: np.dtype(kind)
    for code, kind in {
        "F64": np.float64, "F32": np.float32, "F16": np.float16, "BF16": ml_dtypes.bfloat16,
        "F8_E4M3": ml_dtypes.float8_e4m3fn, "F8_E5M2": ml_dtypes.float8_e5m2, "I64": np.int64,
        "I32": np.int32, "I16": np.int16, "I8": np.int8, "U64": np.uint64, "U32": np.uint32,
        "U16": np.uint16, "U8": np.uint8, "BOOL": np.bool_,
    }.items()
}  # fmt: skip
"""NumPy dtypes by their code in safetensors headers."""
MAX_TENSORS, MAX_NAME, MAX_BYTES, MAX_AXES = 1 << 17, 512, 1 << 48, 32
"""Limits: tensors per file, characters per name, bytes and axes per tensor."""
POINTER = b"version https://git-lfs.github.com/spec/"
"""First bytes of a Git LFS pointer file."""
METADATA, OURS = "__metadata__", "egosim_jax"
"""Header entry for text metadata, and the `format` in it that marks files of egosim_jax."""
HASH, CHECKSUMS = "sha256", "checksums"
"""Metadata of our files: `weights_hash`, and SHA-256 per tensor as JSON."""
BLANK = "0" * hashlib.sha256().digest_size * 2
"""Placeholder with the length of a hash."""


class RefusedError(ValueError):
    """Reason why a file cannot be read, without the file's name."""


@dataclass(frozen=True)
class TensorInfo:
    """Name, shape and dtype of a tensor in a header."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype


@dataclass(frozen=True)
class Tensor:
    """Tensor in a memory-mapped file."""

    shape: tuple[int, ...]
    dtype: np.dtype
    data: memoryview
    """Bytes of the file, starting at the first element."""
    strides: tuple[int, ...]
    """Byte strides per axis."""
    checksum: str = ""
    """SHA-256 of the values; empty if the file has no checksums."""
    origin: str = ""
    """Tensor name and file, for error messages."""

    def array(self) -> np.ndarray:
        """Return the values as a read-only view of the file.

        The first call verifies the checksum. Raises `InputError` if it does not match.
        """
        if not self.intact:
            raise InputError(
                f"{self.origin} is damaged: its values do not match their SHA-256 checksum. "
                "Copy or convert the file again."
            )
        return np.ndarray(self.shape, self.dtype, buffer=self.data, strides=self.strides)

    @cached_property
    def intact(self) -> bool:
        """True if the values match their checksum, or have none."""
        return not self.checksum or digest(self.data) == self.checksum


def digest(data: bytes | memoryview) -> str:
    """Return the SHA-256 of bytes, in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def map_file(path: Path) -> memoryview:
    """Memory-map a regular file. Raises `InputError` if it is empty or a Git LFS pointer."""
    with open_regular(path) as file:
        if not os.fstat(file.fileno()).st_size:
            raise InputError(f"{quote_path(path)} is empty.")
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    if bytes(data[: len(POINTER)]) == POINTER:
        raise InputError(
            f"{quote_path(path)} is a Git LFS pointer, not the file itself. Run `git lfs pull` in "
            "its repository, or download the file from the website."
        )
    return data


def read_safetensors(path: Path) -> dict[str, Tensor]:
    """Return the memory-mapped tensors of a safetensors file by name.

    Raises `InputError` if the file is damaged: every byte after the header must belong to exactly
    one tensor, and a header of ours must match its hash.
    """
    with _opened(path) as (file, body):
        infos = [_info(name, file.get_slice(name)) for name in file.offset_keys()]
        checksums = _checksums(file.metadata() or {}, infos)
        ends = accumulate((math.prod(i.shape) * i.dtype.itemsize for i in infos), initial=0)
        return {
            info.name: Tensor(
                shape=info.shape,
                dtype=info.dtype,
                data=body[begin:end],
                strides=strides_of(quote(info.name), info.shape, info.dtype),
                checksum=checksums.get(info.name, ""),
                origin=f"{info.name} of {quote_path(path)}",
            )
            for info, (begin, end) in zip(infos, pairwise(ends), strict=True)
        }


def read_arrays(tensors: Iterable[Any]) -> Iterator[Any]:
    """Yield the arrays of tensors, or arrays, in order; threads verify the next ones meanwhile."""
    threads = min(os.cpu_count() or 1, 8)
    array = lambda tensor: tensor.array() if isinstance(tensor, Tensor) else tensor  # noqa: E731
    return map_ahead(array, tensors, threads=threads, ahead=threads)


def map_ahead(
    function: Callable[[Item], Result], items: Iterable[Item], *, threads: int, ahead: int
) -> Iterator[Result]:
    """Yield the results of a function in the order of the items.

    At most `ahead` results exist that are not yielded yet.
    """
    with ThreadPoolExecutor(threads) as pool:
        waiting: deque[Future[Result]] = deque()
        for item in items:
            if len(waiting) == ahead:
                yield waiting.popleft().result()
            waiting.append(pool.submit(function, item))
        while waiting:
            yield waiting.popleft().result()


def read_metadata(path: Path) -> dict[str, str]:
    """Return the text metadata in the header of a safetensors file."""
    with _opened(path) as (file, _):
        return dict(sorted((file.metadata() or {}).items()))


def weights_hash(tensors: Iterable[TensorInfo], digests: Mapping[str, str]) -> str:
    """Return a hash of the names, dtypes, shapes and values of weights, in the order of the names.

    `digests` has the SHA-256 of each tensor's bytes by name. Bit-equal weights have the same hash,
    whatever the order and metadata of their file.
    """
    codes = {dtype: code for code, dtype in CODES.items()}
    lines = [json.dumps([t.name, codes[t.dtype], *t.shape, digests[t.name]]) for t in tensors]
    return digest("\n".join(sorted(lines)).encode())


def read_weights_hash(path: Path) -> str:
    """Return the `weights_hash` of a file: out of a header of ours, else computed."""
    tensors, metadata = read_safetensors(path), read_metadata(path)
    if CHECKSUMS in metadata:
        return metadata[HASH]
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        digests = pool.map(digest, (tensor.data for tensor in tensors.values()))
        infos = [TensorInfo(name, t.shape, t.dtype) for name, t in tensors.items()]
        return weights_hash(infos, dict(zip(tensors, digests, strict=True)))


def header(
    tensors: Sequence[TensorInfo],
    metadata: Mapping[str, str],
    digests: Mapping[str, str] | None = None,
) -> bytes:
    """Return the safetensors header of these tensors in this order.

    With `digests`, the SHA-256 of each tensor by name, it has the hashes of a file of ours. The
    length does not depend on their values.
    """
    codes = {dtype: code for code, dtype in CODES.items()}
    written = dict(metadata)
    if digests is not None:
        written |= {HASH: weights_hash(tensors, digests), CHECKSUMS: json.dumps(digests)}
    listed: dict[str, Any] = {METADATA: written}
    end = 0
    for tensor in tensors:
        begin, end = end, end + math.prod(tensor.shape) * tensor.dtype.itemsize
        offsets, code = [begin, end], codes[tensor.dtype]
        listed[tensor.name] = {"dtype": code, "shape": tensor.shape, "data_offsets": offsets}
    text = json.dumps(listed).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text


@contextmanager
def _opened(path: Path) -> Iterator[tuple[Any, memoryview]]:
    """Open a file by the safetensors library, which checks its header; yield the bytes after it.

    A `RefusedError` becomes an `InputError` that names the file.
    """
    data = map_file(path)
    try:
        length = int.from_bytes(data[:8], "little")
        if length > MAX_JSON_BYTES:
            raise RefusedError(f"its header has {length:,} bytes; the limit is {MAX_JSON_BYTES:,}")
        with safe_open(path, "numpy") as file:
            yield file, data[8 + length :]
    except (RefusedError, SafetensorError) as error:
        reason = str(error)
        if isinstance(error, SafetensorError):
            reason = quote_text(reason.removeprefix("Error while deserializing header: "))
            reason += ". If it was copied or downloaded, do that again"
        message = f"{quote_path(path)} is not a readable safetensors file: {reason}."
        raise InputError(message) from error


def _info(name: str, entry: Any) -> TensorInfo:
    """Return what a header says of a tensor. Raises `RefusedError` if that is not supported."""
    check_name(name)
    shape, code = tuple(entry.get_shape()), entry.get_dtype()
    if code not in CODES:
        raise RefusedError(f"{quote(name)} has the unsupported dtype {quote_text(code)}")
    if len(shape) > MAX_AXES:
        raise RefusedError(f"{quote(name)} has {len(shape)} axes; the limit is {MAX_AXES}")
    return TensorInfo(name, shape, CODES[code])


def _checksums(metadata: Mapping[str, str], infos: Sequence[TensorInfo]) -> dict[str, str]:
    """Return the checksums in a header by name, verified by its hash; empty if it has none."""
    if CHECKSUMS not in metadata:
        return {}
    checksums = parse_json(metadata[CHECKSUMS].encode(), source=f"its {CHECKSUMS}")
    if (
        not isinstance(checksums, dict)
        or checksums.keys() != {info.name for info in infos}
        or weights_hash(infos, checksums) != metadata.get(HASH)
    ):
        raise RefusedError("its header does not match its SHA-256. Copy or convert it again")
    return checksums


def check_name(name: str) -> None:
    """Raise `RefusedError` if the name of a tensor is too long or not printable."""
    if len(name) > MAX_NAME or not name.isprintable():
        raise RefusedError(
            f"the name {quote(name)} has more than {MAX_NAME} characters or unprintable ones"
        )


def check_sizes(owner: str, numbers: Sequence[Any]) -> None:
    """Raise `RefusedError` unless all numbers are valid sizes, 0 to `MAX_BYTES` - 1."""
    for number in numbers:
        if type(number) is not int or not 0 <= number < MAX_BYTES:
            raise RefusedError(f"{owner} has {quote(number)} where a size is expected")


def strides_of(owner: str, shape: tuple[int, ...], dtype: np.dtype) -> tuple[int, ...]:
    """Return the byte strides of a C-contiguous tensor. Raises `RefusedError` if too large."""
    strides, step = [], dtype.itemsize
    for size in reversed(shape):
        strides.append(step)
        step *= max(size, 1)
    if step > MAX_BYTES:
        raise RefusedError(f"{owner} has more than {MAX_BYTES:,} bytes")
    return tuple(reversed(strides))
