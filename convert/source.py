"""Foreign checkpoints, opened: their tensors by name, mapped and not yet read.

A checkpoint is one file, safetensors or `.pth`, or several with an index that says which tensor
lies in which. Nothing is read but headers until a tensor is asked for its values.
"""

from __future__ import annotations

import json
import math
import mmap
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.convert.pth import DTYPES, Tensor, read_pth
from egosim_jax.types import InputError

CODES = {
    "F64": "float64", "F32": "float32", "F16": "float16", "BF16": "bfloat16",
    "F8_E4M3": "float8_e4m3fn", "F8_E5M2": "float8_e5m2", "I64": "int64", "I32": "int32",
    "I16": "int16", "I8": "int8", "U64": "uint64", "U32": "uint32", "U16": "uint16", "U8": "uint8",
    "BOOL": "bool",
}  # fmt: skip
"""What safetensors calls torch's dtypes."""
MOST_HEADER, MOST_TENSORS = 100 << 20, 1 << 18
"""Bytes of a header, and tensors in it."""
INDEX = ".safetensors.index.json"
SHARD = re.compile(r"(.+)-\d{5}-of-(\d{5})")
PTH = (".pth", ".pt", ".bin")


@dataclass(frozen=True, kw_only=True)
class Source:
    """One checkpoint."""

    name: str
    """The file's, or what the names of its parts have in common."""
    files: tuple[Path, ...]
    tensors: Mapping[str, Tensor]

    @property
    def bytes(self) -> int:
        """Of all tensors."""
        return sum(math.prod(t.shape) * t.dtype.itemsize for t in self.tensors.values())


def sources(path: Path) -> Iterator[Source]:
    """The checkpoints of a file or folder, without those of folders in it.

    Files of one index, or numbered `NAME-00001-of-00003`, are one. Raises `InputError` if a file is
    damaged or a numbered one is missing, and for a name that two files of one have.
    """
    if path.is_file():
        yield _joined(path.name, [path])
        return
    if not path.is_dir():
        raise InputError(f"{path} is not there. (--source)")
    left = {f for f in path.iterdir() if f.suffix in (".safetensors", *PTH) and f.is_file()}
    for index in sorted(path.glob(f"*{INDEX}")):
        files = _indexed(index)
        left -= set(files)
        yield _joined(index.name.removesuffix(INDEX), files)
    groups: dict[str, list[Path]] = {}
    for file in sorted(left):
        part = SHARD.fullmatch(file.stem)
        groups.setdefault(part[1] if part else file.name, []).append(file)
    for name, files in groups.items():
        part = SHARD.fullmatch(files[0].stem)
        if part and len(files) != int(part[2]):
            raise InputError(f"{path} has {len(files)} of the {int(part[2])} files of {name}.")
        yield _joined(name, files)


def _indexed(index: Path) -> list[Path]:
    """The files of an index, all there."""
    try:
        places = json.loads(index.read_text(encoding="utf-8"))["weight_map"]
        files = sorted({index.parent / place for place in places.values()})
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{index} is no index of safetensors: {error!r}.") from error
    for file in files:
        if file.parent != index.parent or not file.is_file():
            raise InputError(f"{index} names {file.name}, which is not beside it.")
    return files


def _joined(name: str, files: Sequence[Path]) -> Source:
    tensors: dict[str, Tensor] = {}
    for file in files:
        found = read_pth(file) if file.suffix in PTH else read_safetensors(file)
        if twice := sorted(tensors.keys() & found.keys()):
            raise InputError(f"{file} has {', '.join(twice)}, which another file of {name} has.")
        tensors |= found
    return Source(name=name, files=tuple(files), tensors=tensors)


def read_safetensors(path: Path) -> dict[str, Tensor]:
    """The tensors of a safetensors file by name, mapped.

    safetensors' own reader for NumPy knows neither bfloat16 nor float8; its header is this simple.
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
    with path.open("rb") as file:
        length = int.from_bytes(file.read(8), "little")
        return json.loads(file.read(min(length, MOST_HEADER))).get("__metadata__", {})


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
