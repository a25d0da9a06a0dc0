"""Read the entries of uncompressed zip archives as `torch.save` writes them.

Our own code, because Python's `zipfile` builds an object for every entry that the directory
declares and copies contents. This module checks counts and sizes first and returns memory-mapped
bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple

from egosim_jax.io.bounded import quote
from egosim_jax.io.mapped import RefusedError

MAX_ENTRIES = 1 << 17
"""Maximum number of entries in an archive."""
END, END64_LOCATOR = struct.Struct("<10xH4xI2x"), struct.Struct("<8xQ4x")
END64, LOCAL = struct.Struct("<32xQ8xQ"), struct.Struct("<26xHH")
CENTRAL = struct.Struct("<8xHH8xIIHHH8xI")
"""Fields of the zip records: end of directory (32 and 64 bits), local and central headers."""
STORED, ZIP64 = 0, 0xFFFFFFFF
"""Method of uncompressed entries, and the 32-bit value that refers to a 64-bit number."""


class Entry(NamedTuple):
    """Central directory record of an entry."""

    name: str
    flags: int
    method: int
    size: int
    """Bytes of the content."""
    offset: int
    """Byte offset of the local header."""


def read_entries(data: memoryview) -> dict[str, memoryview]:
    """Return the content of every entry by name, without the top-level folder.

    Raises `RefusedError` if this is not a valid uncompressed little-endian archive.
    """
    if bytes(data[:2]) != b"PK":
        raise RefusedError(
            "not a zip archive; files from before torch 1.6 and bare pickles are not supported"
        )
    found: dict[str, memoryview] = {}
    total = 0
    for entry in _directory(data):
        total += entry.size
        if total > len(data):
            raise RefusedError("its entries exceed the file")
        parts = entry.name.split("/")
        if ".." in parts or entry.name.startswith("/") or "\\" in entry.name:
            raise RefusedError(f"entry {quote(entry.name)} has a path outside the archive")
        if entry.method != STORED or entry.flags & 1:
            raise RefusedError(f"entry {quote(entry.name)} is compressed or encrypted")
        name = "/".join(parts[1:])
        if name in found:
            raise RefusedError(f"duplicate entry {quote(entry.name)}")
        found[name] = _stored(entry, data)
    if found.get("byteorder", b"little") != b"little":
        raise RefusedError("its byte order is big-endian")
    if "data.pkl" not in found:
        raise RefusedError("it has no data.pkl")
    return found


def _directory(data: memoryview) -> Iterator[Entry]:
    """Yield the records of the central directory, at most `MAX_ENTRIES`."""
    tail = max(0, len(data) - END.size - 0xFFFF)
    end = bytes(data[tail:]).rfind(b"PK\5\6") + tail
    if end < tail or end + END.size > len(data):
        raise RefusedError("the end of the archive is missing: the file is truncated")
    count, place = END.unpack_from(data, end)
    if end >= END64_LOCATOR.size and data[end - END64_LOCATOR.size :][:4] == b"PK\6\7":
        (end64,) = END64_LOCATOR.unpack_from(data, end - END64_LOCATOR.size)
        if end64 + END64.size > len(data) or data[end64 : end64 + 4] != b"PK\6\6":
            raise RefusedError("its 64-bit directory is not at the declared offset")
        count, place = END64.unpack_from(data, end64)
    if count > MAX_ENTRIES:
        raise RefusedError(f"it has {count:,} entries; the limit is {MAX_ENTRIES:,}")
    for _ in range(count):
        if place + CENTRAL.size > len(data) or data[place : place + 4] != b"PK\1\2":
            raise RefusedError("its directory is damaged")
        flags, method, packed, size, name, extra, comment, offset = CENTRAL.unpack_from(data, place)
        names = place + CENTRAL.size
        after = names + name + extra + comment
        if after > len(data):
            raise RefusedError("its directory is damaged")
        numbers = _zip64_numbers(bytes(data[names + name : names + name + extra]))
        size = next(numbers, size) if size == ZIP64 else size
        packed = next(numbers, packed) if packed == ZIP64 else packed
        offset = next(numbers, offset) if offset == ZIP64 else offset
        text = bytes(data[names : names + name]).decode("utf-8", "replace")
        if packed != size and method == STORED:
            raise RefusedError(f"entry {quote(text)} has two different sizes")
        yield Entry(text, flags, method, size, offset)
        place = after


def _zip64_numbers(extra: bytes) -> Iterator[int]:
    """Yield the 64-bit numbers in the extra field of an entry."""
    while len(extra) >= 4:
        kind, size = struct.unpack_from("<HH", extra)
        if kind == 1:
            yield from (number for (number,) in struct.iter_unpack("<Q", extra[4 : 4 + size & ~7]))
        extra = extra[4 + size :]


def _stored(entry: Entry, data: memoryview) -> memoryview:
    """Return the content of an entry, after its local header."""
    if entry.offset + LOCAL.size > len(data) or data[entry.offset :][:4] != b"PK\3\4":
        raise RefusedError(f"entry {quote(entry.name)} has no local header at the declared offset")
    name, extra = LOCAL.unpack_from(data, entry.offset)
    begin = entry.offset + LOCAL.size + name + extra
    if begin + entry.size > len(data):
        raise RefusedError(f"entry {quote(entry.name)} extends beyond the end of the file")
    return data[begin : begin + entry.size]
