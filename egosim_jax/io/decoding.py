"""Decode untrusted videos, packet by packet and frame by frame.

Only the contents of regular files are opened, never names or addresses inside a file. The header is
checked against limits before anything is decoded. Detectable damage is refused: the decoder must
report no error, mark no frame as corrupt and return a frame for each packet that the container
lists. H.264 has no checksum, so a changed bit that leaves a valid stream passes. Frames are rotated
and mirrored by the display matrix, and frames outside the edit list are omitted, as in every
player.
"""

from __future__ import annotations

import io
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import av
import numpy as np
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation
from av.video.stream import VideoStream

from egosim_jax.io.bounded import open_regular, quote_path, refusing
from egosim_jax.io.boxes import check_boxes
from egosim_jax.io.images import MAX_IMAGE_PIXELS
from egosim_jax.types import InputError

MAX_FRAMES = 10_000
"""Default maximum length of a video in frames."""
MAX_PIXELS = 2**31
"""Maximum number of pixels to decode from one video, frames x height x width: about 10 s."""
MAX_KEPT = 3 * 2**28
"""Maximum size of the frames that one call returns, in bytes."""

File = io.BufferedReader | io.BytesIO
Decoding = Literal["accurate", "official"]
"""Conversion of YUV to RGB: accurate, or bit-exact with EgoSim's loader (imageio's FFmpeg)."""
Damage = Literal["refuse", "stop"]
"""Action at damage in a video: raise `InputError`, or stop and return the frames before it."""

ACCURATE = (
    Interpolation.BICUBIC
    | Interpolation.ACCURATE_RND
    | Interpolation.FULL_CHR_H_INT
    | Interpolation.FULL_CHR_H_INP
    | Interpolation.BITEXACT
)
_SCALERS: dict[Decoding, Interpolation] = {
    "accurate": ACCURATE,
    "official": Interpolation.BICUBIC,
}
_HDR = (16, 18)
"""Transfer functions PQ and HLG (ITU-T H.273, table 3)."""
_OPTIONS = {
    "format_whitelist": "mov,mp4,m4a,matroska,webm,avi,mpegts",
    "protocol_whitelist": "none",
    "max_pixels": str(MAX_IMAGE_PIXELS),
    "err_detect": "crccheck+bitstream+buffer+explode",
}


class DamagedError(InputError):
    """Raised for a video that is truncated or damaged."""


@contextmanager
def open_file(path: Path) -> Iterator[File]:
    """Open a file, so that FFmpeg gets bytes and never resolves a name."""
    with open_regular(path) as file:
        if not os.fstat(file.fileno()).st_size:
            raise InputError(f"{quote_path(path)} is empty (0 bytes).")
        yield file


@contextmanager
def open_video(file: File, name: str, max_frames: int | None) -> Iterator[InputContainer]:
    """Open a container with a video stream within the limits; None allows any length."""
    check_boxes(file, name)
    with refusing(f"{name} is not a readable video"):
        container = av.open(file, mode="r", options=_OPTIONS, metadata_errors="replace")
    with container:
        if not container.streams.video:
            raise InputError(f"{name} has no video stream.")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise InputError(f"{name} is of a codec that is not known.")
        with refusing(f"{name} is not a readable video"):
            stream.codec_context.options = _OPTIONS
            stream.thread_type = "AUTO"
            area = stream.height * stream.width
        check_size(name, stream.frames if max_frames else 1, area, max_frames or 1)
        yield container


