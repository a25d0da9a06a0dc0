"""Read the entries of uncompressed zip archives as `torch.save` writes them.

The contents are not copied: they are parts of the memory-mapped file.
"""

from __future__ import annotations

from egosim_jax.io.bounded import quote
from egosim_jax.io.mapped import RefusedError
from egosim_jax.io.untrusted.zipped import Archive


def read_entries(data: memoryview) -> dict[str, memoryview]:
    """Return the content of every entry by name, without the top-level folder.

    Raises `RefusedError` if this is not a valid uncompressed little-endian archive.
    """
    if bytes(data[:2]) != b"PK":
        raise RefusedError(
            "not a zip archive; files from before torch 1.6 and bare pickles are not supported"
        )
    try:
        archive = Archive(lambda at, count: bytes(data[at : at + count]), len(data))
    except ValueError as error:
        raise RefusedError(str(error)) from error
    if sum(entry.size for entry in archive.entries.values()) > len(data):
        raise RefusedError("its entries exceed the file")
    found: dict[str, memoryview] = {}
    for entry in archive.entries.values():
        parts = entry.name.split("/")
        if ".." in parts or entry.name.startswith("/") or "\\" in entry.name:
            raise RefusedError(f"entry {quote(entry.name)} has a path outside the archive")
        if not entry.is_stored:
            raise RefusedError(f"entry {quote(entry.name)} is compressed or encrypted")
        name = "/".join(parts[1:])
        if name in found:
            raise RefusedError(f"duplicate entry {quote(entry.name)}")
        found[name] = data[entry.begin : entry.begin + entry.size]
    if found.get("byteorder", b"little") != b"little":
        raise RefusedError("its byte order is big-endian")
    if "data.pkl" not in found:
        raise RefusedError("it has no data.pkl")
    return found
