"""Readers of datasets and captures: each finds recordings and reads them one by one.

A reader is a frozen dataclass with the path of the data and the user's options. `find` lists the
entries without reading them, so that an interrupted import resumes quickly. `Entry.read` checks
everything and raises `InputError` for an unusable recording; the import continues with the others.
Each module documents its format's cameras, units, joint order and pixel centers.

- Reader, Entry: the protocol of a reader, and a recording that it found
- make_id, natural_order: id from path parts, sort key of numbered names
- inside, find_files, numbered, require: paths, files and optional libraries
- make_rate, check_one_camera: a frame rate, and one focal length, for all frames
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import quote
from egosim_jax.runtime.registry import Registry
from egosim_jax.types import InputError

NOTE = "used"
"""Entry of the provenance that says which part of its source a recording is; it is printed."""


@dataclass(frozen=True, kw_only=True)
class Entry:
    """A recording that a reader found, and the function that reads it."""

    recording_id: str
    """Unique id, which names the folder."""
    read: Callable[[Path], Recording]
    """Function that reads it, given a folder for files that it has to write."""
    source: Path
    """File or folder that it is read from."""
    options: Mapping[str, str] = field(default_factory=dict)
    """The user's options that its content depends on, and their values."""


@runtime_checkable
class Reader(Protocol):
    """Reader of one dataset or format."""

    dataset: ClassVar[str]
    """Name of the dataset on the command line."""

    def find(self) -> Iterable[Entry]:
        """List the recordings. Raises `InputError` if the source is not such a dataset."""
        ...


READERS: Registry[type[Reader]] = Registry("reader", "--reader", "egosim_jax.readers")
"""Readers of other packages; our readers are subcommands of `egosim data import`."""


def make_id(parts: Sequence[str]) -> str:
    """Return a valid id made of names, joined by underscores."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", "_".join(parts)).lstrip(".")[-200:]


def inside(root: Path, name: object, *, what: str) -> Path:
    """Return the path that an untrusted file names. Raises `InputError` if it leaves `root`."""
    path = Path(name) if isinstance(name, str) and name and "\0" not in name else None
    if path is None or path.is_absolute() or ".." in path.parts:
        raise InputError(
            f"{what} is {quote(name)}: it must be a path inside the dataset's folder, without '..'."
        )
    return root / path


def numbered(paths: Iterable[Path]) -> dict[int, Path]:
    """Return the files whose names end with a number after an underscore, or are one."""
    ends = {path.stem.rpartition("_")[2]: path for path in paths}
    return {int(digits): path for digits, path in ends.items() if digits.isdecimal()}


def make_rate(fps: Any, *, what: str = "--fps") -> Fraction:
    """Return a given frame rate as a fraction. Raises `InputError` if it is out of range."""
    if isinstance(fps, bool) or not isinstance(fps, (int, float)) or not 0 < fps <= 1000:
        raise InputError(f"{what} is {quote(fps)}: it must be above 0 and at most 1000.")
    return Fraction(fps).limit_denominator(1001) or Fraction(fps)


def check_one_camera(focal_px: Float[np.ndarray, " f"], name: str, *, most: float) -> float:
    """Return the relative change of the focal lengths of frames.

    Raises `InputError` above `most`, because a recording has one camera.
    """
    change = float(np.ptp(focal_px) / max(float(np.median(focal_px)), 1e-9))
    if change > most:
        raise InputError(
            f"{name}: the focal length changes by {change:.1%}, more than {most:.0%}: one camera "
            "is needed for all frames. Lock the focus, or split the capture."
        )
    return change


def require(module: str) -> None:
    """Raise `InputError` unless an optional library is installed."""
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise InputError(
            f"Reading this dataset needs {module}, which is not installed: "
            "pip install 'egosim-jax[video]'."
        )


def find_files(source: Path, pattern: str, *, kind: str) -> list[Path]:
    """Return the matching files below a folder, or the file itself, in natural order."""
    found = [source] if source.is_file() else sorted(source.rglob(pattern), key=natural_order)
    if not found:
        raise InputError(
            f"{source} holds no {kind}: it must be a folder with {pattern} at any depth, or one "
            "such file."
        )
    return found


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Return a sort key that orders numbers in names by value."""
    parts = re.split(r"(\d+)", str(path))
    return [(int(p.isdecimal()), int(p[:18]) if p.isdecimal() else 0, p) for p in parts]
