"""Refuse videos whose container crops the frames, because FFmpeg's decoders do not crop them.

The crop of a codec is applied by its decoder. MP4 and MOV crop by a box `clap` in the description
of a track's samples, Matroska by elements PixelCrop in the description of a track.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator

from egosim_jax.types import InputError

MAX_HEADER = 1 << 18
"""Number of bytes at the start of a Matroska file in which its tracks are searched."""
_EBML = b"\x1a\x45\xdf\xa3"
_PARENTS = {b"\x18\x53\x80\x67", b"\x16\x54\xae\x6b", b"\xae", b"\xe0"}
"""Segment, Tracks, TrackEntry and Video."""
_CROPS = {b"\x54\xaa", b"\x54\xbb", b"\x54\xcc", b"\x54\xdd"}
"""PixelCropBottom, PixelCropTop, PixelCropLeft and PixelCropRight."""


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
