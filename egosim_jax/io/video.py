"""Reading and writing of videos and images: uint8 RGB arrays, H.264 and PNG on disk.

Colors cross between RGB and YUV 4:2:0 with accurate rounding and interpolated chroma. The
scaler's fast default, with which EgoSim's loader reads (`decoding="official"`), gives frames about
one gray level darker, an error that would add up in a loop that writes clips and reads them back.
What is written is tagged BT.601, limited range, which is also what readers assume of untagged
files.

Only the contents of regular files are opened, never names or addresses that a file may refer to,
and what a header declares is held against caps before anything is decoded. Damage is refused as far
as it shows: the decoder has to get through without an error, mark no frame as corrupt and give a
frame for each packet that the container lists. H.264 has no checksum, so a changed bit that leaves
a valid stream passes. Frames are turned and mirrored as the display matrix says, and those outside
the edit list are not part of the video, as in every player.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, Literal, no_type_check

import av
import numpy as np
from av.container import InputContainer
from av.packet import Packet
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from av.video.stream import VideoStream
from jaxtyping import UInt8
from PIL import Image

from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.boxes import check_boxes
from egosim_jax.io.untrusted import open_regular, quote_path, quote_text, read_bytes
from egosim_jax.types import InputError

MAX_FRAMES = 10_000
"""Maximum length of a video in frames, unless the caller gives another."""
MAX_PIXELS = 2**31
"""Maximum number of pixels decoded from one video, frames x height x width: about 10 s."""
MAX_KEPT = 3 * 2**28
"""Maximum size of the frames of one call, in bytes."""
MAX_IMAGE_PIXELS = 2**25
"""Maximum number of pixels of one image or frame: 8192 x 4096."""
MAX_IMAGE_BYTES = 2**28
"""Maximum size of an image file in bytes."""
IMAGES = ("PNG", "JPEG", "WEBP", "BMP", "TIFF", "PPM")
"""Image formats that can be read."""

File = io.BufferedReader | io.BytesIO
Decoding = Literal["accurate", "official"]
"""Conversion of YUV to RGB: accurate, or bit for bit as in EgoSim's loader (imageio's FFmpeg)."""
Damage = Literal["refuse", "stop"]
"""Action at damage in a video: raise `InputError`, or stop and return the frames before it."""

_ACCURATE = (
    Interpolation.BICUBIC
    | Interpolation.ACCURATE_RND
    | Interpolation.FULL_CHR_H_INT
    | Interpolation.FULL_CHR_H_INP
    | Interpolation.BITEXACT
)
_SCALERS: dict[Decoding, Interpolation] = {
    "accurate": _ACCURATE,
    "official": Interpolation.BICUBIC,
}
_SMPTE170M, _LIMITED_RANGE = 6, 1
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


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Video:
    """Decoded video and its frame rate."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """Frames of the video in RGB."""
    fps: Fraction


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """Length, size and rate of a video, read without decoding it."""

    frames: int
    height: int
    width: int
    fps: Fraction
    hdr: bool = False
    """True if brightness is coded for HDR, by PQ or HLG: converted to 8 bits, it looks pale."""
    unevenness_s: float = 0.0
    """Largest distance in seconds of a frame from equal spacing; 0 if it was not measured."""


def probe_video(path: Path, *, damage: Damage = "refuse") -> VideoInfo:
    """Count a video's frames and read its size and rate; only the first frame is decoded.

    Raises `InputError` for a file that is missing, unreadable, empty, or above the caps.
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
    max_frames: int = MAX_FRAMES,
    decoding: Decoding = "accurate",
    damage: Damage = "refuse",
    each: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Video:
    """Decode frames `start` (inclusive) to `stop` (exclusive; the end if None) of a video file.

    `each` is applied to every frame as it is decoded, for instance to make it smaller. A video
    that ends before `stop` gives the frames it has. Raises `InputError` for a file that is
    missing, unreadable, damaged, above the caps, or that has no frame in that range.
    """
    with open_file(path) as file:
        return _decode(
            file,
            quote_path(path),
            frames=slice(start, stop),
            max_frames=max_frames,
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


def write_video(
    path: Path, frames: UInt8[np.ndarray, "f h w 3"], fps: int | float | Fraction, *, crf: int = 10
) -> None:
    """Write an H.264 mp4 file atomically."""
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
            f"{count} frames of {width}x{height} cannot be written: H.264 with 4:2:0 color needs "
            "at least one frame and an even width and height."
        )
    buffer = io.BytesIO()
    _encode(buffer, frames, height, width, fps, crf)
    return buffer.getvalue()


