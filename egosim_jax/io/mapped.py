"""Tensors in safetensors files: what each is, and its values where they lie.

Nothing is read but the header until a tensor is asked for its values, and then no more than is
looked at. safetensors' own reader for NumPy knows neither bfloat16 nor float8.

Files that we write are sealed: the header has the SHA-256 of each piece of each tensor, and one of
itself. The header is checked when it is read, a tensor when its values are first asked for.
"""

from __future__ import annotations

import hashlib
import json
import math
import mmap
import os
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import ml_dtypes
import numpy as np

from egosim_jax.io.untrusted import (
    MAX_JSON_BYTES,
    open_regular,
    parse_json,
    quote,
    quote_path,
    quote_text,
)
from egosim_jax.types import InputError

DTYPES = {
    "float64": np.float64, "float32": np.float32, "float16": np.float16,
    "bfloat16": ml_dtypes.bfloat16, "float8_e4m3fn": ml_dtypes.float8_e4m3fn,
    "float8_e5m2": ml_dtypes.float8_e5m2, "float8_e4m3fnuz": ml_dtypes.float8_e4m3fnuz,
    "float8_e5m2fnuz": ml_dtypes.float8_e5m2fnuz, "int64": np.int64, "int32": np.int32,
    "int16": np.int16, "int8": np.int8, "uint8": np.uint8, "uint16": np.uint16,
    "uint32": np.uint32, "uint64": np.uint64, "bool": np.bool_,
}  # fmt: skip
"""By their names in torch."""
CODES = {
    "F64": "float64", "F32": "float32", "F16": "float16", "BF16": "bfloat16",
    "F8_E4M3": "float8_e4m3fn", "F8_E5M2": "float8_e5m2", "I64": "int64", "I32": "int32",
    "I16": "int16", "I8": "int8", "U64": "uint64", "U32": "uint32", "U16": "uint16", "U8": "uint8",
    "BOOL": "bool",
}  # fmt: skip
"""What safetensors calls torch's dtypes."""
MOST_TENSORS, LONGEST_NAME, LARGEST, MOST_AXES = 1 << 17, 512, 1 << 48, 32
"""Tensors in a file, characters of a name, bytes of a tensor whose axes of 0 count as 1, axes."""
POINTER = b"version https://git-lfs.github.com/spec/"
"""How a file begins that Git LFS left in the place of the real one."""
ABOUT, OURS = "__metadata__", "egosim_jax"
"""Entry of a header for text, and the `format` that files of ours say there."""
HASH, CHECKSUMS, SEAL = "sha256", "checksums", "seal"
"""Of a sealed header: the hash over all pieces, those of each tensor, and the header's own."""
BLANK = "0" * hashlib.sha256().digest_size * 2
"""Stands in a header where a hash will be."""


class RefusedError(ValueError):
    """What in a file cannot be read, and why."""


class Named(NamedTuple):
    """What is said of a tensor before it has values."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype


@dataclass(frozen=True)
class Tensor:
    """A tensor in a file: what it is, and how to look at it."""

    shape: tuple[int, ...]
    dtype: np.dtype
    data: memoryview
    """From its first element on."""
    strides: tuple[int, ...]
    """In bytes."""
    checksums: tuple[str, ...] = ()
    """SHA-256 of equal parts of it, if the file has them."""
    origin: str = ""
    """Name and file, for a message."""

    def array(self) -> np.ndarray:
        """Its values, read-only, as they lie in the file.

        Raises `InputError` if they are not those of its checksums; only the first call looks.
        """
        if not self.intact:
            raise InputError(
                f"{self.origin} is damaged: its values are not those that were written (SHA-256). "
                "Copy or convert the file again."
            )
        return np.ndarray(self.shape, self.dtype, buffer=self.data, strides=self.strides)

    @cached_property
    def intact(self) -> bool:
        """Whether the values are those of the checksums, or there are none."""
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
    """Map a regular file. Raises `InputError` if it is none, empty, or a pointer of Git LFS."""
    with open_regular(path) as file:
        if not os.fstat(file.fileno()).st_size:
            raise InputError(f"{quote_path(path)} is empty.")
        data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    if bytes(data[: len(POINTER)]) == POINTER:
        raise InputError(
            f"{quote_path(path)} is only a pointer of Git LFS, not the file itself. Get that with "
            "`git lfs pull` in its repository, or download it from the website."
        )
    return data


def read_safetensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file by name, mapped.

    Raises `InputError` if it is damaged: every byte after the header is of exactly one tensor, and
    a sealed header is what was written.
    """
    with _refusing(path):
        header, body = _parts(path)
        about = header.pop(ABOUT, {})
        checksums = _checksums(about)
        if checksums and checksums.keys() != header.keys():
            raise RefusedError("its checksums are not of its tensors")
        tensors = {
            name: _tensor(name, entry, body, checksums.get(name, ""), path)
            for name, entry in header.items()
        }
        _check_places(header, len(body))
        return tensors


def read_metadata(path: Path) -> dict[str, str]:
    """The text that a safetensors file carries about itself."""
    with _refusing(path):
        return _parts(path)[0].get(ABOUT, {})


