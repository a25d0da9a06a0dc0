"""Bounded readers of untrusted files, and quoting of untrusted values in messages.

Only regular files are opened, because a pipe or a device could block. Sizes are checked before
reading, depth and repeated names while parsing. No message repeats an untrusted value in full.
"""

from __future__ import annotations

import io
import json
import os
import re
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import Any, Literal, NoReturn

from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError

MAX_JSON_BYTES = 16 << 20
"""Maximum size of a JSON document in bytes, unless a reader allows more."""
MAX_MEMORY = 768 << 20
"""Maximum memory of a document, its text and its values in bytes, estimated from above."""
JSON_COSTS = {b",": 88, b"[": 104, b"{": 304, b":": 304}
"""Bytes of memory that the value behind each mark takes at most, with its place in a container."""
CSV_COSTS = {b",": 72, b"\n": 160, b"\r": 160}
"""The same of the cells and rows of a CSV file."""
MAX_QUOTED = 80
"""Maximum length of an untrusted value in a message, in characters."""


def open_regular(path: Path) -> io.BufferedReader:
    """Open a regular file for reading.

    Raises `InputError` if it is missing, unreadable, a folder, a pipe, a socket, a device, a file
    of the kernel, or outside the folders of `only_inside`.
    """
    check_inside(path)
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{quote_path(path)} cannot be read: {reason}.") from error
    about = os.fstat(descriptor)
    if not stat.S_ISREG(about.st_mode) or about.st_dev in _kernel_devices():
        os.close(descriptor)
        raise InputError(f"{quote_path(path)} is not a regular file: give a file on a disk.")
    return os.fdopen(descriptor, "rb")


@cache
def _kernel_devices() -> frozenset[int]:
    """Return the devices of /proc and /sys: their files are made while they are read."""
    return frozenset(os.stat(path).st_dev for path in ("/proc", "/sys") if os.path.isdir(path))


_ROOTS: ContextVar[tuple[Path, ...]] = ContextVar("roots", default=())


@contextmanager
def only_inside(sources: Iterable[Path]) -> Iterator[None]:
    """Refuse files outside the given folders, or the folders of the given files, in this context.

    A link could bring any file of the user into output that is made of data of others. In a
    cache of the Hugging Face Hub, files are links to the repository's own blobs.
    """
    folders = {p if p.is_dir() else p.parent for s in sources for p in (s, real_path(s))}
    folders = {real_path(folder) for folder in folders}
    caches = {p.parent for folder in folders for p in folder.parents if p.name == "snapshots"}
    token = _ROOTS.set((*folders, *caches))
    try:
        yield
    finally:
        _ROOTS.reset(token)


def real_path(path: Path) -> Path:
    """Return a path without links; one in a loop of links, which nothing can open, is kept."""
    return Path(os.path.realpath(path))  # Path.resolve raises RuntimeError for a loop


def check_inside(path: Path) -> None:
    """Raise `InputError` if a path is outside the folders of `only_inside`."""
    roots = _ROOTS.get()
    if roots and not any(real_path(path).is_relative_to(root) for root in roots):
        raise InputError(
            f"{quote_path(path)} is a link to a file outside of the source, which is not followed: "
            "put a copy of the file in its place."
        )


def read_bytes(path: Path, *, limit: int) -> bytes:
    """Read a regular file of at most `limit` bytes. Raises `InputError` if it is larger."""
    with open_regular(path) as file:
        try:
            data = file.read(limit + 1)
        except OSError as error:
            raise InputError(f"{quote_path(path)} cannot be read: {error.strerror}.") from error
    if len(data) > limit:
        raise InputError(f"{quote_path(path)} has more than {limit:,} bytes, the maximum.")
    return data


def read_json(path: Path, *, limit: int = MAX_JSON_BYTES) -> Any:
    """Read a JSON file of at most `limit` bytes (`parse_json`)."""
    return parse_json(read_bytes(path, limit=limit), source=quote_path(path), limit=limit)


def parse_json(data: bytes, *, source: str, limit: int = MAX_JSON_BYTES) -> Any:
    """Parse one JSON document in UTF-8, with or without a byte order mark.

    Raises `InputError`, naming `source`, if it is too large, nested too deeply or not JSON, repeats
    a name or holds half a surrogate pair. A document that would expand to more than
    `MAX_MEMORY` is refused before it is parsed.
    """
    if len(data) > limit:
        raise InputError(f"{source}: {len(data):,} bytes of JSON, more than {limit:,}.")
    check_memory(data, JSON_COSTS, source=source)
    try:
        value = json.loads(data.decode("utf-8-sig"), object_pairs_hook=unique)
        if b"\\u" in data:
            _check_surrogates(value)
    except RecursionError:
        raise InputError(f"{source} is not read: its JSON is nested too deeply.") from None
    except ValueError as error:
        raise InputError(f"{source} is not valid JSON: {quote_text(str(error))}.") from error
    return value


def check_memory(data: bytes, costs: Mapping[bytes, int], *, source: str) -> None:
    """Raise `InputError` if a document, once parsed, would take more than `MAX_MEMORY`."""
    memory = len(data) * (2 if data.isascii() else 5)
    memory += sum(cost * data.count(mark) for mark, cost in costs.items())
    if memory > MAX_MEMORY:
        raise InputError(
            f"{source}: its {len(data):,} bytes would take {memory:,} bytes of memory, more than "
            f"{MAX_MEMORY:,}, the maximum. Split it."
        )