def write_frames(
    path: Path, frames: Iterable[np.ndarray], fps: int | float | Fraction, *, crf: int = 10
) -> tuple[int, int, int]:
    """Write frames one by one as `write_video` does, and return their number, height and width.

    All must be uint8 `h w 3` of the first one's size, of which an odd last row or column is cut
    off. Raises `InputError` for none, or for other sizes.
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
                    f"Picture {count} has {frame.shape[1]}x{frame.shape[0]} pixels, the first one "
                    f"{size[1]}x{size[0]}: all pictures of a video must have one size."
                )
            count += 1
            yield frame[:height, :width]

    with atomic_write(path) as temporary, temporary.open("r+b") as file:
        _encode(file, even(), height, width, fps, crf)
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


def read_image(path: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Read an image file as RGB. Raises `InputError` if it is missing, damaged or too large."""
    return decode_image(read_bytes(path, limit=MAX_IMAGE_BYTES), name=quote_path(path))


def decode_image(data: bytes, *, name: str = "the encoded image") -> UInt8[np.ndarray, "h w 3"]:
    """Decode the bytes of an image file (`read_image`); `name` replaces the path in errors.

    Of 16 bits the upper 8 are taken.
    """
    with _refusing(f"{name} is not a readable image"):
        with Image.open(io.BytesIO(data), formats=IMAGES) as image:
            if image.width * image.height > MAX_IMAGE_PIXELS:
                raise InputError(
                    f"{name} has {image.width}x{image.height} pixels, more than "
                    f"{MAX_IMAGE_PIXELS:,}, the most that is read."
                )
            if image.mode in ("I", "F"):
                raise InputError(f"{name} has 32 bits a channel; save it with 8 or 16.")
            if image.format == "PNG":
                image.verify()  # the CRC of every chunk; then it has to be opened again
        with Image.open(io.BytesIO(data), formats=IMAGES) as image:
            if image.mode.startswith("I;16"):
                gray = (np.asarray(image) >> 8).astype(np.uint8)
                return np.stack([gray] * 3, axis=-1)
            return np.asarray(image.convert("RGB"))


def _probe(file: File, name: str, damage: Damage) -> VideoInfo:
    frames, size = 0, None
    with open_video(file, name, MAX_FRAMES) as container:
        stream = container.streams.video[0]
        try:
            for packet in _packets(container, name, MAX_FRAMES):
                frames += packet is not None and not packet.is_discard
                if size is None:
                    size = next(
                        (
                            upright(p, np.empty((p.height, p.width))).shape
                            for p in decode_packet(stream, packet, name)
                        ),
                        None,
                    )
        except DamagedError:
            if damage == "refuse" or size is None:
                raise
        if size is None:
            raise InputError(f"{name} holds no frames.")
        return VideoInfo(
            frames=frames,
            height=size[0],
            width=size[1],
            fps=frame_rate(stream, name),
            hdr=is_hdr(stream),
        )


def is_hdr(stream: VideoStream) -> bool:
    """Return True for a stream whose transfer function is PQ or HLG."""
    return stream.codec_context.color_trc in _HDR


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
    kept = np.empty((0,), np.uint8)
    start, stop, count = frames.start, frames.stop, 0
    with open_video(file, name, max_frames) as container:
        try:
            for index, picture in enumerate(_pictures(container, name, max_frames)):
                if stop is not None and index >= stop:
                    break
                if index < start:
                    continue
                frame = to_rgb(picture, decoding)
                frame = frame if each is None else each(frame)
                if count == len(kept):
                    kept = enlarge(kept, frame, name)
                kept[count] = frame
                count += 1
        except DamagedError:
            if damage == "refuse" or not count:
                raise
        fps = frame_rate(container.streams.video[0], name)
    if not count:
        wanted = f" from frame {start} on" if start else ""
        raise InputError(f"{name} holds no frames{wanted}.")
    kept.resize((count, *kept.shape[1:]), refcheck=False)
    return Video(frames=kept, fps=fps)


