"""Atomic writes: complete or absent, never through a link, never by two writers at once.

A file or folder has an unpredictable hidden name until it is on disk; then it is renamed. A crash
leaves at most this hidden file or folder, which the next write of the same name removes.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import json
import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from egosim_jax.io.bounded import quote_path, read_json
from egosim_jax.runtime import interrupts
from egosim_jax.types import InputError

TEMPORARY = ".tmp"
"""Middle part of every temporary name."""
LOCK = ".lock"
"""Name of the file that a process locks while it writes to a folder."""
PART = ".part"
"""Suffix of an incomplete large file that is written in pieces."""
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2
_NEW = os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Create a temporary file to write to; rename it to `path` when the block ends.

    The temporary file is new and empty, in the folder of `path` and with its suffix. Folders are
    created as needed. The file is on disk before it is renamed. An error removes it and leaves an
    older `path` unchanged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(path)
    temporary = _temporary_name(path)
    descriptor = os.open(temporary, _NEW, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield temporary
        sync(temporary)
        temporary.replace(path)
        sync(path.parent)
    finally:
        os.close(descriptor)
        temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Create a temporary folder to write to; rename it to `path` when the block ends.

    An older `path` is exchanged for it in one step and then removed. An error leaves it unchanged.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_stale(path)
    temporary = _temporary_name(path)
    temporary.mkdir()
    descriptor = os.open(temporary, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield temporary
        for inner in temporary.rglob("*"):
            if not inner.is_symlink():
                sync(inner)
        sync(temporary)
        _put_in_place(temporary, path)
        sync(path.parent)
    finally:
        os.close(descriptor)
        shutil.rmtree(temporary, ignore_errors=True)


def check_replaceable(path: Path, names: re.Pattern[str], *, description: str) -> Path:
    """Return the resolved path of a folder that can be replaced without losing other files.

    Raises `InputError` unless the path is free, an empty folder or an earlier folder of the same
    kind: with a JSON `description` that records SHA-256, and with only files of these `names`.
    """
    path = Path(os.path.realpath(path))
    if not os.path.lexists(path):
        return path
    if not path.is_dir():
        found = "is a file"
    elif not any(path.iterdir()):
        return path
    elif foreign := next(
        (
            file
            for file in path.rglob("*")
            if (file.is_symlink() or not file.is_dir())
            and not names.fullmatch(str(file.relative_to(path)))
        ),
        None,
    ):
        found = f"holds {quote_path(foreign.relative_to(path))}"
    elif _is_description(path / description):
        return path
    else:
        found = f"has no {description} of this program"
    raise InputError(
        f"{quote_path(path)} exists and {found}: only an empty folder, or one of the same kind, is "
        "replaced. Choose another path, or remove it first."
    )


def _is_description(path: Path) -> bool:
    try:
        written = read_json(path)
    except InputError:
        return False
    return isinstance(written, dict) and "sha256" in written


def append_line(path: Path, record: Mapping[str, Any]) -> None:
    """Append one JSON object as a line, on disk when this returns.

    An incomplete last line, left by a crash, is removed first.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    flags = os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(path, flags, 0o666)
    try:
        size = _end_of_lines(descriptor)
        data = json.dumps(record).encode() + b"\n"
        if os.write(descriptor, data) < len(data):
            os.ftruncate(descriptor, size)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _end_of_lines(descriptor: int) -> int:
    """Truncate a file after its last line feed and return its size."""
    size = end = os.fstat(descriptor).st_size
    while end:
        start = max(0, end - (1 << 16))
        feed = os.pread(descriptor, end - start, start).rfind(b"\n")
        if feed >= 0:
            end = start + feed + 1
            break
        end = start
    if end < size:
        os.ftruncate(descriptor, end)
    return end


def sync(path: Path) -> None:
    """Wait until a file, or the directory entries of a folder, are on disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


_held: dict[Path, tuple[int, int]] = {}
"""Descriptor and number of holders, in this process, of each locked folder."""


@contextmanager
def lock_folder(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Keep other processes from writing to a folder, which is created if needed.

    The same process may lock a folder again. Raises `InputError` naming the process that holds the
    lock, or waits for it with `wait`.
    """
    hold_folder(folder, wait=wait)
    try:
        yield
    finally:
        _release(folder.resolve())


def hold_folder(folder: Path, *, wait: bool = False) -> None:
    """Lock a folder (`lock_folder`) until the process ends."""
    folder.mkdir(parents=True, exist_ok=True)
    key = folder.resolve()
    if not wait:  # a process waits only for a cache, which is no run
        interrupts.resume_from(key)
    if key in _held:
        descriptor, holders = _held[key]
        _held[key] = descriptor, holders + 1
        return
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
    descriptor = os.open(key / LOCK, flags, 0o666)
    try:
        fcntl.lockf(descriptor, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        holder = os.pread(descriptor, 20, 0).decode("ascii", "replace").strip() or "unknown"
        os.close(descriptor)
        if error.errno not in (errno.EACCES, errno.EAGAIN):
            raise
        raise InputError(
            f"{folder} is in use by another process (PID {holder}): one process at a time can "
            f"write to a folder. Wait for it, or choose another folder. (--out)"
        ) from error
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    _held[key] = descriptor, 1


def _release(key: Path) -> None:
    descriptor, holders = _held.pop(key)
    if holders > 1:
        _held[key] = descriptor, holders - 1
    else:
        os.close(descriptor)


def _temporary_name(path: Path) -> Path:
    stem = path.stem.encode()[:120].decode("utf-8", "ignore")
    return path.with_name(f".{stem}.{secrets.token_hex(8)}{TEMPORARY}{path.suffix}")


def _remove_stale(path: Path) -> None:
    """Remove temporary files of `path` that nobody locks, because their writers ended."""
    stem = path.stem.encode()[:120].decode("utf-8", "ignore")
    start, end = f".{stem}.", f"{TEMPORARY}{path.suffix}"
    with os.scandir(path.parent) as entries:
        names = [entry.name for entry in entries]
    for name in names:
        token = name[len(start) : -len(end)]
        if not (name.startswith(start) and name.endswith(end) and len(token) == 16):
            continue
        stale = path.with_name(name)
        with suppress(OSError):
            descriptor = os.open(stale, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if stale.is_dir():
                    shutil.rmtree(stale)
                else:
                    stale.unlink()
            finally:
                os.close(descriptor)


def _put_in_place(new: Path, path: Path) -> None:
    """Rename a folder to `path`; if that exists, exchange both, so that `new` is the older one."""
    if not path.exists():
        new.rename(path)
        return
    if sys.platform == "linux":
        exchange = ctypes.CDLL(None, use_errno=True).renameat2
        if not exchange(
            _AT_FDCWD, os.fsencode(new), _AT_FDCWD, os.fsencode(path), _RENAME_EXCHANGE
        ):
            return
        code = ctypes.get_errno()
        if code not in (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP):
            raise OSError(code, os.strerror(code), str(path))
    # No exchange on this system: for a moment, `path` does not exist.
    aside = _temporary_name(path)
    path.rename(aside)
    new.rename(path)
    aside.rename(new)