def read_packets(container: InputContainer, name: str, max_frames: int) -> Iterator[Packet | None]:
    """Yield packets, then None, which flushes the decoder.

    Raises `DamagedError` at the end if the file was cut off.
    """
    stream, read = container.streams.video[0], 0
    try:
        with refusing(f"{name} is damaged", DamagedError):
            for number, packet in enumerate(container.demux(stream)):
                check_size(name, number // 2, 0, max_frames)  # empty packets count, too
                if packet.is_corrupt:
                    raise DamagedError(f"{name} is cut off after {read} frames.")
                if packet.size:
                    read += 1
                    yield packet
    except DamagedError:
        yield None
        raise
    yield None
    listed = len(stream.index_entries)
    if read < listed:
        raise DamagedError(f"{name} is cut off: it holds {read} of the {listed} frames it lists.")


def skip_leading(packets: Iterable[Packet | None]) -> Iterator[Packet | None]:
    """Omit packets before the first key frame, and frames shown before it.

    They refer to frames that are not in the file, as after a cut without encoding (open GOP).
    """
    begun, first = False, None
    for packet in packets:
        if packet is not None:
            if not begun and packet.is_keyframe:
                begun, first = True, packet.pts
            if not begun or (None not in (first, packet.pts) and packet.pts < first):
                continue
        yield packet


def decode_packet(stream: VideoStream, packet: Packet | None, name: str) -> list[VideoFrame]:
    """Decode a packet; None flushes the decoder. Raises `DamagedError`."""
    with refusing(f"{name} is damaged", DamagedError):
        return stream.decode(packet)


def read_frames(container: InputContainer, name: str, max_frames: int) -> Iterator[VideoFrame]:
    """Yield decoded frames. Raises `DamagedError` where the video is damaged."""
    stream, size = container.streams.video[0], None
    shown = given = 0
    for packet in skip_leading(read_packets(container, name, max_frames)):
        shown += packet is not None and not packet.is_discard
        for frame in decode_packet(stream, packet, name):
            size = size or (frame.height, frame.width)
            if frame.is_corrupt or size != (frame.height, frame.width):
                raise DamagedError(f"{name} is damaged at frame {given}.")
            given += 1
            check_size(name, given, size[0] * size[1], max_frames)
            yield frame
    if given != shown:
        raise DamagedError(f"{name} is damaged: {given} of its {shown} frames can be decoded.")


def to_rgb(frame: VideoFrame, decoding: Decoding) -> np.ndarray:
    """Return a decoded frame as upright RGB `h w 3`."""
    frame_rgb = frame.reformat(format="rgb24", interpolation=_SCALERS[decoding])
    return upright(frame, frame_rgb.to_ndarray())


def upright(frame: VideoFrame, pixels: np.ndarray) -> np.ndarray:
    """Rotate and mirror a frame by its display matrix (a b u, c d v, x y w).

    A point (x, y) is shown at (a x + c y, b x + d y), y downward.
    """
    if "DISPLAYMATRIX" not in frame.side_data:
        return pixels
    a, b, _, c, d, *_ = np.frombuffer(bytes(frame.side_data["DISPLAYMATRIX"]), np.int32)
    if (a or d) and (b or c):
        raise InputError("the video is rotated by an angle that is not a multiple of 90°.")
    if b or c:
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


def check_size(name: str, frames: int, area: int, max_frames: int) -> None:
    """Raise `InputError` if `frames` frames of `area` pixels exceed the limits."""
    if frames > max_frames:
        raise InputError(f"{name} is longer than {max_frames} frames, the maximum.")
    if frames * area > MAX_PIXELS:
        raise InputError(
            f"{name} has more than {MAX_PIXELS:,} pixels ({area:,} per frame), the maximum."
        )


def is_hdr(stream: VideoStream) -> bool:
    """Return True if the transfer function of a stream is PQ or HLG."""
    return stream.codec_context.color_trc in _HDR


class FrameBuffer:
    """Frames of one call, collected without copies and bounded by `MAX_KEPT`."""

    def __init__(self, name: str):
        self._name, self._kept, self._count = name, np.empty((0,), np.uint8), 0

    def __len__(self) -> int:
        return self._count

    def append(self, frame: np.ndarray) -> None:
        """Append a frame of the first frame's shape. Raises `InputError` above the limit."""
        if self._count == len(self._kept):
            room = min(max(16, 2 * self._count), MAX_KEPT // frame.nbytes)
            if room <= self._count:
                raise InputError(
                    f"{self._name} has more than {MAX_KEPT:,} bytes of frames ({frame.nbytes:,} "
                    "each), the maximum of one call."
                )
            self._kept.resize((room, *frame.shape), refcheck=False)
        self._kept[self._count] = frame
        self._count += 1

    def frames(self) -> np.ndarray:
        """Return the frames; nothing can be added afterwards."""
        self._kept.resize((self._count, *self._kept.shape[1:]), refcheck=False)
        return self._kept
