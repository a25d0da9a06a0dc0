"""Decompress LZFSE after checking the declared size, because liblzfse sets no limit.

A stream is a sequence of blocks and ends with `bvx$`. Each block has a magic number and declares
the number of bytes that it decompresses to. Followed: Apple's reference implementation,
`lzfse_internal.h`.
"""

from __future__ import annotations

END, STORED, LZVN, LZFSE = b"bvx$", b"bvx-", b"bvxn", b"bvx2"
_TWENTY = (1 << 20) - 1


def unpack(data: bytes, size: int) -> bytes:
    """Decompress a stream to `size` bytes. Raises `ValueError` if it has another size.

    Data that already has that size is returned unchanged: some apps do not compress.
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
    """Return the total declared size of the blocks. Raises `ValueError` if this is not LZFSE."""

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
