"""Read arrays from npy and npz files, without pickle and checked before they are built."""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from egosim_jax.io.bounded import quote, quote_path, quote_text
from egosim_jax.io.untrusted.zipped import Archive, open_archive
from egosim_jax.types import InputError

MAX_ARRAY_BYTES, MAX_PACKED_BYTES = 1 << 34, 1 << 26
"""Maximum size of a stored and of a compressed array, in bytes."""
DAMAGE = (ValueError, EOFError, OSError, struct.error)
"""Exceptions for damaged archives and arrays."""
MAX_ENTRIES = 64
_HEADER = 4096
_SIZE = r"(?:0|[1-9][0-9]{0,18})\s*"
_ITEM = re.compile(
    r"""\s*['"](?:descr['"]\s*:\s*['"](?P<descr>[<>|=]?[?biufcOSUVmM][0-9]{0,3})['"]"""
    r"""|fortran_order['"]\s*:\s*(?P<order>True|False)"""
    rf"""|shape['"]\s*:\s*\((?P<shape>\s*(?:{_SIZE},\s*)*|\s*(?:{_SIZE},\s*)+{_SIZE})\))"""
    r"\s*(?:,\s*|$)"
)
"""Item of an npy's header, such as `'shape': (2, 3), `."""


def read_arrays(
    path: Path,
    dtypes: Mapping[str, str],
    *,
    others: Collection[str] = (),
    packed: bool = False,
    optional: Mapping[str, str] | None = None,
) -> dict[str, np.ndarray]:
    """Read exactly the named arrays of an npz that `np.savez` wrote.

    `dtypes` holds the dtype of each array, and `optional` the dtype of arrays that may be absent.
    Arrays in `others` may have any numeric dtype. `packed` allows compressed arrays. Raises
    `InputError` if an array is missing, unknown, of another dtype, too large or damaged: shapes are
    checked against sizes before anything is built, contents against their CRC-32.
    """
    name = quote_path(path)
    try:
        with open_archive(path) as archive:
            found = list(archive.entries)
            names = [entry.removesuffix(".npy") for entry in found[:MAX_ENTRIES]]
            dtypes = {**dtypes, **{n: d for n, d in (optional or {}).items() if n in names}}
            if len(found) > MAX_ENTRIES or sorted(names) != sorted({*dtypes, *others}):
                listing = ", ".join(quote_text(n) for n in names[:8])
                raise InputError(f"{name} holds the arrays {listing}: not those expected.")
            _check_sizes(archive, packed)
            return {
                n: read_npy(archive.read(entry, limit=MAX_ARRAY_BYTES), quote(entry),
                            dtype=dtypes.get(n))
                for n, entry in zip(names, found, strict=True)
            }  # fmt: skip
    except InputError:
        raise
    except DAMAGE as error:
        raise InputError(f"{name} is damaged: {quote_text(str(error))}.") from error


def read_all(path: Path) -> dict[str, np.ndarray]:
    """Read all arrays of an npz of this program. Raises `ValueError` if it is damaged."""
    with open_archive(path) as archive:
        return {
            entry.removesuffix(".npy"): read_npy(archive.read(entry, limit=MAX_ARRAY_BYTES), entry)
            for entry in archive.entries
        }


def array_names(path: Path) -> list[str]:
    """Return the names of the arrays of an npz. Raises `ValueError` if it is damaged."""
    with open_archive(path) as archive:
        return [name.removesuffix(".npy") for name in archive.entries]


def _check_sizes(archive: Archive, packed: bool) -> None:
    """Raise `ValueError` if an array is too large, or the compressed ones are together."""
    unpacked = 0
    for entry in archive.entries.values():
        unpacked += 0 if entry.is_stored else entry.size
        limit = MAX_ARRAY_BYTES if entry.is_stored else MAX_PACKED_BYTES if packed else 0
        if entry.size > limit or unpacked > 4 * MAX_PACKED_BYTES:
            raise ValueError(f"{quote(entry.name)} is compressed or too large")


def read_npy(data: bytes, name: str, *, dtype: str | None = None) -> np.ndarray:
    """Parse the bytes of an npy file of numbers, without pickle. Raises `ValueError`."""
    # NumPy writes later versions only for headers of 64 KiB and more, which numbers never need.
    if data[:8] != b"\x93NUMPY\1\0":
        raise ValueError(f"{name} is not of version 1.0 of npy")
    start = 10 + int.from_bytes(data[8:10], "little")
    shape, fortran, kind = _header(data[10 : min(start, _HEADER)].decode("latin-1"), name)
    if kind.hasobject or kind.kind not in "biuf" or (dtype is not None and kind != np.dtype(dtype)):
        raise ValueError(f"{name} holds {quote_text(str(kind))}")
    if len(data) - start != math.prod(shape) * kind.itemsize:
        raise ValueError(f"{name} does not have the size that its header declares")
    values = np.frombuffer(data, kind, offset=start)
    return values.reshape(shape, order="F" if fortran else "C").copy(order="C")


def _header(text: str, name: str) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return the shape, the order and the dtype in the header of an npy file.

    NumPy's own reader calls `ast`, whose counter of recursions is wrong in Python 3.11 after a
    switch of threads during a garbage collection, in which jax runs code.
    """
    found, rest = dict[str, str](), text.strip()
    framed = rest.startswith("{") and rest.endswith("}") and not ("'" in rest and '"' in rest)
    rest = rest[1:-1]
    while item := _ITEM.match(rest):
        found |= {key: value for key, value in item.groupdict().items() if value is not None}
        rest = rest[item.end() :]
    if not framed or rest or len(found) < 3:
        raise ValueError(f"{name} has the header {quote(text)}, which does not describe numbers")
    try:
        kind = np.dtype(found["descr"])
    except TypeError as error:
        raise ValueError(f"{name} holds {quote(found['descr'])}") from error
    shape = tuple(int(size) for size in found["shape"].split(",") if size.strip())
    return shape, found["order"] == "True", kind
