"""Caches of native code. A loaded file runs, so only its user may have written it.

A cache is a folder `~/.cache/egosim_jax/NAME` (`XDG_CACHE_HOME/egosim_jax/NAME` if that is set to
an absolute path) that belongs to the user, that nobody else can read or write and that is no link.
`PrivateCache` opens a file first, and then checks owner, mode, links and checksum of the open file.
A bad file causes a warning and is made again. `private_folder` is for a library that reads and
writes its files itself.
"""

from __future__ import annotations

import grp
import hashlib
import os
import pwd
import re
import stat
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from egosim_jax.io.atomic import TEMPORARY, atomic_write

MAGIC = b"egosim1\n"
_HEAD = len(MAGIC) + hashlib.sha256().digest_size
_OTHERS = stat.S_IRWXG | stat.S_IRWXO


def cache_folder() -> Path:
    """Return the folder of all caches: compiled programs, fetched weights.

    As the XDG specification asks, an empty or relative `XDG_CACHE_HOME` counts as not set.
    """
    home = Path(os.environ.get("XDG_CACHE_HOME", ""))
    return (home if home.is_absolute() else Path.home() / ".cache") / "egosim_jax"


@dataclass(frozen=True)
class PrivateCache:
    """Cache of files, each with its checksum, in a folder that only its user can write to."""

    folder: Path
    most: int
    """Maximum number of files; those that were used last are kept."""

    @classmethod
    def open(cls, name: str, *, most: int) -> PrivateCache | None:
        """Open the cache of a name; None, with a warning, if others could write to it."""
        folder = _open_folder(name, _problem)
        return None if folder is None else cls(folder, most)

    def get(self, name: str) -> bytes | None:
        """Read a file; None if it is absent or, with a warning, not trusted."""
        path = self.folder / name
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        except FileNotFoundError:
            return None
        except OSError as error:
            return _refused(path, str(error.strerror))
        with os.fdopen(descriptor, "rb") as file:
            about = os.fstat(descriptor)
            if (problem := _origin_problem(about)) is not None:
                return _refused(path, problem)
            if about.st_mode & _OTHERS:
                mode = stat.S_IMODE(about.st_mode)
                return _refused(path, f"others may use it (mode {mode:o}, not 600)")
            data = file.read()
            payload = memoryview(data)[_HEAD:]
            if data[:_HEAD] != MAGIC + hashlib.sha256(payload).digest():
                return _refused(path, "it is damaged: its checksum is of other bytes")
            os.utime(descriptor)
            return data[_HEAD:]

    def put(self, name: str, data: bytes) -> None:
        """Write a file and remove those that were used longest ago; failures only warn."""
        if not re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9._-]*", name):
            raise ValueError(f"not a file name: {name[:80]!r}")
        path = self.folder / name
        try:
            with atomic_write(path) as temporary:
                temporary.chmod(0o600)
                with temporary.open("wb") as file:
                    file.write(MAGIC + hashlib.sha256(data).digest())
                    file.write(data)
            _forget(self.folder, self.most)
        except OSError as error:
            warnings.warn(f"{path} was not kept: {error.strerror}", stacklevel=2)


def private_folder(name: str, *, most: int) -> Path | None:
    """Return the folder of a cache that a library reads and writes, with its `most` newest files.

    None, with a warning, if others could write to it or wrote a file in it. The library may give
    its files any mode: nobody else gets past the folder's.
    """
    folder = _open_folder(name, lambda folder: _problem(folder) or _foreign(folder))
    if folder is not None:
        with suppress(OSError):  # another process removes files, too
            _forget(folder, most)
    return folder


def _open_folder(name: str, check: Callable[[Path], str | None]) -> Path | None:
    folder = cache_folder() / name
    try:
        folder.parent.parent.mkdir(parents=True, exist_ok=True)
        for own in (folder.parent, folder):
            own.mkdir(mode=0o700, exist_ok=True)
        problem = check(folder)
    except (OSError, RuntimeError) as error:  # RuntimeError: no home
        problem = str(error)
    if problem is None:
        return folder
    warnings.warn(f"{folder} is not used, so programs are compiled again: {problem}", stacklevel=4)
    return None


def _forget(folder: Path, most: int) -> None:
    """Remove the files of a folder that were used longest ago.

    Where reading a file does not change its time, those that were written longest ago.
    """
    found = {}
    with os.scandir(folder) as entries:
        for entry in entries:
            # Another process may rename or remove a file at any time.
            with suppress(FileNotFoundError):
                if not entry.is_dir(follow_symlinks=False):
                    found[entry.name] = entry.stat(follow_symlinks=False)
    used = {name: max(times.st_atime, times.st_mtime) for name, times in found.items()}
    names = [name for name in sorted(used, key=used.__getitem__) if TEMPORARY not in name]
    for name in names[:-most]:
        (folder / name).unlink(missing_ok=True)


def _refused(path: Path, problem: str) -> None:
    warnings.warn(f"{path} is not used but made again: {problem}", stacklevel=3)


def _origin_problem(found: os.stat_result) -> str | None:
    """Return the reason to think that another user wrote a file, or None."""
    if not stat.S_ISREG(found.st_mode):
        return "it is not a regular file"
    if found.st_uid != os.getuid():
        return f"it belongs to user {found.st_uid}, not to {os.getuid()}"
    if found.st_nlink != 1:
        return f"it has {found.st_nlink} names"
    return None


def _foreign(folder: Path) -> str | None:
    """Return the first file below a folder that another user may have written, and why."""
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):  # another process removed it
            found = path.lstat()
            own_folder = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
            if not own_folder and (problem := _origin_problem(found)) is not None:
                return f"{problem}: {path}. Remove it."
    return None


def _problem(folder: Path) -> str | None:
    """Return the reason not to trust a folder; None if only its user can write to it."""
    for own in (folder, folder.parent):
        found = own.lstat()
        if not stat.S_ISDIR(found.st_mode):
            return f"{own} is a link or no folder. Remove it."
        if found.st_uid != os.getuid():
            return f"{own} belongs to user {found.st_uid}, not to {os.getuid()}. Remove it."
    if mode := stat.S_IMODE(folder.lstat().st_mode) & _OTHERS:
        return f"others may use it (mode 7{mode:02o}, not 700). Remove it."
    for above in folder.resolve().parents:
        found = above.stat()
        others = stat.S_IWOTH if _own_group(found.st_gid) else stat.S_IWOTH | stat.S_IWGRP
        writable = found.st_mode & others and not found.st_mode & stat.S_ISVTX
        if found.st_uid not in (0, os.getuid()) or writable:
            return f"others may rename it, because they may write to {above}. (XDG_CACHE_HOME)"
    return None


def _own_group(group: int) -> bool:
    """Return whether a group is the user's private one, which has the user's name."""
    with suppress(KeyError):
        return grp.getgrgid(group).gr_name == pwd.getpwuid(os.getuid()).pw_name
    return False
