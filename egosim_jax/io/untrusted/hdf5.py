"""Arrays and texts from HDF5 files, refused before anything large or foreign is read.

An HDF5 file can refer to other files (external and virtual datasets, external and soft links) and
ask for filters that are loaded as plug-ins, which run code. Only datasets inside the file, behind
hard links, with the filters that the library itself contains are read, and only if their declared
size is below a limit.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.bounded import open_regular, quote, quote_path, quote_text
from egosim_jax.types import InputError

MAX_FILE_BYTES = 1 << 31
"""Largest file in bytes."""
MAX_ARRAY_BYTES = 1 << 27
"""Largest dataset in bytes, unpacked."""
MAX_TEXTS = 1000
"""Largest number of texts in an attribute."""
FILTERS = {1: "deflate", 2: "shuffle", 3: "fletcher32", 32000: "lzf"}
"""Filters by number that are read: those that need no plug-in."""


class Hdf5:
    """An open HDF5 file."""

    def __init__(self, file: Any, name: str):
        self._file, self.name = file, name

    def array(self, path: str, shape: tuple[int | None, ...]) -> np.ndarray:
        """Return the numbers of a dataset of a shape, in which None is any size, as float64.

        Raises `InputError` if it is missing, of another shape or not of numbers, too large, or not
        stored in the file itself.
        """
        dataset = self._resolve(path)
        have: tuple[int, ...] = getattr(dataset, "shape", None) or ()
        fits = len(have) == len(shape)
        if not fits or any(w not in (None, h) for h, w in zip(have, shape, strict=True)):
            wanted = tuple("any" if size is None else size for size in shape)
            raise InputError(f"{self.name}: {path} has shape {have}; expected {wanted}.")
        if dataset.dtype.kind not in "iuf":
            raise InputError(f"{self.name}: {path} holds {dataset.dtype}; expected numbers.")
        size = math.prod(have) * max(8, dataset.dtype.itemsize)
        if size > MAX_ARRAY_BYTES:
            raise InputError(
                f"{self.name}: {path} has {size:,} bytes, more than {MAX_ARRAY_BYTES:,}, the most."
            )
        self._check_storage(dataset, path)
        return np.asarray(dataset[()], np.float64)

    def has(self, path: str) -> bool:
        """Return True if a group or dataset exists in the file itself."""
        try:
            self._resolve(path)
        except InputError:
            return False
        return True

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
def open_hdf5(path: Path) -> Iterator[Hdf5]:
    """Open an HDF5 file; what the library raises about damaged contents becomes `InputError`."""
    import h5py

    name = quote_path(path)
    with open_regular(path) as file:
        size = file.seek(0, 2)
        if size > MAX_FILE_BYTES:
            raise InputError(f"{name} has {size:,} bytes, more than {MAX_FILE_BYTES:,}, the most.")
        try:
            with h5py.File(file, "r") as opened:
                yield Hdf5(opened, name)
        except InputError:
            raise
        except (OSError, KeyError, RuntimeError, ValueError, TypeError) as error:
            raise InputError(
                f"{name} is not a readable HDF5 file: {quote_text(str(error))}."
            ) from error
