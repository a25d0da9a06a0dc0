"""Read and write videos: uint8 RGB arrays in memory, H.264 on disk.

Colors are converted between RGB and YUV 4:2:0 with accurate rounding and interpolated chroma.
EgoSim's loader (`decoding="official"`) uses the scaler's fast default, whose frames are about one
gray level darker. That error would accumulate in a loop that writes clips and reads them back.
Written files are tagged with the matrix of BT.601 and limited range, as readers assume of untagged
files, and with sRGB's primaries and transfer function. Their chroma is on the left columns, as
H.264 says of files that do not state another place (`io/chroma.py`).
`io/decoding.py` says which files are refused.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, no_type_check

import av
import numpy as np
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream
from jaxtyping import UInt8

from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.boxes import MAX_SAMPLES
from egosim_jax.io.chroma import to_yuv420
from egosim_jax.io.decoding import (
    ACCURATE,
    MAX_FRAMES,
    Damage,
    DamagedError,
    Decoding,
    File,
    FrameBuffer,
    check_size,
    decode_packet,
    open_file,
    open_video,
    pixel_aspect,
    read_frames,
    read_packets,
    shown_size,
    skip_leading,
    to_rgb,
)
from egosim_jax.io.listing import Listing, list_frames
from egosim_jax.io.timing import Timeline
from egosim_jax.types import InputError

VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".webm", ".avi")
"""Suffixes of the files that are taken for videos."""
CRF = 10
"""Default quality of x264: 0 is lossless, 10 visually lossless (about 50 dB), 23 x264's own."""
_SMPTE170M, _LIMITED_RANGE, _BT709, _SRGB = 6, 1, 1, 13


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Video:
    """Decoded video and its frame rate."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """Frames of the video in RGB."""
    fps: Fraction


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """Length, size as shown and rate of a video, read without decoding it."""

    frames: int
    """Number of frames at the constant rate (`io/timing.py`)."""
    height: int
    width: int
    fps: Fraction
    """Rate in frames per second, by time stamps."""
    timeline: Timeline = field(repr=False, compare=False)
    """Times of the frames."""
    pixel_aspect: Fraction = Fraction(1)
    """Width over height of a stored pixel; frames are read with square ones."""

    def check_square(self, name: str) -> None:
        """Raise `InputError` if intrinsics of stored pixels would not fit the frames."""
        if self.pixel_aspect != 1:
            raise InputError(
                f"{name} stores pixels {self.pixel_aspect} times as wide as high, and it is not "
                "known whether its intrinsics are for these or for square ones. Convert it with "
                "`ffmpeg -i IN -vf scale=iw*sar:ih,setsar=1 OUT.mp4`, and the intrinsics, too."
            )


def probe_video(path: Path, *, damage: Damage = "refuse") -> VideoInfo:
    """Count a video's frames and read its size and rate; only the first frame is decoded.

    Raises `InputError` for a file that is missing, unreadable, empty or above the limits.
    """
    with open_file(path) as file:
        return _probe(file, quote_path(path), damage)


def probe_encoded(data: bytes, *, name: str = "the encoded video") -> VideoInfo:
    """Probe the bytes of a video file (`probe_video`); `name` replaces the path in errors."""
    return _probe(io.BytesIO(data), name, "refuse")


def read_video(
    path: Path,
    *,
    start: int = 0,
    stop: int | None = None,
    decoding: Decoding = "accurate",
    damage: Damage = "refuse",
    each: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Video:
    """Decode frames `start` (inclusive) to `stop` (exclusive; the end if None) of a video file.

    `each` is applied to every frame as it is decoded, for example to make it smaller. A video that
    ends before `stop` yields fewer frames. Raises `InputError` for a file that is missing,
    unreadable, damaged, above the limits or without a frame in that range.
    """
    with open_file(path) as file:
        return _decode(
            file,
            quote_path(path),
            frames=slice(start, stop),
            max_frames=MAX_FRAMES,
            decoding=decoding,
            damage=damage,
            each=each,
        )


def decode_video(
    data: bytes,
    *,
    start: int = 0,
    stop: int | None = None,
    max_frames: int = MAX_FRAMES,
    decoding: Decoding = "accurate",
    each: Callable[[np.ndarray], np.ndarray] | None = None,
    name: str = "the encoded video",
) -> Video:
    """Decode the bytes of a video file (`read_video`); `name` replaces the path in errors."""
    return _decode(
        io.BytesIO(data),
        name,
        frames=slice(start, stop),
        max_frames=max_frames,
        decoding=decoding,
        damage="refuse",
        each=each,
    )


def _probe(file: File, name: str, damage: Damage) -> VideoInfo:
    with open_video(file, name, MAX_FRAMES) as stream:
        listing = list_frames(stream, name, MAX_FRAMES, damage=damage)
    file.seek(0)
    with open_video(file, name, MAX_FRAMES) as stream:
        return describe(stream, name, listing)


def describe(stream: VideoStream, name: str, listing: Listing) -> VideoInfo:
    """Return a listed video's length, size and rate, and log which frames are not used.

    Decodes the first frame. Raises `InputError` for a variable frame rate.
    """
    timeline = listing.timeline
    timeline.check(name)
    frames = (
        frame
        for packet in skip_leading(read_packets(stream, name, MAX_SAMPLES))
        for frame in decode_packet(stream, packet, name)
    )
    try:
        first = next(frames, None)
    except DamagedError as error:
        if listing.cut:
            raise listing.undecodable(name) from error
        raise
    if first is None:
        raise InputError(f"{name} holds no frames. Export or download it again.")
    height, width = shown_size(stream, first)
    listing.report(name)
    return VideoInfo(
        frames=timeline.count,
        height=height,
        width=width,
        fps=timeline.fps,
        timeline=timeline,
        pixel_aspect=pixel_aspect(stream),
    )


def _decode(
    file: File,
    name: str,
    *,
    frames: slice,
    max_frames: int,
    decoding: Decoding,
    damage: Damage,
    each: Callable[[np.ndarray], np.ndarray] | None,
) -> Video:
    kept, before, position, scaler = FrameBuffer(name), None, -1, VideoReformatter()
    with open_video(file, name, max_frames) as stream:
        # Damage after the wanted frames does not matter, so decoding finds it.
        listing = list_frames(stream, name, max_frames, damage="stop")
    timeline = listing.timeline
    stop = timeline.count if frames.stop is None else min(frames.stop, timeline.count)
    check_size(name, stop - frames.start, 0, max_frames)
    moments_s = timeline.moments_s(frames.start, stop)
    timeline.check(name, moments_s)
    wanted = timeline.nearest(moments_s)
    file.seek(0)
    with open_video(file, name, max_frames) as stream:
        try:
            for decoded in read_frames(stream, name, max_frames):
                if decoded.pts is not None and decoded.pts == before:
                    continue  # a repeated time stamp
                before, position = decoded.pts, position + 1
                frame = None
                while len(kept) < len(wanted) and wanted[len(kept)] == position:
                    if frame is None:
                        frame = to_rgb(stream, decoded, decoding, scaler)
                        frame = frame if each is None else each(frame)
                    kept.append(frame)
                if len(kept) == len(wanted) and stop < timeline.count:
                    break
        except DamagedError as error:
            if damage == "refuse" and listing.cut:
                raise listing.undecodable(name) from error
            if damage == "refuse" or not len(kept):
                raise
    if not len(kept):
        since = f" from frame {frames.start} on" if frames.start else ""
        raise InputError(f"{name} holds no frames{since}.")
    return Video(frames=kept.frames(), fps=timeline.fps)


def write_video(
    path: Path, frames: UInt8[np.ndarray, "f h w 3"], fps: int | float | Fraction, *, crf: int = CRF
) -> None:
    """Write an H.264 mp4 file atomically."""
    data = encode_video(frames, fps, crf=crf)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def encode_video(
    frames: UInt8[np.ndarray, "f h w 3"], fps: int | float | Fraction, *, crf: int = CRF
) -> bytes:
    """Encode RGB frames as an H.264 (yuv420p) mp4 file.

    Raises `InputError` for no frames, and for odd sizes, which 4:2:0 cannot represent.
    """
    count, height, width, _ = frames.shape
    if count == 0 or height % 2 or width % 2:
        raise InputError(
            f"{count} frames of {width}x{height} cannot be written: H.264 with 4:2:0 color needs "
            "at least one frame and an even width and height."
        )
    buffer = io.BytesIO()
    _encode(buffer, frames, height, width, fps, crf)
    return buffer.getvalue()


def write_frames(
    path: Path, frames: Iterable[np.ndarray], fps: int | float | Fraction
) -> tuple[int, int, int]:
    """Write frames one by one as `write_video` does; return their number, height and width.

    Frames are uint8 `h w 3` of one size. An odd last row or column is cut off. Raises `InputError`
    for no frames, and for frames of different sizes.
    """
    rest = iter(frames)
    first = next(rest, None)
    if first is None or first.shape[0] < 2 or first.shape[1] < 2:
        raise InputError(f"{quote_path(path)} cannot be written: there are no frames.")
    size, count = first.shape, 0
    height, width = size[0] // 2 * 2, size[1] // 2 * 2

    def even() -> Iterator[np.ndarray]:
        nonlocal count
        for frame in chain([first], rest):
            if frame.shape != size:
                raise InputError(
                    f"Frame {count} has {frame.shape[1]}x{frame.shape[0]} pixels, the first one "
                    f"{size[1]}x{size[0]}: all frames of a video must have one size."
                )
            count += 1
            yield frame[:height, :width]

    with atomic_write(path) as temporary, temporary.open("r+b") as file:
        _encode(file, even(), height, width, fps, CRF)
    return count, height, width


def _encode(
    file: Any,
    frames: Iterable[np.ndarray],
    height: int,
    width: int,
    fps: int | float | Fraction,
    crf: int,
) -> None:
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        # With its macroblock tree, x264 is not deterministic on some processors.
        stream.options = {"crf": str(crf), "x264-params": "mbtree=0"}
        coder = stream.codec_context
        coder.colorspace, coder.color_range = _SMPTE170M, _LIMITED_RANGE
        coder.color_primaries, coder.color_trc = _BT709, _SRGB
        for frame in frames:
            container.mux(stream.encode(to_yuv420(frame, ACCURATE)))
        container.mux(stream.encode())
