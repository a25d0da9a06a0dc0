"""Check the checksums of FFV1, because FFmpeg's decoder conceals a damaged slice without a mark.

Each slice of version 3 (RFC 9043) ends with its size in 3 bytes and, by default, a byte of status
and a CRC-32 with the highest bit first. The CRC of a slice with its CRC is 0.
"""

from __future__ import annotations

import zlib

_SIZE, _CHECKED = 3, 8
"""Bytes behind the content of a slice, without and with a checksum."""
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


def is_intact(packet: bytes, extradata: bytes | None) -> bool:
    """Return False if a packet of FFV1 is damaged; packets without checksums pass."""
    if not extradata or _crc(extradata):
        return True  # an older or an experimental version
    checked = _slices(packet, _CHECKED)
    if checked is None:
        return _slices(packet, _SIZE) is not None
    return not any(_crc(part) for part in checked)


def _slices(packet: bytes, trailer: int) -> list[bytes] | None:
    """Return the slices of a packet, last first, or None if their sizes do not fill it."""
    found, end = list[bytes](), len(packet)
    while end:
        size = end - trailer
        start = size - int.from_bytes(packet[size : size + 3], "big")
        if size < 0 or start < 0:
            return None
        found.append(packet[start:end])
        end = start
    return found


def _crc(data: bytes) -> int:
    # zlib's CRC-32 takes the lowest bit first, and inverts its start and its result.
    return zlib.crc32(data.translate(_REVERSED), 0xFFFFFFFF) ^ 0xFFFFFFFF
