"""Sparse copies of remote checkpoints: only the bytes that planning a conversion reads.

A safetensors file has its header, a `.pth` its directory and its pickle, and an index its text. So
the readers and checks of a conversion refuse a checkpoint before it is downloaded. All files have
their full sizes and take a few megabytes on disk.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from egosim_jax.convert.source import INDEX
from egosim_jax.io.bounded import MAX_JSON_BYTES
from egosim_jax.io.untrusted.pth import SUFFIXES
from egosim_jax.io.untrusted.zipped import LOCAL, Archive, Read

TAIL = 1 << 20
"""Bytes at the end of an archive that are read at once: they have its directory."""
MAX_PICKLE = 1 << 26
"""Maximum number of bytes that are read of a pickle."""
EXTRA = 1 << 12
"""Bytes that are read in addition for the name and the extra fields of a local header."""
BLANK = b"PK\3\4".ljust(LOCAL.size, b"\0")
"""Local header without a name and extra fields, of an entry whose content is a hole."""

Spans = Iterator[tuple[int, bytes]]
"""Offsets and contents of the parts of a file that are no holes."""


def write_outline(
    folder: Path, sizes: Mapping[str, int], read: Callable[[str, int, int], bytes]
) -> None:
    """Write an outline of the files of these sizes in bytes to an empty folder.

    `read(name, offset, count)` returns `count` bytes of a file; `count` is above 0. A damaged file
    is outlined as far as it can be read, so that its reader refuses it.
    """
    for name, size in sizes.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)

        def part(at: int, count: int, *, name: str = name, size: int = size) -> bytes:
            count = min(count, size - at)
            return read(name, at, count) if count > 0 else b""

        with path.open("xb") as file:
            file.truncate(size)
            for at, data in _spans(path, part, size):
                file.seek(at)
                file.write(data)


def _spans(path: Path, read: Read, size: int) -> Spans:
    if path.suffix == ".safetensors":
        length = read(0, 8)
        yield 0, length
        yield 8, read(8, min(int.from_bytes(length, "little"), MAX_JSON_BYTES))
    elif path.name.endswith(INDEX):
        yield 0, read(0, MAX_JSON_BYTES)
    elif path.suffix in SUFFIXES:
        yield from _archive_spans(read, size)


def _archive_spans(read: Read, size: int) -> Spans:
    """Yield the start of an archive, its directory, its pickle, and blank headers elsewhere."""
    start = max(0, size - TAIL)
    tail = read(start, TAIL)
    yield 0, read(0, len(BLANK))
    yield start, tail

    def known(at: int, count: int) -> bytes:
        if at >= start:
            return tail[at - start : at - start + count]
        return BLANK if count == LOCAL.size else read(at, count)

    try:
        archive = Archive(known, size)
    except ValueError:
        return
    for entry in archive.entries.values():
        header = entry.begin - LOCAL.size
        if header >= start:
            continue
        if entry.name.endswith(("/data.pkl", "/byteorder")):
            yield header, read(header, LOCAL.size + EXTRA + min(entry.packed, MAX_PICKLE))
        else:
            yield header, BLANK
