"""Check the boxes of MP4 files before FFmpeg reads them: the sizes of sample tables, and crops.

A few bytes of a sample table can declare billions of samples, and FFmpeg allocates at least 24
bytes for each. MP4 boxes nest: 4 bytes of size, 4 bytes of type, then the content.
"""

from __future__ import annotations

import io

from egosim_jax.io.cropping import check_crop, crops_mp4
from egosim_jax.types import InputError

MAX_SAMPLES = 2**22
"""Maximum number of samples in all tracks, such as 90 s of uncompressed audio at 48 kHz."""
MAX_BOXES = 100_000
"""Maximum number of boxes in a file."""
MAX_DESCRIPTION = 1 << 16
"""Number of bytes of a sample description in which a crop is searched."""
_CONTAINERS = {
    b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts", b"dinf", b"udta", b"tref", b"mvex",
    b"moof", b"traf", b"mfra", b"wave",
}  # fmt: skip
_COUNTS = {b"stsz": 8, b"stz2": 8, b"trun": 4, b"stts": 4, b"ctts": 4, b"stsc": 4, b"stco": 4,
           b"co64": 4, b"stss": 4, b"sbgp": 8, b"elst": 4}  # fmt: skip
"""Byte offset of the entry count in each kind of table."""


def check_boxes(file: io.BufferedReader | io.BytesIO, name: str) -> None:
    """Raise `InputError` if an MP4 declares too many samples, or if a container crops frames."""
    size = file.seek(0, 2)
    rest, seen, samples, cropped = [(0, size)], 0, 0, False
    while rest:
        start, end = rest.pop()
        file.seek(start)
        head = file.read(16)
        kind, length, content = head[4:8], int.from_bytes(head[:4], "big"), start + 8
        if length == 1:
            length, content = int.from_bytes(head[8:], "big"), start + 16
        if len(head) < 8 or 0 < length < content - start or not kind.isascii():
            continue
        stop = min(start + length, end) if length else end
        if stop + 8 <= end:
            rest.append((stop, end))
        if kind in _CONTAINERS:
            rest.append((content, stop))
        elif kind in _COUNTS:
            file.seek(content)
            table = file.read(16)
            offset = _COUNTS[kind] + 4 * (kind == b"sbgp" and table[:1] == b"\1")
            samples += int.from_bytes(table[offset : offset + 4], "big")
        elif kind == b"stsd":
            file.seek(content)
            cropped |= crops_mp4(file.read(min(stop - content, MAX_DESCRIPTION)))
        seen += 1
        if samples > MAX_SAMPLES or seen > MAX_BOXES or kind == b"cmov":
            raise InputError(
                f"{name} cannot be read: its header is compressed, or declares more than "
                f"{MAX_SAMPLES:,} samples or {MAX_BOXES:,} boxes."
            )
    check_crop(file, name, cropped=cropped)
