"""Arrays and texts from HDF5 files, refused before anything large or foreign is read.

An HDF5 file can refer to other files (external and virtual datasets, external and soft links) and
ask for filters that are loaded as plug-ins, which run code. Only datasets inside the file, behind
hard links, with the filters that the library itself contains are read, and only if their declared
sizes are below a limit together: a file of some kilobytes can declare gigabytes of one value. The
library runs in a child process (`isolated.py`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float64

from egosim_jax.io.bounded import open_regular, quote, quote_path, quote_text
from egosim_jax.io.untrusted.isolated import read_file
from egosim_jax.types import InputError

MAX_BYTES = 1 << 27
"""Maximum size of the datasets that are read of a file, in bytes, unpacked."""
MAX_TEXTS = 1000
"""Largest number of texts in an attribute."""
FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}
"""Filters by number that are read: those that need no plug-in."""
Shape = tuple[int | None, ...]
"""Sizes of the axes of an array; None is any size."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Hdf5Contents:
    """Arrays and string attributes read from an HDF5 file."""

    arrays: Mapping[str, Float64[np.ndarray, ...]]
    """Arrays of the file by their path in it."""
    texts: Mapping[str, tuple[str, ...]]
    """Texts of attributes of the file by name; none of an attribute that is absent."""


def read_hdf5(
    path: Path,
    arrays: Mapping[str, Shape],
    *,
    optional: Mapping[str, Shape] | None = None,
    texts: Sequence[str] = (),
) -> Hdf5Contents:
    """Read arrays of numbers and attributes of text of an HDF5 file.

    `arrays` gives the shapes of required arrays. Optional ones of another shape are omitted, as if
    they were missing. Raises `InputError` for arrays that are missing, of another shape, not in the
    file itself, too large or damaged.
    """
    return read_file(_read, path, arrays, optional or {}, texts)


def _read(
    path: Path, arrays: Mapping[str, Shape], optional: Mapping[str, Shape], texts: Sequence[str]
) -> Hdf5Contents:
    with _open(path) as file:
        given = {name: shape for name, shape in optional.items() if file.has(name, shape)}
        wanted = {**arrays, **given}
        return Hdf5Contents(
            arrays={name: file.array(name, shape) for name, shape in wanted.items()},
            texts={name: file.texts(name) for name in texts},
        )


class _Hdf5:
    """An open HDF5 file."""

    def __init__(self, file: Any, name: str):
        self._file, self.name, self._bytes = file, name, 0

    def array(self, path: str, shape: Shape) -> np.ndarray:
        """Return the numbers of a dataset of a shape as float64.

        Raises `InputError` if it is missing, of another shape or not of numbers, too large, or not
        stored in the file itself.
        """
        dataset = self._find(path, shape)
        # The library unpacks a chunk whole, also of a dataset that is smaller.
        sizes = max(math.prod(dataset.shape), math.prod(dataset.chunks or ()))
        self._bytes += sizes * max(8, dataset.dtype.itemsize)
        if self._bytes > MAX_BYTES:
            raise InputError(
                f"{self.name}: the arrays up to {path} have {self._bytes:,} bytes, more than "
                f"{MAX_BYTES:,}, the maximum of a file. Split the recording."
            )
        self._check_storage(dataset, path)
        return np.asarray(dataset[()], np.float64)

    def has(self, path: str, shape: Shape) -> bool:
        """Return True if numbers of a shape exist in the file itself."""
        try:
            self._find(path, shape)
        except InputError:
            return False
        return True

    def _find(self, path: str, shape: Shape) -> Any:
        """Return a dataset of numbers of a shape."""
        dataset = self._resolve(path)
        have: tuple[int, ...] = getattr(dataset, "shape", None) or ()
        fits = len(have) == len(shape)
        if not fits or any(w not in (None, h) for h, w in zip(have, shape, strict=True)):
            wanted = tuple("any" if size is None else size for size in shape)
            raise InputError(f"{self.name}: {path} has shape {have}; expected {wanted}.")
        if dataset.dtype.kind not in "iuf":
            raise InputError(f"{self.name}: {path} holds {dataset.dtype}; expected numbers.")
        return dataset

    def texts(self, name: str) -> tuple[str, ...]:
        """Return the texts of an attribute of the file, none if it is absent or not text."""
        value = self._file.attrs.get(name)
        values = [value] if isinstance(value, (str, bytes)) else value
        if values is None or np.size(values) > MAX_TEXTS or np.ndim(values) != 1:
            return ()
        texts = (v.decode("utf-8", "replace") if isinstance(v, bytes) else v for v in values)
        return tuple(text for text in texts if isinstance(text, str))

    def _resolve(self, path: str) -> Any:
        import h5py

        item: Any = self._file
        for part in path.split("/"):
            link = item.get(part, getlink=True) if isinstance(item, h5py.Group) else None
            if not isinstance(link, h5py.HardLink):
                kind = "missing" if link is None else f"a {type(link).__name__}, which is not read"
                raise InputError(f"{self.name}: {path} is {kind}; expected data in the file.")
            item = item[part]
        return item

    def _check_storage(self, dataset: Any, path: str) -> None:
        plist = dataset.id.get_create_plist()
        filters = [plist.get_filter(index)[0] for index in range(plist.get_nfilters())]
        foreign = [number for number in filters if number not in FILTERS]
        if foreign or dataset.external is not None or dataset.is_virtual:
            kind = f"packed by filter {quote(foreign[0])}" if foreign else "stored in another file"
            raise InputError(
                f"{self.name}: {path} is {kind}: only data in the file itself is read, packed by "
                f"{', '.join(FILTERS.values())} or not at all. Write it again with h5repack."
            )


@contextmanager
def _open(path: Path) -> Iterator[_Hdf5]:
    """Open an HDF5 file; what the library raises about damaged contents becomes `InputError`."""
    import h5py

    name = quote_path(path)
    with open_regular(path) as file:
        try:
            with h5py.File(file, "r") as opened:
                yield _Hdf5(opened, name)
        except InputError:
            raise
        except (OSError, KeyError, RuntimeError, ValueError, TypeError, OverflowError) as error:
            raise InputError(
                f"{name} is not a readable HDF5 file: {quote_text(str(error))}."
            ) from error
