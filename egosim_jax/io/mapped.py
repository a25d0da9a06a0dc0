"""Memory-mapped tensors of safetensors files.

Our own code, because the safetensors library's NumPy reader supports neither bfloat16 nor float8.

Opening a file reads only its header; values are paged in on access. Files of egosim_jax are sealed:
the header holds the SHA-256 of each piece of each tensor and of the header itself. The header is
verified when it is read, a tensor when its values are first accessed.
"""

from __future__ import annotations

import hashlib
import json
import math
import mmap
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import ml_dtypes
import numpy as np

from egosim_jax.io.bounded import (
    MAX_JSON_BYTES,
    open_regular,
    parse_json,
    quote,
    quote_path,
    quote_text,
)
from egosim_jax.types import InputError

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
HASH, CHECKSUMS, SEAL = "sha256", "checksums", "seal"
"""Metadata of a sealed header: hash of the weights, hashes per tensor, hash of the header."""
BLANK = "0" * hashlib.sha256().digest_size * 2
"""Placeholder with the length of a hash."""


class RefusedError(ValueError):
    """Reason why a file cannot be read, without the file's name."""


class TensorInfo(NamedTuple):
    """Name, shape and dtype of a tensor to write."""

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
    checksums: tuple[str, ...] = ()
    """SHA-256 of equal pieces; empty if the file has no checksums."""
    origin: str = ""
    """Tensor name and file, for error messages."""

    def array(self) -> np.ndarray:
        """Return the values as a read-only view of the file.

        The first call verifies the checksums. Raises `InputError` if they do not match.
        """
        if not self.intact:
            raise InputError(
                f"{self.origin} is damaged: its values do not match their SHA-256 checksums. "
                "Copy or convert the file again."
            )
        return np.ndarray(self.shape, self.dtype, buffer=self.data, strides=self.strides)

    @cached_property
    def intact(self) -> bool:
        """True if the values match their checksums, or have no checksums."""
        if not self.checksums:
            return True
        step = len(self.data) // len(self.checksums)
        parts = [self.data[i * step : (i + 1) * step] for i in range(len(self.checksums))]
        with ThreadPoolExecutor(min(len(parts), os.cpu_count() or 1, 8)) as pool:
            return tuple(pool.map(digest, parts)) == self.checksums


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
    one tensor, and a sealed header must match its hash.
    """
    with _refusing(path):
        header, body = _parts(path)
        checksums = _checksums(header.pop(METADATA, {}))
        if checksums and checksums.keys() != header.keys():
            raise RefusedError("its checksums do not cover its tensors")
        tensors = {
            name: _tensor(name, entry, body, checksums.get(name, ""), path)
            for name, entry in header.items()
        }
        _check_offsets(header, len(body))
        return tensors


def read_metadata(path: Path) -> dict[str, str]:
    """Return the text metadata in the header of a safetensors file."""
    with _refusing(path):
        return _parts(path)[0].get(METADATA, {})


def weights_hash(tensors: Iterable[TensorInfo], digests: Mapping[str, str]) -> str:
    """Return a hash of the names, dtypes, shapes and values of weights, in the order of the names.

    `digests` has the SHA-256 of each tensor's bytes by name. Bit-equal weights have the same hash,
    whatever the order, pieces and metadata of their file.
    """
    codes = {dtype: code for code, dtype in CODES.items()}
    lines = [
        json.dumps([name, codes[dtype], *shape, digests[name]]) for name, shape, dtype in tensors
    ]
    return digest("\n".join(sorted(lines)).encode())


def read_weights_hash(path: Path) -> str:
    """Return the `weights_hash` of a file: out of a sealed header if it can be, else computed."""
    tensors, metadata = read_safetensors(path), read_metadata(path)
    if all(len(tensor.checksums) == 1 for tensor in tensors.values()):
        digests = {name: tensor.checksums[0] for name, tensor in tensors.items()}
    elif SEAL in metadata and HASH in metadata:
        return metadata[HASH]
    else:
        with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
            found = pool.map(digest, (tensor.data for tensor in tensors.values()))
            digests = dict(zip(tensors, found, strict=True))
    infos = (TensorInfo(name, t.shape, t.dtype) for name, t in tensors.items())
    return weights_hash(infos, digests)


def header(
    tensors: Sequence[TensorInfo],
    metadata: Mapping[str, str],
    checksums: Mapping[str, Sequence[str]],
    hashed: str,
) -> bytes:
    """Return the safetensors header of these tensors in this order; sealed if its format is ours.

    `hashed` is their `weights_hash`. The length does not depend on the values of the hashes.
    """
    codes = {dtype: code for code, dtype in CODES.items()}
    written = dict(metadata)
    if metadata.get("format") == OURS:
        text = {tensor.name: "".join(checksums[tensor.name]) for tensor in tensors}
        written |= {HASH: hashed, CHECKSUMS: json.dumps(text), SEAL: BLANK}
    listed: dict[str, Any] = {METADATA: written}
    end = 0
    for tensor in tensors:
        begin, end = end, end + math.prod(tensor.shape) * tensor.dtype.itemsize
        offsets, code = [begin, end], codes[tensor.dtype]
        listed[tensor.name] = {"dtype": code, "shape": tensor.shape, "data_offsets": offsets}
    text = json.dumps(listed).encode()
    text += b" " * (-len(text) % 8)
    # A file cannot hold its own hash: the seal is the hash of the header with a blank seal.
    text = text.replace(_seal(BLANK), _seal(digest(text)))
    return len(text).to_bytes(8, "little") + text


def _seal(value: str) -> bytes:
    return f'"{SEAL}": "{value}"}}'.encode()


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turn a `RefusedError` into an `InputError` that names the file."""
    try:
        yield
    except RefusedError as error:
        message = f"{quote_path(path)} is not a readable safetensors file: {error}."
        raise InputError(message) from error


