"""Videos and images in and out: uint8 RGB arrays on our side, H.264 and PNG on disk.

Colours cross between RGB and YUV 4:2:0 with accurate rounding and interpolated chroma. The
scaler's fast default reads every frame about one grey level too dark, an error that would add up
in a loop that writes clips and reads them back. What is written is tagged BT.601, limited range,
which is also what readers assume of untagged files.

Only file contents are ever opened, never names or addresses that a file may refer to, and what a
header declares is held against caps before anything is decoded.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import no_type_check

import av
import numpy as np
from av.container import InputContainer
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from jaxtyping import UInt8
from PIL import Image, UnidentifiedImageError

from egosim_jax.io.atomic import atomic_write
from egosim_jax.types import InputError

MAX_FRAMES = 10_000
"""Longest video that is read, in frames, unless the caller says otherwise."""
MAX_PIXELS = 2**31
"""Most pixels decoded from one video, frames x height x width: 6 GiB of RGB."""
MAX_IMAGE_PIXELS = 2**26
"""Most pixels of one image: 8192 x 8192."""

_ACCURATE = (
    Interpolation.BICUBIC
    | Interpolation.ACCURATE_RND
    | Interpolation.FULL_CHR_H_INT
    | Interpolation.FULL_CHR_H_INP
    | Interpolation.BITEXACT
)
_SMPTE170M, _LIMITED_RANGE = 6, 1
_CONTAINERS = "mov,mp4,m4a,matroska,webm,avi,mpegts"


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Video:
    """A decoded video."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """RGB."""
    fps: Fraction


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """What a video holds, read without decoding it."""

    frames: int
    height: int
    width: int
    fps: Fraction


def probe_video(path: Path) -> VideoInfo:
    """Count a video's frames and read its size and rate, without decoding.

    Raises `InputError` for a file that is missing, unreadable, empty, or above the caps.
    """
    with _open_file(path) as file:
        return _probe(file, str(path))


def probe_encoded(data: bytes, *, name: str = "the encoded video") -> VideoInfo:
    """`probe_video` from the bytes of a file; `name` stands for the path in errors."""
    return _probe(io.BytesIO(data), name)


def read_video(
    path: Path, *, start: int = 0, stop: int | None = None, max_frames: int = MAX_FRAMES
) -> Video:
    """Decode frames `start` (inclusive) to `stop` (exclusive; the end if None) of a video file.

    Raises `InputError` for a file that is missing, unreadable, above the caps, or that has no
    frame in that range. A video that ends before `stop` gives the frames it has.
    """
    with _open_file(path) as file:
        return _decode(file, str(path), start=start, stop=stop, max_frames=max_frames)


def decode_video(
    data: bytes,
    *,
    start: int = 0,
    stop: int | None = None,
    max_frames: int = MAX_FRAMES,
    name: str = "the encoded video",
) -> Video:
    """`read_video` from the bytes of a file; `name` stands for the path in errors."""
    return _decode(io.BytesIO(data), name, start=start, stop=stop, max_frames=max_frames)


def write_video(
    path: Path, frames: UInt8[np.ndarray, "f h w 3"], fps: int | float | Fraction, *, crf: int = 10
) -> None:
    """Write an H.264 mp4, whole or not at all."""
    data = encode_video(frames, fps, crf=crf)
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def encode_video(
    frames: UInt8[np.ndarray, "f h w 3"], fps: int | float | Fraction, *, crf: int = 10
) -> bytes:
    """Encode RGB frames as an H.264 (yuv420p) mp4 file.

    `crf` is x264's quality: 0 lossless, 10 visually lossless (about 50 dB), 23 its default.
    Raises `InputError` for no frames or for odd sizes, which 4:2:0 cannot hold.
    """
    count, height, width, _ = frames.shape
    if count == 0 or height % 2 or width % 2:
        raise InputError(
            f"{count} frames of {width}x{height} cannot be written: H.264 with 4:2:0 colour needs "
            "at least one frame and an even width and height."
        )
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        # x264's macroblock tree gives other bits at every run on some processors.
        stream.options = {"crf": str(crf), "x264-params": "mbtree=0"}
        stream.codec_context.colorspace = _SMPTE170M
        stream.codec_context.color_range = _LIMITED_RANGE
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            picture = picture.reformat(
                format="yuv420p",
                interpolation=_ACCURATE,
                dst_colorspace=Colorspace.ITU601,
                dst_color_range=ColorRange.MPEG,
            )
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
    return buffer.getvalue()


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as RGB. Raises `InputError` if it is missing, unreadable or too large."""
    with _open_file(path) as file:
        return _decode_image(file, str(path))