def header(
    tensors: Sequence[Named], about: Mapping[str, str], checksums: Mapping[str, Sequence[str]]
) -> bytes:
    """The header of a safetensors file of these tensors, in this order; sealed if of our format.

    Its length does not depend on the values of the checksums.
    """
    codes = {name: code for code, name in CODES.items()}
    said = dict(about)
    if about.get("format") == OURS:
        text = {tensor.name: "".join(checksums[tensor.name]) for tensor in tensors}
        joint = hashlib.sha256("".join(text.values()).encode()).hexdigest()
        said |= {HASH: joint, CHECKSUMS: json.dumps(text), SEAL: BLANK}
    listed: dict[str, Any] = {ABOUT: said}
    end = 0
    for tensor in tensors:
        begin, end = end, end + math.prod(tensor.shape) * tensor.dtype.itemsize
        places, code = [begin, end], codes[tensor.dtype.name]
        listed[tensor.name] = {"dtype": code, "shape": tensor.shape, "data_offsets": places}
    text = json.dumps(listed).encode()
    text += b" " * (-len(text) % 8)
    text = text.replace(_seal(BLANK), _seal(digest(text)))
    return len(text).to_bytes(8, "little") + text


def _seal(value: str) -> bytes:
    return f'"{SEAL}": "{value}"}}'.encode()


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Say which file it is that cannot be read."""
    try:
        yield
    except RefusedError as error:
        message = f"{quote_path(path)} is no readable safetensors file: {error}."
        raise InputError(message) from error


def _parts(path: Path) -> tuple[dict[str, Any], memoryview]:
    """The header, which is what was written if it is sealed, and what follows it."""
    data = map_file(path)
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > len(data) - 8:
        raise RefusedError(f"its header would have {length:,} bytes, more than the file")
    if length > MAX_JSON_BYTES:
        raise RefusedError(f"its header has {length:,} bytes, more than {MAX_JSON_BYTES:,}")
    text = bytes(data[8 : 8 + length])
    header = parse_json(text, source=f"The header of {quote_path(path)}")
    if not isinstance(header, dict) or len(header) > MOST_TENSORS:
        raise RefusedError("its header is no list of tensors")
    about = header.get(ABOUT, {})
    if not isinstance(about, dict) or not all(isinstance(text, str) for text in about.values()):
        raise RefusedError(f"its {ABOUT} is not text by name")
    seal = about.get(SEAL)
    if seal is not None:
        blank = text.replace(_seal(seal), _seal(BLANK))
        if digest(blank) != seal:
            raise RefusedError("its header is not what was written (SHA-256). Copy it again")
    return header, data[8 + length :]


def _checksums(about: Mapping[str, str]) -> dict[str, str]:
    if (CHECKSUMS in about) != (SEAL in about):
        raise RefusedError(f"its header has only one of {CHECKSUMS} and {SEAL}")
    found = parse_json(about.get(CHECKSUMS, "{}").encode(), source=f"its {CHECKSUMS}")
    if not isinstance(found, dict) or not all(
        isinstance(text, str) and text and len(text) % len(BLANK) == 0 for text in found.values()
    ):
        raise RefusedError(f"its {CHECKSUMS} are not text by name")
    return found


def _tensor(name: str, about: Any, body: memoryview, checksums: str, path: Path) -> Tensor:
    check_name(name)
    match about:
        case {
            "dtype": str(code), "shape": [*shape], "data_offsets": [begin, end], **others
        } if not others:  # fmt: skip
            pass
        case _:
            raise RefusedError(f"{quote(name)} is not described by dtype, shape and data_offsets")
    if code not in CODES:
        raise RefusedError(f"{quote(name)} is of {quote_text(code)}, which is not read")
    dtype = np.dtype(DTYPES[CODES[code]])
    if len(shape) > MOST_AXES:
        raise RefusedError(f"{quote(name)} has {len(shape)} axes, more than {MOST_AXES}")
    check_sizes(quote(name), (begin, end, *shape))
    strides = strides_of(quote(name), tuple(shape), dtype)
    if not begin <= end <= len(body) or end - begin != math.prod(shape) * dtype.itemsize:
        raise RefusedError(
            f"{quote(name)} of {code} {quote_text(str(shape))} lies at {begin} to {end} of "
            f"{len(body)} bytes, which is not its size or not in the file"
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
    """Raise `RefusedError` for the name of a tensor that no message could show."""
    if len(name) > LONGEST_NAME or not name.isprintable():
        raise RefusedError(
            f"the name {quote(name)} has more than {LONGEST_NAME} characters, or some that cannot "
            "be printed"
        )


def check_sizes(what: str, numbers: Sequence[Any]) -> None:
    """Raise `RefusedError` unless all numbers of a tensor are sizes."""
    for number in numbers:
        if type(number) is not int or not 0 <= number < LARGEST:
            raise RefusedError(f"{what} has {quote(number)} where a size has to be")


def strides_of(what: str, shape: tuple[int, ...], dtype: np.dtype) -> tuple[int, ...]:
    """Return the strides of a tensor in row order. Raises `RefusedError` if it is too large."""
    strides, step = [], dtype.itemsize
    for size in reversed(shape):
        strides.append(step)
        step *= max(size, 1)
    if step > LARGEST:
        raise RefusedError(f"{what} has more than {LARGEST:,} bytes")
    return tuple(reversed(strides))


def _check_places(header: Mapping[str, Any], size: int) -> None:
    """Raise `RefusedError` unless the tensors lie one after the other up to the file's end."""
    places = sorted((*entry["data_offsets"], name) for name, entry in header.items())
    end = 0
    for begin, following, name in (*places, (size, size, "the file's end")):
        if begin != end:
            raise RefusedError(
                f"{quote(name)} is at {begin}, and what lies before it ends at {end}: tensors may "
                "neither overlap nor leave holes"
            )
        end = following
