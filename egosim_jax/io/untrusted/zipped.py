"""Entries of zip archives, bounded by what they expand to before any of it is allocated.

Our own reader, for every zip that is opened: Python's `zipfile` builds an object for each entry
that a directory declares, and unpacks a chunk whole, whatever size was declared. Entries that share
bytes are refused, so stored entries together are never larger than their file.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from io import BufferedIOBase
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from egosim_jax.io.bounded import open_regular, quote

MAX_ENTRIES = 1 << 17
MAX_UNPACKED_BYTES = 1 << 28
"""Maximum size of a compressed entry in bytes, unpacked."""
END, END64_LOCATOR = struct.Struct("<10xH4xI2x"), struct.Struct("<8xQ4x")
END64, LOCAL = struct.Struct("<32xQ8xQ"), struct.Struct("<26xHH")
CENTRAL, FIELD = struct.Struct("<8xHH4xIIIHHH8xI"), struct.Struct("<HH")
"""Layouts of the end records (32 and 64 bits), local and central headers and extra fields."""
STORED, DEFLATED, ZIP64, ZIP64_KIND = 0, 8, 0xFFFFFFFF, 1
"""Methods of entries; the 32-bit value that refers to a 64-bit number, and that number's field."""

Read = Callable[[int, int], bytes]
"""Function that reads a number of bytes at an offset; fewer at the end of the archive."""


class Entry(NamedTuple):
    """An entry of an archive."""

    name: str
    begin: int
    packed: int
    """Bytes of the content in the archive."""
    size: int
    """Bytes of the content, unpacked."""
    crc: int
    is_stored: bool
    """True if the content is not compressed."""


class Archive:
    """An archive whose directory was checked."""

    def __init__(self, read: Read, size: int, *, max_entries: int = MAX_ENTRIES):
        """Read the directory of an archive of `size` bytes.

        Raises `ValueError` if it is damaged, too long, or has entries that are encrypted, overlap,
        share a name or are packed by another method than deflate.
        """
        self._read_at, entries = read, dict[str, Entry]()
        spans = []
        for entry, header in _directory(read, size, max_entries):
            if entry.name in entries:
                raise ValueError(f"duplicate entry {quote(entry.name)}")
            entries[entry.name] = entry
            spans.append((header, entry.begin + entry.packed, entry.name))
        spans.sort()
        for (_, end, _), (begin, _, name) in pairwise(spans):
            if begin < end:
                raise ValueError(f"entry {quote(name)} overlaps another one")
        self.entries: Mapping[str, Entry] = entries

    def read(self, name: str, *, limit: int = MAX_UNPACKED_BYTES) -> bytes:
        """Return the content of an entry. Raises `ValueError` if it is damaged or over `limit`."""
        entry = self.entries[name]
        if entry.size > limit or (entry.packed > limit and not entry.is_stored):
            raise ValueError(f"{quote(name)} has {entry.size:,} bytes, more than {limit:,}")
        data = self._read_at(entry.begin, entry.packed)
        if not entry.is_stored:
            unpacker = zlib.decompressobj(-zlib.MAX_WBITS)
            try:
                data = unpacker.decompress(data, entry.size + 1)
            except zlib.error as error:
                raise ValueError(f"{quote(name)} is damaged: {error}") from error
        if len(data) != entry.size or zlib.crc32(data) != entry.crc:
            raise ValueError(f"{quote(name)} does not have the size or the CRC-32 of the directory")
        return data


@contextmanager
def open_archive(path: Path, *, max_entries: int = MAX_ENTRIES) -> Iterator[Archive]:
    """Open a zip file. Raises `InputError` if it cannot be opened, `ValueError` if damaged."""
    with open_regular(path) as file:
        yield from_file(file, max_entries=max_entries)


def from_file(file: BufferedIOBase, *, max_entries: int = MAX_ENTRIES) -> Archive:
    """Return the archive of an open file. Raises `ValueError` if it is damaged."""

    def read(at: int, count: int) -> bytes:
        file.seek(at)
        return file.read(count)

    return Archive(read, file.seek(0, 2), max_entries=max_entries)


def _directory(read: Read, size: int, max_entries: int) -> Iterator[tuple[Entry, int]]:
    """Yield the entries of the central directory and the offsets of their local headers."""
    tail = max(0, size - END.size - 0xFFFF)
    end = read(tail, size - tail).rfind(b"PK\5\6") + tail
    if end < tail or end + END.size > size:
        raise ValueError("the end of the archive is missing: the file is truncated, or no zip")
    count, place = END.unpack(read(end, END.size))
    locator = read(max(0, end - END64_LOCATOR.size), END64_LOCATOR.size)
    if locator[:4] == b"PK\6\7" and len(locator) == END64_LOCATOR.size:
        (end64,) = END64_LOCATOR.unpack(locator)
        record = read(end64, END64.size) if end64 < size else b""
        if len(record) != END64.size or record[:4] != b"PK\6\6":
            raise ValueError("its 64-bit directory is not at the declared offset")
        count, place = END64.unpack(record)
    if count > max_entries:
        raise ValueError(f"it has {count:,} entries; the limit is {max_entries:,}")
    for _ in range(count):
        record = read(place, CENTRAL.size) if place < size else b""
        if len(record) != CENTRAL.size or record[:4] != b"PK\1\2":
            raise ValueError("its directory is damaged")
        flags, method, crc, packed, full, named, extra, comment, header = CENTRAL.unpack(record)
        rest = read(place + CENTRAL.size, named + extra)
        place += CENTRAL.size + named + extra + comment
        if len(rest) != named + extra or place > size:
            raise ValueError("its directory is damaged")
        full, packed, header = _widen((full, packed, header), rest[named:])
        name = rest[:named].decode("utf-8" if flags & 0x800 else "cp437", "replace")
        if method not in (STORED, DEFLATED) or flags & 1:
            raise ValueError(f"entry {quote(name)} is encrypted, or compressed by another method")
        if packed != full and method == STORED:
            raise ValueError(f"entry {quote(name)} has two different sizes")
        local = read(header, LOCAL.size) if header < size else b""
        if len(local) != LOCAL.size or local[:4] != b"PK\3\4":
            raise ValueError(f"entry {quote(name)} has no local header at the declared offset")
        begin = header + LOCAL.size + sum(LOCAL.unpack(local))
        if begin + packed > size:
            raise ValueError(f"entry {quote(name)} extends beyond the end of the file")
        yield Entry(name, begin, packed, full, crc, method == STORED), header


def _widen(numbers: tuple[int, ...], extra: bytes) -> tuple[int, ...]:
    """Return the numbers of an entry, those over 32 bits from its ZIP64 field.

    The field has only the numbers whose place refers to it, in order. Without a field, the number
    itself is meant. Raises `ValueError` if a field is cut.
    """
    while len(extra) >= FIELD.size:
        kind, size = FIELD.unpack_from(extra)
        field, extra = extra[FIELD.size : FIELD.size + size], extra[FIELD.size + size :]
        needed = struct.Struct(f"<{numbers.count(ZIP64)}Q")
        if len(field) < size or (kind == ZIP64_KIND and size < needed.size):
            raise ValueError("its directory is damaged: an extra field is cut")
        if kind == ZIP64_KIND:
            wide = iter(needed.unpack_from(field))
            return tuple(next(wide) if number == ZIP64 else number for number in numbers)
    return numbers
