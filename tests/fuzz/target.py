"""Targets of the fuzzer: a valid sample of a format, our reader and, if any, another one."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Mutate = Callable[[bytes, random.Random], bytes]
"""Change a file's bytes."""
Rearrange = Callable[[Path, random.Random], None]
"""Change a sample's folder."""


@dataclass(frozen=True, kw_only=True)
class Target:
    """One format, and how it is read.

    A case passes if `read` raises `InputError` with a short message, or gives what it gave of the
    sample, or, where the format has no checksum of ours, gives what `reference` gives of the
    changed file. Everything else is a failure: another exception, another result, more than 1 GiB
    or 20 s of processor time, or an opened file of `outside.py`.
    """

    name: str
    """As on the command line."""
    make: Callable[[Path], None]
    """Write a valid sample, the same at every call, into an empty folder."""
    read: Callable[[Path], Any]
    """Read the sample in that folder; gives plain data and arrays, compared by their values."""
    files: tuple[str, ...]
    """Globs, below the folder, of the files that are changed one at a time."""
    sealed: bool = False
    """The format carries our checksum: every change that alters the result must be refused."""
    reference: Callable[[Path], Any] | None = None
    """Independent reader, whose result of a changed file ours must equal.

    Without one, a changed file that is read must give the sample's result, unless `lossy`.
    """
    lossy: str = ""
    """Reason that a changed file may be read with another result unnoticed; else empty."""
    mutations: tuple[Mutate, ...] = ()
    """Mutations that know the format, besides mutations of bytes."""
    rearrangements: tuple[Rearrange, ...] = ()
    """Changes to the sample's folder that are more than other bytes of one file."""


def pixels(*shape: int) -> np.ndarray:
    """Draw noise for a sample, the same at every call."""
    return np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
