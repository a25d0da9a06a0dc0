"""Tensors in safetensors files: what each is, and its values where they lie.

Nothing is read but the header until a tensor is asked for its values, and then no more than is
looked at. safetensors' own reader for NumPy knows neither bfloat16 nor float8.
"""

from __future__ import annotations

import json
import math
import mmap
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np

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
MOST_HEADER, MOST_TENSORS = 100 << 20, 1 << 18
"""Bytes of a header, and tensors in it."""


@dataclass(frozen=True)
class Tensor:
    """A tensor in a file: what it is, and how to look at it."""

    shape: tuple[int, ...]
    dtype: np.dtype
    data: memoryview
    """From its first element on."""
    strides: tuple[int, ...]
    """In bytes."""

    def array(self) -> np.ndarray:
        """Its values, read-only, as they lie in the file."""
        return np.ndarray(self.shape, self.dtype, buffer=self.data, strides=self.strides)


def read_safetensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file by name, mapped.

    Raises `InputError` if it is damaged: sizes, dtypes and places are checked against the file.
    """
    try:
        with path.open("rb") as file:
            data = memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
        length = int.from_bytes(data[:8], "little")
        if len(data) < 8 or length > min(MOST_HEADER, len(data) - 8):
            raise ValueError(f"its header would have {length} bytes")
        header = json.loads(bytes(data[8 : 8 + length]), object_pairs_hook=_once)
        if not isinstance(header, dict) or len(header) > MOST_TENSORS:
            raise ValueError("its header is no list of tensors")
        header.pop("__metadata__", None)
        body = data[8 + length :]
        return {name: _tensor(name, about, body) for name, about in header.items()}
    except (OSError, ValueError) as error:
        raise InputError(f"{path} is no readable safetensors file: {error}.") from error


def read_metadata(path: Path) -> dict[str, str]:
    """The text that a safetensors file carries about itself."""
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
            return dict(json.loads(file.read(min(length, MOST_HEADER))).get("__metadata__", {}))
    except (OSError, ValueError, AttributeError, TypeError) as error:
        raise InputError(f"{path} is no readable safetensors file: {error}.") from error


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"{', '.join(twice)} is there twice")
    return found


def _tensor(name: str, about: Any, body: memoryview) -> Tensor:
    try:
        code, shape, (begin, end) = about["dtype"], about["shape"], about["data_offsets"]
        numbers = (begin, end, *shape)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{name} is not described: {error!r}") from error
    if code not in CODES:
        raise ValueError(f"{name} is of {code}, which is not read")
    if not all(type(n) is int and n >= 0 for n in numbers):
        raise ValueError(f"{name} has shape {shape} and place {begin} to {end}")
    dtype = np.dtype(DTYPES[CODES[code]])
    if not begin <= end <= len(body) or end - begin != math.prod(shape) * dtype.itemsize:
        raise ValueError(
            f"{name} of {code} {shape} lies at {begin} to {end} of {len(body)} bytes, which is "
            "not its size or not in the file"
        )
    strides = tuple(dtype.itemsize * math.prod(shape[i + 1 :]) for i in range(len(shape)))
    return Tensor(shape=tuple(shape), dtype=dtype, data=body[begin:end], strides=strides)
