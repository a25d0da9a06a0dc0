"""Read arrays from npy and npz files, without pickle and checked before they are built."""

from __future__ import annotations

import io
import math
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from egosim_jax.io.bounded import quote, quote_path, quote_text
from egosim_jax.io.untrusted.zipped import Archive, open_archive
from egosim_jax.types import InputError

MAX_ARRAY_BYTES, MAX_PACKED_BYTES = 1 << 34, 1 << 26
"""Maximum size of a stored and of a compressed array, in bytes."""
DAMAGE = (ValueError, EOFError, OSError)
"""Exceptions for damaged archives and arrays."""
MAX_ENTRIES = 64
"""Maximum number of arrays in a file."""
_HEADER = 4096


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
    header = io.BytesIO(data[:_HEADER])
    # NumPy writes later versions only for headers of 64 KiB and more, which numbers never need.
    if np.lib.format.read_magic(header) != (1, 0):
        raise ValueError(f"{name} is of another version of npy")
    shape, fortran, kind = np.lib.format.read_array_header_1_0(header, max_header_size=_HEADER)
    if kind.hasobject or kind.kind not in "biuf" or (dtype is not None and kind != np.dtype(dtype)):
        raise ValueError(f"{name} holds {quote_text(str(kind))}")
    if len(data) - header.tell() != math.prod(shape) * kind.itemsize:
        raise ValueError(f"{name} does not have the size that its header declares")
    values = np.frombuffer(data, kind, offset=header.tell())
    return values.reshape(shape, order="F" if fortran else "C").copy(order="C")