def _parts(path: Path) -> tuple[dict[str, Any], memoryview]:
    """Return the verified header and the bytes after it."""
    data = map_file(path)
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > len(data) - 8:
        raise RefusedError(f"its header size, {length:,} bytes, exceeds the file")
    if length > MAX_JSON_BYTES:
        raise RefusedError(f"its header has {length:,} bytes; the limit is {MAX_JSON_BYTES:,}")
    text = bytes(data[8 : 8 + length])
    header = parse_json(text, source=f"The header of {quote_path(path)}")
    if not isinstance(header, dict) or len(header) > MAX_TENSORS:
        raise RefusedError(f"its header is not a JSON object of at most {MAX_TENSORS:,} tensors")
    metadata = header.get(METADATA, {})
    if not isinstance(metadata, dict) or not all(isinstance(v, str) for v in metadata.values()):
        raise RefusedError(f"its {METADATA} is not a JSON object of strings")
    seal = metadata.get(SEAL)
    if seal is not None:
        blank = text.replace(_seal(seal), _seal(BLANK))
        if digest(blank) != seal:
            raise RefusedError("its header does not match its SHA-256 seal. Copy the file again")
    return header, data[8 + length :]


def _checksums(metadata: Mapping[str, str]) -> dict[str, str]:
    if (CHECKSUMS in metadata) != (SEAL in metadata):
        raise RefusedError(f"its header has only one of {CHECKSUMS} and {SEAL}")
    found = parse_json(metadata.get(CHECKSUMS, "{}").encode(), source=f"its {CHECKSUMS}")
    if not isinstance(found, dict) or not all(
        isinstance(text, str) and text and len(text) % len(BLANK) == 0 for text in found.values()
    ):
        raise RefusedError(f"its {CHECKSUMS} are not a JSON object of SHA-256 hashes")
    return found


def _tensor(name: str, entry: Any, body: memoryview, checksums: str, path: Path) -> Tensor:
    check_name(name)
    match entry:
        case {
            "dtype": str(code), "shape": [*shape], "data_offsets": [begin, end], **others
        } if not others:  # fmt: skip
            pass
        case _:
            raise RefusedError(f"{quote(name)} must have exactly dtype, shape and data_offsets")
    if code not in CODES:
        raise RefusedError(f"{quote(name)} has the unsupported dtype {quote_text(code)}")
    dtype = CODES[code]
    if len(shape) > MAX_AXES:
        raise RefusedError(f"{quote(name)} has {len(shape)} axes; the limit is {MAX_AXES}")
    check_sizes(quote(name), (begin, end, *shape))
    strides = strides_of(quote(name), tuple(shape), dtype)
    if not begin <= end <= len(body) or end - begin != math.prod(shape) * dtype.itemsize:
        raise RefusedError(
            f"{quote(name)}, {code} of shape {quote_text(str(shape))}, has data_offsets "
            f"{begin} to {end} of {len(body)} bytes: not its size, or outside the file"
        )
    return Tensor(
        shape=tuple(shape),
        dtype=dtype,
        data=body[begin:end],
        strides=strides,
        checksums=tuple(
            checksums[i : i + len(BLANK)] for i in range(0, len(checksums), len(BLANK))
        ),
        origin=f"{name} of {quote_path(path)}",
    )


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


def _check_offsets(header: Mapping[str, Any], size: int) -> None:
    """Raise `RefusedError` unless the tensors are contiguous up to the end of the file."""
    offsets = sorted((*entry["data_offsets"], name) for name, entry in header.items())
    end = 0
    for begin, following, name in (*offsets, (size, size, "end of file")):
        if begin != end:
            raise RefusedError(
                f"{quote(name)} begins at byte {begin} where {end} is expected: tensors may "
                "neither overlap nor leave holes"
            )
        end = following