def read_lines(
    path: Path, *, limit: int = 1 << 30, last: Literal["drop", "read"] = "drop"
) -> Iterator[tuple[int, Any]]:
    """Yield line numbers, from 1, and values of a file of JSON lines; blank lines are skipped.

    Only a line feed ends a line. A last line without one is dropped, because a crash cut it off;
    `last="read"` is for files written by hand.
    """
    name = quote_path(path)
    with open_regular(path) as file:
        if os.fstat(file.fileno()).st_size > limit:
            raise InputError(f"{name} has more than {limit:,} bytes, the maximum.")
        number = 0
        while line := file.readline(MAX_JSON_BYTES + 1):
            number += 1
            if len(line) > MAX_JSON_BYTES:
                raise InputError(f"{name}, line {number} is longer than {MAX_JSON_BYTES:,} bytes.")
            if (last == "read" or line.endswith(b"\n")) and line.strip():
                yield number, parse_json(line, source=f"{name}, line {number}")


@contextmanager
def refusing(message: str) -> Iterator[None]:
    """Turn any exception of a decoder of untrusted bytes into `InputError`."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise InputError(f"{message}: {quote_text(reason or type(error).__name__)}.") from error


def check_version(found: Any, supported: int, *, source: str) -> None:
    """Raise `InputError` unless a file has the version of its format that this program reads."""
    if type(found) is not int or found != supported:
        raise InputError(
            f"{source} has version {quote(found)}; this program reads version {supported}. Make it "
            "again, or read it by the egosim_jax that made it."
        )


def quote(value: Any) -> str:
    """Describe an untrusted value for a message, in about `MAX_QUOTED` characters or less.

    Text is quoted and cut, numbers are shown, and containers are described by type and length.
    """
    if isinstance(value, str):
        cut = value[:MAX_QUOTED]
        return ascii(cut) + ("…" if len(value) > MAX_QUOTED else "")
    if isinstance(value, bytes):
        return f"{len(value)} bytes"
    if isinstance(value, bool) or value is None or isinstance(value, float):
        return repr(value)
    if isinstance(value, int):
        return repr(value) if value.bit_length() < 256 else "a number of over 77 digits"
    if isinstance(value, (list, tuple, dict, set)):
        return f"a {type(value).__name__} of {len(value)}"
    return f"a {type(value).__name__}"


def unlike(value: float, limit: float, spec: str = ".3g") -> str:
    """Return a number beyond a limit, with as many digits as show that it is not the limit."""
    for form in (spec, *(f".{digits}g" for digits in range(3, 18))):
        if float(text := f"{value:{form}}") != limit:
            return text
    return repr(value)


def quote_text(text: str) -> str:
    """Cut and escape text for a message, without quotation marks."""
    return ascii(text[:MAX_QUOTED])[1:-1] + ("…" if len(text) > MAX_QUOTED else "")


def plot_text(text: str) -> str:
    """Return a title for matplotlib, which would read text between dollar signs as formulas.

    Its font has Latin, Greek and Cyrillic letters.
    """
    cut = text[:MAX_QUOTED] + ("…" if len(text) > MAX_QUOTED else "")
    known = (c if c < "\u0500" or c == "…" else ascii(c)[1:-1] for c in cut.replace("\n", " "))
    return printable("".join(known)).replace("$", r"\$")


def own_file(folder: Path, name: str) -> Path | None:
    """Return the path of a regular file in a folder; None if absent, or behind a link out of it."""
    path = folder / name
    if path.is_file() and real_path(path).is_relative_to(real_path(folder)):
        return path
    return None


def named(name: str, error: BaseException) -> str:
    """Return an error's message with the name of its file, once."""
    text = str(error)
    return text if text.startswith(name) else f"{name}: {text}"


def listing(items: Sequence[str], *, limit: int = 5) -> str:
    """Join findings on one line: the first `limit`, and the number of further ones."""
    more = f"; and {len(items) - limit:,} more" if len(items) > limit else ""
    return "; ".join(items[:limit]) + more


def quote_path(path: Path | str) -> str:
    """Return a path for a message, escaped if it has unprintable characters."""
    text = str(path)
    return text if text.isprintable() else ascii(text)


def unique(pairs: Sequence[tuple[Any, Any]]) -> dict[Any, Any]:
    """Return the map of pairs. Raises `ValueError` if a name is repeated."""
    found = dict(pairs)
    if len(found) != len(pairs):
        seen: set[Any] = set()
        for name, _ in pairs:
            if name in seen:
                _refuse(f"the name {quote(name)} is repeated")
            seen.add(name)
    return found


_SURROGATE = re.compile("[\ud800-\udfff]")


def _check_surrogates(value: Any) -> None:
    rest = [value]  # a stack: recursion would fail on deep documents
    while rest:
        item = rest.pop()
        if isinstance(item, str):
            if _SURROGATE.search(item):
                _refuse(f"{quote(item)} holds half a surrogate pair")
        elif isinstance(item, dict):
            rest += item.keys()
            rest += item.values()
        elif isinstance(item, list):
            rest += item


def _refuse(why: str) -> NoReturn:
    raise ValueError(why)
