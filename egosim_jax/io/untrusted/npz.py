"""Read arrays from npy and npz files, without pickle and checked before they are built."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from egosim_jax.io.bounded import open_regular, quote, quote_path, quote_text
from egosim_jax.types import InputError

MAX_ARRAY_BYTES, MAX_PACKED_BYTES = 1 << 34, 1 << 26
"""Maximum size of a stored and of a compressed array, in bytes."""
DAMAGE = (zipfile.BadZipFile, zlib.error, ValueError, EOFError, OSError, NotImplementedError,
          RuntimeError)  # fmt: skip
"""Exceptions of zipfile and NumPy for damaged archives."""
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
    with open_regular(path) as file:
        try:
            with zipfile.ZipFile(file) as archive:
                found = archive.infolist()
                names = [entry.filename.removesuffix(".npy") for entry in found[:MAX_ENTRIES]]
                dtypes = {**dtypes, **{n: d for n, d in (optional or {}).items() if n in names}}
                if len(found) > MAX_ENTRIES or sorted(names) != sorted({*dtypes, *others}):
                    listing = ", ".join(quote_text(n) for n in names[:8])
                    raise InputError(f"{name} holds the arrays {listing}: not those expected.")
                return {
                    n: _read(archive, entry, dtypes.get(n), packed)
                    for n, entry in zip(names, found, strict=True)
                }
        except InputError:
            raise
        except DAMAGE as error:
            raise InputError(f"{name} is damaged: {quote_text(str(error))}.") from error


def _read(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo, dtype: str | None, packed: bool
) -> np.ndarray:
    stored = entry.compress_type == zipfile.ZIP_STORED and entry.compress_size == entry.file_size
    limit = MAX_ARRAY_BYTES if stored else MAX_PACKED_BYTES if packed else 0
    if entry.file_size > limit:
        raise ValueError(f"{quote(entry.filename)} is compressed or too large")
    return read_npy(archive.read(entry), quote(entry.filename), dtype=dtype)


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