def decode_image(data: bytes, *, name: str = "the encoded image") -> UInt8[np.ndarray, "h w 3"]:
    """`read_image` from the bytes of a file; `name` stands for the path in errors."""
    return _decode_image(io.BytesIO(data), name)


def _probe(file: io.BufferedReader | io.BytesIO, name: str) -> VideoInfo:
    with _open_video(file, name) as container:
        stream = container.streams.video[0]
        count = sum(1 for packet in container.demux(stream) if packet.size)
        if count == 0:
            raise InputError(f"{name} holds no frames.")
        return VideoInfo(
            frames=count, height=stream.height, width=stream.width, fps=_rate(container, name)
        )


def _decode(
    file: io.BufferedReader | io.BytesIO,
    name: str,
    *,
    start: int,
    stop: int | None,
    max_frames: int,
) -> Video:
    frames = []
    with _open_video(file, name, max_frames=max_frames) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        area = stream.height * stream.width
        for index, picture in enumerate(container.decode(stream)):
            if stop is not None and index >= stop:
                break
            _check_size(name, index + 1, area, max_frames)
            if index >= start:
                picture = picture.reformat(
                    width=stream.width,
                    height=stream.height,
                    format="rgb24",
                    interpolation=_ACCURATE,
                )
                frames.append(picture.to_ndarray())
        fps = _rate(container, name)
    if not frames:
        wanted = f" from frame {start} on" if start else ""
        raise InputError(f"{name} holds no frames{wanted}.")
    return Video(frames=np.stack(frames), fps=fps)


@contextmanager
def _open_file(path: Path) -> Iterator[io.BufferedReader | io.BytesIO]:
    """A file opened here, so that no video library ever resolves a name."""
    try:
        file = path.open("rb")
    except FileNotFoundError as error:
        raise InputError(f"There is no file {path}.") from error
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    with file:
        if path.stat().st_size == 0:
            raise InputError(f"{path} is empty (0 bytes).")
        yield file


@contextmanager
def _open_video(
    file: io.BufferedReader | io.BytesIO, name: str, *, max_frames: int = MAX_FRAMES
) -> Iterator[InputContainer]:
    """A container with a video stream of an allowed size; decoder errors become `InputError`."""
    limits = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "none"}
    try:
        with av.open(file, mode="r", options=limits) as container:
            if not container.streams.video:
                raise InputError(f"{name} has no video stream.")
            stream = container.streams.video[0]
            _check_size(name, stream.frames, stream.height * stream.width, max_frames)
            yield container
    except (av.FFmpegError, OSError) as error:
        raise InputError(f"{name} is not a readable video: {error.strerror}.") from error


def _check_size(name: str, frames: int, area: int, max_frames: int) -> None:
    if frames > max_frames:
        raise InputError(f"{name} is longer than {max_frames} frames, the most that is read.")
    if frames * area > MAX_PIXELS:
        raise InputError(
            f"{name} has more than {MAX_PIXELS:,} pixels ({area:,} a frame), the most that is read."
        )


def _rate(container: InputContainer, name: str) -> Fraction:
    stream = container.streams.video[0]
    rate = stream.average_rate or stream.guessed_rate
    if not rate:
        raise InputError(f"{name} does not say its frame rate.")
    return rate


def _decode_image(file: io.BufferedReader | io.BytesIO, name: str) -> np.ndarray:
    try:
        with Image.open(file) as image:
            if image.width * image.height > MAX_IMAGE_PIXELS:
                raise InputError(
                    f"{name} has {image.width}x{image.height} pixels, more than "
                    f"{MAX_IMAGE_PIXELS:,}, the most that is read."
                )
            return np.asarray(image.convert("RGB"))
    except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{name} is not a readable image.") from error
