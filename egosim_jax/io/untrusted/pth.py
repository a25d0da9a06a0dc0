"""Read PyTorch's `.pth` files without PyTorch and without executing their pickles.

Our own code, because the only other reader, `torch.load`, needs PyTorch, which is no dependency.

A `.pth` is a zip archive of uncompressed entries: `NAME/data.pkl`, a pickle of dictionaries, lists
and references to tensors, and `NAME/data/KEY`, the bytes of each storage. This module adds storages
and tensors to the interpreter in `pickled.py`. Every tensor is checked against its storage and
stays in the memory-mapped file until it is accessed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.bounded import quote, quote_text
from egosim_jax.io.mapped import (
    CODES,
    MAX_AXES,
    RefusedError,
    Tensor,
    check_sizes,
    map_file,
    strides_of,
)
from egosim_jax.io.untrusted.pickled import Interpreter, Name, Opaque, flatten, refusing_damage
from egosim_jax.io.untrusted.zipped import Archive

SUFFIXES = (".pth", ".pt", ".bin", ".ckpt")
"""Suffixes of files that torch wrote."""
STORAGES = {
    "DoubleStorage": "float64", "FloatStorage": "float32", "HalfStorage": "float16",
    "BFloat16Storage": "bfloat16", "LongStorage": "int64", "IntStorage": "int32",
    "ShortStorage": "int16", "CharStorage": "int8", "ByteStorage": "uint8", "BoolStorage": "bool",
}  # fmt: skip
"""Dtype of the elements of each of torch's storage classes."""
DTYPES = {dtype.name: dtype for dtype in CODES.values()} | {
    name: np.dtype(name) for name in ("float8_e4m3fnuz", "float8_e5m2fnuz")
}
"""NumPy dtypes by their names in torch."""
FIX = (
    "Only tensors in plain containers are supported, as torch.save writes state dicts. Save the "
    "weights again as such, or better as safetensors."
)
UNTYPED = "torch.storage.UntypedStorage"


@dataclass(frozen=True)
class Storage(Opaque):
    """Bytes that tensors are views of."""

    data: memoryview
    dtype: str | None
    """Element dtype; None for an untyped storage, whose tensors declare it."""


def read_pth(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a `.pth` file by name, nested keys joined by dots.

    The file stays mapped while a tensor is alive. Raises `InputError` with the reason if it is not
    a `.pth` archive, is damaged, or holds objects other than tensors, plain values and containers.
    """
    data = map_file(path)
    with refusing_damage(path, FIX):
        return flatten(_Torch(read_entries(data)).run(), Tensor)


def read_entries(data: memoryview) -> dict[str, memoryview]:
    """Return the content of every entry by name, without the top-level folder.

    Raises `RefusedError` if this is not a valid uncompressed little-endian archive.
    """
    if bytes(data[:2]) != b"PK":
        raise RefusedError(
            "not a zip archive; files from before torch 1.6 and bare pickles are not supported"
        )
    try:
        archive = Archive(lambda at, count: bytes(data[at : at + count]), len(data))
    except ValueError as error:
        raise RefusedError(str(error)) from error
    if sum(entry.size for entry in archive.entries.values()) > len(data):
        raise RefusedError("its entries exceed the file")
    found: dict[str, memoryview] = {}
    for entry in archive.entries.values():
        parts = entry.name.split("/")
        if ".." in parts or entry.name.startswith("/") or "\\" in entry.name:
            raise RefusedError(f"entry {quote(entry.name)} has a path outside the archive")
        if not entry.is_stored:
            raise RefusedError(f"entry {quote(entry.name)} is compressed or encrypted")
        name = "/".join(parts[1:])
        if name in found:
            raise RefusedError(f"duplicate entry {quote(entry.name)}")
        found[name] = data[entry.begin : entry.begin + entry.size]
    if found.get("byteorder", b"little") != b"little":
        raise RefusedError("its byte order is big-endian")
    if "data.pkl" not in found:
        raise RefusedError("it has no data.pkl")
    return found


class _Torch(Interpreter):
    """Interpreter that adds torch's tensors, as views of the storages in an archive."""

    allowed = Interpreter.allowed | {
        "torch.Size", "torch._utils._rebuild_parameter", "torch._utils._rebuild_tensor_v2",
        "torch._utils._rebuild_tensor_v3", UNTYPED,
        *(f"torch.{name}" for name in (*STORAGES, *DTYPES)),
    }  # fmt: skip

    def __init__(self, entries: Mapping[str, memoryview]):
        super().__init__(entries["data.pkl"])
        self.entries = entries

    def referenced(self, identity: Any) -> Storage:
        """Return a storage in the archive."""
        match identity:
            case ("storage", Name(kind), str(key), str(), int(count)):
                pass
            case _:
                raise RefusedError(
                    f"its pickle references {quote(identity)}, which is not a storage"
                )
        data = self.entries.get(f"data/{key}")
        if data is None:
            raise RefusedError(f"the storage {quote_text(key)} is missing")
        dtype = None if kind == UNTYPED else STORAGES.get(kind.removeprefix("torch."))
        if dtype is None and kind != UNTYPED:
            raise RefusedError(f"{kind} is not a storage class")
        size = count * (1 if dtype is None else DTYPES[dtype].itemsize)
        if count < 0 or size > len(data):
            raise RefusedError(
                f"the storage {quote_text(key)} declares {quote(size)} bytes but has {len(data)}"
            )
        return Storage(data[:size], dtype)

    def called(self, name: str, arguments: tuple) -> Any:
        """Return a tensor or its size."""
        match (name, arguments):
            case ("torch.Size", (tuple(size),)):
                return size
            case ("torch._utils._rebuild_parameter", (Tensor() as tensor, bool(), {})):
                return tensor
            case (
                "torch._utils._rebuild_tensor_v2",
                (Storage(dtype=str(dtype)) as storage, offset, tuple(size), tuple(stride), *_),
            ):
                return _tensor(storage, dtype, offset, size, stride)
            case (
                "torch._utils._rebuild_tensor_v3",
                (
                    Storage() as storage, offset, tuple(size), tuple(stride), bool(), {},
                    Name(dtype), *_,
                ),
            ):  # fmt: skip
                return _tensor(storage, dtype.removeprefix("torch."), offset, size, stride)
            case _:
                return super().called(name, arguments)


def _tensor(storage: Storage, dtype: str, offset: Any, size: tuple, stride: tuple) -> Tensor:
    """Return a view of a storage. Raises `RefusedError` unless all its elements are inside."""
    if dtype not in DTYPES:
        raise RefusedError(f"a tensor has the unsupported dtype {dtype}")
    if len(size) != len(stride) or len(size) > MAX_AXES:
        raise RefusedError(f"a tensor has {len(size)} axes and {len(stride)} strides")
    kind = DTYPES[dtype]
    check_sizes("a tensor", (offset, *size, *stride))
    strides_of("a tensor", size, kind)
    count = math.prod(size)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    here = len(storage.data) // kind.itemsize
    if count and last >= here:
        raise RefusedError(f"a tensor of size {size} reads element {last} of a storage of {here}")
    # A stride of 0 lets a few bytes declare a huge tensor.
    if count > max(here, 1):
        raise RefusedError(f"a tensor of size {size} repeats the {here} elements of its storage")
    return Tensor(
        shape=size,
        dtype=kind,
        data=storage.data[offset * kind.itemsize :],
        strides=tuple(kind.itemsize * step for step in stride),
    )