def enlarge(kept: np.ndarray, frame: np.ndarray, name: str) -> np.ndarray:
    """Double the capacity for frames without a copy."""
    room = min(max(16, 2 * len(kept)), MAX_KEPT // frame.nbytes)
    if room <= len(kept):
        raise InputError(
            f"{name} has more than {MAX_KEPT:,} bytes of frames ({frame.nbytes:,} each), the most "
            "that is read at once."
        )
    kept.resize((room, *frame.shape), refcheck=False)
    return kept


def to_rgb(picture: VideoFrame, decoding: Decoding) -> np.ndarray:
    """Return a decoded frame as upright RGB `h w 3`."""
    picture_rgb = picture.reformat(format="rgb24", interpolation=_SCALERS[decoding])
    return upright(picture, picture_rgb.to_ndarray())


def upright(picture: VideoFrame, pixels: np.ndarray) -> np.ndarray:
    """Rotate and mirror frames by the display matrix (a b u, c d v, x y w).

    A point (x, y) is shown at (a x + c y, b x + d y), y downward.
    """
    if "DISPLAYMATRIX" not in picture.side_data:
        return pixels
    a, b, _, c, d, *_ = np.frombuffer(bytes(picture.side_data["DISPLAYMATRIX"]), np.int32)
    if (a or d) and (b or c):
        raise InputError("the video is rotated by an angle that is not a multiple of 90°.")
    if b or c:
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


def _pictures(container: InputContainer, name: str, max_frames: int) -> Iterator[VideoFrame]:
    """Yield decoded frames. Raises `DamagedError` where the video is damaged."""
    stream, size = container.streams.video[0], None
    shown = given = 0
    for packet in _packets(container, name, max_frames):
        shown += packet is not None and not packet.is_discard
        for picture in decode_packet(stream, packet, name):
            size = size or (picture.height, picture.width)
            if picture.is_corrupt or size != (picture.height, picture.width):
                raise DamagedError(f"{name} is damaged at frame {given}.")
            given += 1
            check_size(name, given, size[0] * size[1], max_frames)
            yield picture
    if given != shown:
        raise DamagedError(f"{name} is damaged: {given} of its {shown} frames can be decoded.")


def decode_packet(stream: VideoStream, packet: Packet | None, name: str) -> list[VideoFrame]:
    """Decode a packet, or with None what remains. Raises `DamagedError`."""
    with _refusing(f"{name} is damaged", DamagedError):
        return stream.decode(packet)


def _packets(container: InputContainer, name: str, max_frames: int) -> Iterator[Packet | None]:
    """Yield packets, then None, for which the decoder returns its remaining frames.

    Raises `DamagedError` at the end if the file was cut off.
    """
    stream, read = container.streams.video[0], 0
    try:
        with _refusing(f"{name} is damaged", DamagedError):
            for number, packet in enumerate(container.demux(stream)):
                check_size(name, number // 2, 0, max_frames)  # empty ones count, too
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


@contextmanager
def open_file(path: Path) -> Iterator[File]:
    """Open a file here, so that no video library resolves a name."""
    with open_regular(path) as file:
        if not os.fstat(file.fileno()).st_size:
            raise InputError(f"{quote_path(path)} is empty (0 bytes).")
        yield file


@contextmanager
def open_video(file: File, name: str, max_frames: int | None) -> Iterator[InputContainer]:
    """Open a container with a video stream of an allowed size, and length unless that is None."""
    check_boxes(file, name)
    with _refusing(f"{name} is not a readable video"):
        container = av.open(file, mode="r", options=_OPTIONS, metadata_errors="replace")
    with container:
        if not container.streams.video:
            raise InputError(f"{name} has no video stream.")
        stream = container.streams.video[0]
        if stream.codec_context is None:
            raise InputError(f"{name} is of a codec that is not known.")
        with _refusing(f"{name} is not a readable video"):
            stream.codec_context.options = _OPTIONS
            stream.thread_type = "AUTO"
            area = stream.height * stream.width
        check_size(name, stream.frames if max_frames else 1, area, max_frames or 1)
        yield container


@contextmanager
def _refusing(what: str, kind: type[InputError] = InputError) -> Iterator[None]:
    """Turn exceptions of a decoder about untrusted bytes into `InputError`."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise kind(f"{what}: {quote_text(reason or type(error).__name__)}.") from error


def check_size(name: str, frames: int, area: int, max_frames: int) -> None:
    """Raise `InputError` if so many frames of so many pixels are not read at once."""
    if frames > max_frames:
        raise InputError(f"{name} is longer than {max_frames} frames, the most that is read.")
    if frames * area > MAX_PIXELS:
        raise InputError(
            f"{name} has more than {MAX_PIXELS:,} pixels ({area:,} a frame), the most that is read."
        )


def frame_rate(stream: VideoStream, name: str) -> Fraction:
    """Return the average frame rate of a stream."""
    rate = stream.average_rate or stream.guessed_rate
    if not rate:
        raise InputError(f"{name} does not say its frame rate.")
    return rate
