"""Check bytes of videos that FFmpeg does not: sizes of sample tables, crops, checksums of FFV1.

A few bytes of a sample table of an MP4 can declare billions of samples, and FFmpeg allocates at
least 24 bytes for each. MP4 boxes nest: 4 bytes of size, 4 bytes of type, then the content.

FFmpeg's decoders do not apply a container's crop, so such videos are refused. MP4 and MOV crop by a
box `clap` in the description of a track's samples, Matroska by elements PixelCrop in the
description of a track.

FFmpeg's decoder of FFV1 conceals a damaged slice without a mark. Each slice of version 3 (RFC 9043)
ends with its size in 3 bytes and, by default, a byte of status and a CRC-32 with the highest bit
first. The CRC of a slice with its CRC is 0.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator

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
MAX_HEADER = 1 << 18
"""Number of bytes at the start of a Matroska file in which its tracks are searched."""
_EBML = b"\x1a\x45\xdf\xa3"
_PARENTS = {b"\x18\x53\x80\x67", b"\x16\x54\xae\x6b", b"\xae", b"\xe0"}
"""Segment, Tracks, TrackEntry and Video."""
_CROPS = {b"\x54\xaa", b"\x54\xbb", b"\x54\xcc", b"\x54\xdd"}
"""PixelCropBottom, PixelCropTop, PixelCropLeft and PixelCropRight."""
_SIZE, _CHECKED = 3, 8
"""Bytes behind the content of a slice, without and with a checksum."""
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


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


def crops_mp4(samples: bytes) -> bool:
    """Return True if the content of a box `stsd` shows only a part of the frames."""
    at = samples.find(b"\0\0\0\x28clap")
    if at < 40 or len(samples) < at + 24:
        return False
    size = struct.unpack_from(">HH", samples, 40)  # of the first entry: width and height
    shown = struct.unpack_from(">IIII", samples, at + 8)  # numerator, denominator of both
    return any(shown[2 * i] < size[i] * shown[2 * i + 1] for i in (0, 1))


def check_crop(file: io.BufferedReader | io.BytesIO, name: str, *, cropped: bool = False) -> None:
    """Raise `InputError` if a Matroska file, or an MP4 file by `crops_mp4`, crops its frames."""
    file.seek(0)
    head = file.read(MAX_HEADER)
    file.seek(0)
    if cropped or (head.startswith(_EBML) and any(_crops(head))):
        raise InputError(
            f"{name} says that its frames are shown cropped (clap or PixelCrop), which is not "
            "read. Convert it with FFmpeg 7.1 or later, which crops: `ffmpeg -i IN OUT.mp4`."
        )


def _crops(head: bytes) -> Iterator[bool]:
    """Yield whether each crop in a Matroska header is above 0."""
    at = 0
    while at + 2 <= len(head):
        length = 9 - head[at].bit_length()  # of the id: the zeros before its first one, and it
        kind, at = head[at : at + length], at + length
        if at >= len(head) or length > 4:
            return
        length = 9 - head[at].bit_length()
        size = int.from_bytes(head[at : at + length], "big") & ((1 << 7 * length) - 1)
        at += length
        if kind in _CROPS:
            yield any(head[at : at + size])
        if kind not in _PARENTS:
            at += size


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
