"""Files that a recording's description names: paths and measured depth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egosim_jax.io.bounded import quote, quote_text
from egosim_jax.types import InputError

DESCRIPTION = "recording.json"
"""File name of the description in a recording's folder."""


@dataclass(frozen=True, kw_only=True)
class DepthFiles:
    """Measured depth: one file per frame, with the image's aspect ratio but maybe another size."""

    paths: tuple[Path | None, ...]
    """16-bit PNG or npy of each frame; None for a frame without depth."""
    unit_m: float
    """Length of one unit of the files in meters: 0.001 for millimeters."""


def stored_path(path: Path, folder: Path) -> str:
    """Return a path as a description stores it: relative if it is inside the folder."""
    path = path.resolve()
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)


def found_path(text: Any, folder: Path) -> Path:
    """Return the path of a file that a description names. Raises `InputError`."""
    if not isinstance(text, str) or not text or "\0" in text:
        raise InputError(f"{DESCRIPTION}: {quote(text)} is not a path.")
    path = Path(text)
    if ".." in path.parts:
        raise InputError(
            f"{DESCRIPTION}: the path {quote(text)} contains '..': paths are relative to the "
            "folder and inside it, or absolute."
        )
    return folder / path


def found_depth(written: Any, folder: Path) -> DepthFiles | None:
    """Return the measured depth that a description names, or None. Raises `InputError`."""
    if written is None:
        return None
    paths = written.get("paths") if isinstance(written, dict) else None
    unit = written.get("unit_m") if isinstance(written, dict) else None
    if not isinstance(paths, list) or not isinstance(unit, float):
        raise InputError(f"{DESCRIPTION}: depth is {quote_text(str(written))}.")
    listed = tuple(None if path is None else found_path(path, folder) for path in paths)
    return DepthFiles(paths=listed, unit_m=unit)
