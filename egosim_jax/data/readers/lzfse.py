"""LZFSE: the size of what a stream unpacks to, checked before it is unpacked.

A stream is a row of blocks, each with a magic number and the number of bytes that it unpacks to,
and ends with `bvx$`. The library that unpacks it sets no limit. Followed: Apple's
reference implementation, `lzfse_internal.h`.
"""

from __future__ import annotations

END, STORED, LZVN, LZFSE = b"bvx$", b"bvx-", b"bvxn", b"bvx2"
_TWENTY = (1 << 20) - 1


def unpack(data: bytes, size: int) -> bytes:
    """Return what a stream unpacks to, `size` bytes. Raises `ValueError` if it is anything else.

    Data of that size is returned as it is: some apps do not pack.
    """
    if len(data) == size:
        return data
    if (found := unpacked_size(data)) != size:
        raise ValueError(f"it unpacks to {found:,} bytes; expected {size:,}")
    import liblzfse  # pyright: ignore[reportMissingImports]

    try:
        unpacked = liblzfse.decompress(data)
    except liblzfse.error as error:
        raise ValueError(str(error)) from error
    if len(unpacked) != size:
        raise ValueError(f"it unpacked to {len(unpacked):,} bytes; expected {size:,}")
    return unpacked


def unpacked_size(data: bytes) -> int:
    """Return the sum of what the blocks unpack to. Raises `ValueError` if it is no such stream."""

    def number(at: int, count: int) -> int:
        if at + count > len(data):
            raise ValueError("it is cut off")
        return int.from_bytes(data[at : at + count], "little")

    at, total = 0, 0
    while data[at : at + 4] != END:
        magic, raw = data[at : at + 4], number(at + 4, 4)
        if magic == LZFSE:
            literals, lengths, header = (number(at + 8 * n, 8) for n in (1, 2, 3))
            length = (header & 0xFFFFFFFF) + (literals >> 20 & _TWENTY) + (lengths >> 40 & _TWENTY)
        elif magic == LZVN:
            length = 12 + number(at + 8, 4)
        elif magic == STORED:
            length = 8 + raw
        else:
            raise ValueError("it is not an LZFSE stream")
        at, total = at + max(length, 8), total + raw
    return total
