"""Files that no reader may open, because they are outside of every sample."""

from __future__ import annotations

import ctypes
import functools
import os
import shutil
import tempfile
from pathlib import Path
from random import Random

import numpy as np
from PIL import Image

IN_OPEN = 0x20
STL = bytes(80) + (4).to_bytes(4, "little") + b"".join(
    np.array([0, 0, 1, *corners], "<f4").tobytes() + bytes(2)
    for corners in np.array(
        [[[0, 0, 0], [0, 1, 0], [1, 0, 0]], [[0, 0, 0], [1, 0, 0], [0, 0, 1]],
         [[0, 0, 0], [0, 0, 1], [0, 1, 0]], [[1, 0, 0], [0, 1, 0], [0, 0, 1]]], float,
    ).reshape(4, 9) * 0.01
)  # fmt: skip
"""Mesh of a tetrahedron."""
NAMES = ("secret.xml", "secret.stl", "secret.png", "secret.json", "secret.npz")


@functools.cache
def _folder() -> tempfile.TemporaryDirectory[str]:
    """Make the folder, which is removed at exit."""
    temporary = tempfile.TemporaryDirectory(prefix="outside")
    folder = Path(temporary.name)
    (folder / "secret.xml").write_text('<mujocoinclude><body name="secret"/></mujocoinclude>')
    (folder / "secret.stl").write_bytes(STL)
    (folder / "secret.json").write_text("{}")
    Image.new("RGB", (4, 4), "red").save(folder / "secret.png")
    np.savez(folder / "secret.npz", frames=np.zeros((5, 32, 48, 3), np.uint8))
    return temporary


@functools.cache
def _watch() -> int:
    """Return a descriptor of inotify, which reports each file of the folder that is opened."""
    library = ctypes.CDLL(None)
    descriptor = library.inotify_init1(os.O_NONBLOCK | os.O_CLOEXEC)
    assert library.inotify_add_watch(descriptor, os.fsencode(_folder().name), IN_OPEN) >= 0
    return descriptor


def was_opened() -> bool:
    """Return True if any process has opened a file of the folder since the last call."""
    try:
        return bool(os.read(_watch(), 1 << 16))
    except BlockingIOError:
        return False


def outside(rng: Random) -> Path:
    """Return a file of the folder, or seldom the folder."""
    folder = Path(_folder().name)
    return folder / rng.choice(NAMES) if rng.random() < 0.9 else folder


def place_special(folder: Path, rng: Random) -> None:
    """Put a pipe, an empty folder or a link in the place of something in the only subfolder.

    That folder itself may be a link: a user keeps it where there is space.
    """
    (inner,) = [path for path in folder.iterdir() if path.is_dir()]
    place = rng.choice(sorted(inner.rglob("*")))
    if place.is_dir():
        shutil.rmtree(place)
    else:
        place.unlink()
    match rng.randrange(6):
        case 0:
            os.mkfifo(place)
        case 1:
            place.mkdir()
        case 2:
            place.symlink_to(rng.choice((place.name, "gone", "/dev/zero", "/proc/self/environ")))
        case _:
            place.symlink_to(outside(rng))
