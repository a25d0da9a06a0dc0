"""Open untrusted videos, and decode their frames as they are shown.

Everything that opens a video opens it here, so that each file has one track, geometry and color:

- The track is the first that the file marks as default, else the first. Cover art, thumbnails and
  other still images are skipped, as are tracks of one frame if there are longer ones.
- Frames are rotated and mirrored by the display matrix. Pixels that are not square are resized to
  square ones: the width is multiplied by the sample aspect ratio of the container or, without one,
  of the codec. A ratio within 1 % of 1:1 comes from rounding a size to whole pixels.
- Chroma is sited as the file or the standard of its codec states: on the left columns in MPEG-2,
  MPEG-4, H.264 and H.265. Where neither states it, chroma is centered.
- Colors of wide gamut (BT.2020, P3) are converted to BT.709, but not by `official` decoding.
- HDR and other transfer functions that need a tone curve, matrices that FFmpeg cannot convert,
  interlaced frames, frames of two views and spherical ones are refused.

Only the contents of regular files are opened, never names or addresses inside a file. The header is
checked against limits before anything is decoded. Detectable damage is refused: the decoder must
report no error and mark no frame as corrupt. H.264 has no checksum, so a changed bit that leaves a
valid stream passes. Frames outside the edit list are omitted, as in every player.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from typing import Literal, TypeVar, cast

import av
import numpy as np
from av.container import InputContainer
from av.packet import Packet
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.reformatter import ColorPrimaries, Interpolation, VideoReformatter
from av.video.stream import VideoStream

from egosim_jax.io.bounded import quote_text
from egosim_jax.io.containers import MAX_SAMPLES, check_boxes, is_intact
from egosim_jax.io.images import MAX_IMAGE_PIXELS
from egosim_jax.types import InputError

MAX_FRAMES = 10_000
"""Maximum number of frames of one call, with those decoded before them."""
MAX_PIXELS = 2**31
"""Maximum number of pixels that one call decodes, frames x height x width: about 10 s."""
MAX_MISSING_S = 0.25
"""Maximum time between the end of the frames and the end that the header states, in seconds."""
P = TypeVar("P", Packet, Packet | None)
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
MAX_UNSQUARE = 0.01
"""Maximum deviation of the sample aspect ratio from 1 of pixels that count as square."""
_STILL = (
    Disposition.attached_pic
    | Disposition.timed_thumbnails
    | Disposition.still_image
    | Disposition.metadata
)
_TRANSFERS = {8: "linear", 9: "logarithmic", 10: "logarithmic", 16: "PQ", 17: "DCDM", 18: "HLG"}
"""Transfer functions that need a tone curve (ITU-T H.273, table 3)."""
_WIDE_GAMUT = (9, 11, 12)
"""Primaries of BT.2020, DCI-P3 and Display P3 (ITU-T H.273, table 2)."""
_MATRICES = (0, 1, 2, 4, 5, 6, 7, 9)
"""Matrices that FFmpeg's scaler converts, or 2, not stated (ITU-T H.273, table 4)."""
_TO_BT709 = (
    "ffmpeg -i IN -vf scale=out_primaries=bt709:out_transfer=bt709:out_color_matrix=bt709,"
    "format=yuv420p OUT.mp4"
)
_ONE_VIEW, _RECTILINEAR = (0, 8), 4
"""FFmpeg's types of stereo with one view in a frame, and its projection of a pinhole."""
_FORMATS = "MP4, MOV, Matroska, WebM, AVI or MPEG-TS"
_CONVERT = "onvert it, for instance with `ffmpeg -i IN -pix_fmt yuv444p OUT.mp4`."
_OPTIONS = {
    "format_whitelist": "mov,mp4,m4a,matroska,webm,avi,mpegts",
    "protocol_whitelist": "none",
    "max_pixels": str(MAX_IMAGE_PIXELS),
    "err_detect": "crccheck+bitstream+buffer+explode",
}


class DamagedError(InputError):
    """Raised for a video that is truncated or damaged."""


def damaged(name: str, problem: str) -> DamagedError:
    """Return the error for a damaged video: the problem and the remedy."""
    return DamagedError(f"{name} is damaged: {problem}. Download or export it again.")


@contextmanager
def _decoding(name: str) -> Iterator[None]:
    """Turn any exception of FFmpeg into `DamagedError`."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise damaged(name, _reason(error)) from error


def _reason(error: Exception) -> str:
    """Return the reason of an exception of FFmpeg, without its number and file."""
    words = error.strerror if isinstance(error, (av.FFmpegError, OSError)) else str(error)
    return quote_text(words or type(error).__name__)


@contextmanager
def open_video(file: File, name: str) -> Iterator[VideoStream]:
    """Open the main video stream of a file from its beginning, within the limits.

    Raises `InputError` for a file without a video stream, or if its color cannot be read right.
    """
    check_boxes(file, name)
    file.seek(0)
    try:
        container = av.open(file, mode="r", options=_OPTIONS, metadata_errors="replace")
    except Exception as error:
        raise InputError(
            f"{name} is not a readable video: {_reason(error)}. It must be a whole file of "
            f"{_FORMATS}. Download or export it again, or c{_CONVERT}"
        ) from error
    with container:
        shown = [stream for stream in container.streams.video if not stream.disposition & _STILL]
        if not shown:
            raise InputError(f"{name} has no video stream. Give a file with one.")
        shown = [stream for stream in shown if stream.frames != 1] or shown  # 0 if not listed
        main = [stream for stream in shown if stream.disposition & Disposition.default]
        stream = (main or shown)[0]
        if stream.codec_context is None:
            raise InputError(f"{name} is of a codec that is not known. C{_CONVERT}")
        with _decoding(name):
            stream.codec_context.options = _OPTIONS
            stream.thread_type = "AUTO"
        _check_color(stream, name)
        area = stream.height * _square_width(stream, stream.width)
        if area > MAX_IMAGE_PIXELS:
            raise InputError(
                f"{name} has frames of {area:,} square pixels, more than {MAX_IMAGE_PIXELS:,}, the "
                f"maximum (sample aspect ratio {stream.sample_aspect_ratio})."
            )
        yield stream


def read_packets(stream: VideoStream, name: str) -> Iterator[Packet]:
    """Yield the packets of a stream. Raises `DamagedError`, at the end if the file was cut off.

    Raises `InputError` if decoding times go back, because frames would take each other's place.
    """
    read, end, before, cut, coder = 0, 0, -(1 << 63), False, stream.codec_context
    with _decoding(name):
        for number, packet in enumerate(cast(InputContainer, stream.container).demux(stream)):
            if number > 2 * MAX_SAMPLES:  # empty packets count, too
                raise InputError(f"{name} has more than {MAX_SAMPLES:,} frames. Split it.")
            if packet.dts is not None and packet.dts < before:
                rate = stream.average_rate or stream.guessed_rate or 30
                raise InputError(
                    f"{name}: the clock of the file begins again after {read} frames, as where "
                    "files were joined. Number the frames again, for instance with "
                    f"`ffmpeg -i IN -vf setpts=N/({rate}*TB) -r {rate} OUT.mp4`."
                )
            before = before if packet.dts is None else packet.dts
            cut |= packet.is_corrupt  # also before a joint of files, which a later packet shows
            if cut or not packet.size:
                continue
            if coder.name == "ffv1" and not is_intact(bytes(packet), coder.extradata):
                raise damaged(name, "a packet does not have its checksum")
            if packet.pts is not None:
                end = max(end, packet.pts + (packet.duration or 0))
            read += 1
            yield packet
    if cut:
        raise damaged(name, f"it is cut off after {read} frames")
    if read < (listed := len(stream.index_entries)):
        raise damaged(name, f"it is cut off: it holds {read} of the {listed} frames it lists")
    end_s = float(end * (stream.time_base or 1))
    if end_s + MAX_MISSING_S < (declared_s := _declared_s(stream)):
        raise damaged(name, f"it is cut off at {end_s:.1f} s: its header says {declared_s:.1f} s")


def _declared_s(stream: VideoStream) -> float:
    """Return the length in seconds that Matroska's header states for a track; 0 if none."""
    container = cast(InputContainer, stream.container)
    if "matroska" not in container.format.name or not container.duration:
        return 0.0
    lengths = [container.duration / av.time_base]
    if tag := re.fullmatch(r"(\d+):(\d+):(\d+\.\d+)", stream.metadata.get("DURATION", "")):
        lengths.append(int(tag[1]) * 3600 + int(tag[2]) * 60 + float(tag[3]))
    # Other tracks may be longer than this one.
    return min(lengths) if tag or len(container.streams) == 1 else 0.0


def skip_leading(packets: Iterable[P]) -> Iterator[P]:
    """Omit packets before the first key frame, and frames shown before it.

    They refer to frames that are not in the file, as after a cut without encoding (open GOP).
    """
    begun, first = False, None
    for packet in packets:
        if packet is not None:
            if not begun and packet.is_keyframe:
                begun, first = True, packet.pts
            early = first is not None and packet.pts is not None and packet.pts < first
            if not begun or early:
                continue
        yield packet


def decode_frames(
    stream: VideoStream, name: str, *, key: int | None = None
) -> Iterator[VideoFrame]:
    """Yield decoded frames from the beginning, or from the key frame with decoding time `key`.

    Raises `DamagedError` where the video is damaged.
    """
    count, size = 0, None
    with _decoding(name):
        if key is not None:
            cast(InputContainer, stream.container).seek(key, stream=stream, backward=True)
        for packet in skip_leading(_whole_packets(stream)):
            for frame in stream.decode(packet):
                _check_frame(frame, name)
                size = size or (frame.width, frame.height)
                if size != (frame.width, frame.height):
                    raise InputError(
                        f"{name} changes its size from {size[0]}x{size[1]} to "
                        f"{frame.width}x{frame.height} at {frame.time or 0:.2f} s: all frames must "
                        "have one. Convert it, for instance with "
                        f"`ffmpeg -i IN -vf scale={size[0]}:{size[1]} OUT.mp4`."
                    )
                if frame.is_corrupt:
                    raise damaged(name, f"its frame at {frame.time} s is corrupt")
                count += 1
                check_count(name, count, frame.width * frame.height)
                yield frame


def _whole_packets(stream: VideoStream) -> Iterator[Packet | None]:
    """Yield the packets before any damage, then None, which flushes the decoder."""
    with suppress(av.FFmpegError):
        for packet in cast(InputContainer, stream.container).demux(stream):
            if packet.is_corrupt:
                break
            if packet.size:
                yield packet
    yield None


def to_rgb(
    stream: VideoStream,
    frame: VideoFrame,
    decoding: Decoding,
    scaler: VideoReformatter,
    *,
    max_side: int | None = None,
) -> np.ndarray:
    """Return a decoded frame of a stream as it is shown: upright RGB `h w 3` of square pixels.

    A frame with a side above `max_side` is shrunk to it. Frames of a stream share a scaler: a new
    one needs seconds to prepare for a wide gamut.
    """
    wide = frame.color_primaries in _WIDE_GAMUT and decoding == "accurate"
    width, height = _square_width(stream, frame.width), frame.height
    factor = min(1.0, (max_side or max(width, height)) / max(width, height))
    frame_rgb = scaler.reformat(
        frame,
        width=max(1, round(factor * width)),
        height=max(1, round(factor * height)),
        format="rgb24",
        interpolation=_SCALERS[decoding],
        dst_color_primaries=ColorPrimaries.BT709 if wide else None,
    )
    return _upright(frame, frame_rgb.to_ndarray())


def shown_size(stream: VideoStream, frame: VideoFrame) -> tuple[int, int]:
    """Return height and width of a decoded frame of a stream as it is shown."""
    empty = np.broadcast_to(np.uint8(0), (frame.height, _square_width(stream, frame.width)))
    height, width = _upright(frame, empty).shape
    return height, width


def pixel_aspect(stream: VideoStream) -> Fraction:
    """Return width over height of the stored pixels of a stream; 1 if they count as square."""
    ratio = stream.sample_aspect_ratio or Fraction(1)
    return Fraction(1) if abs(ratio - 1) <= MAX_UNSQUARE else ratio


def _square_width(stream: VideoStream, width: int) -> int:
    """Return the width of a stored frame in square pixels."""
    return max(1, round(width * pixel_aspect(stream)))


def _check_color(source: VideoStream | VideoFrame, name: str) -> None:
    """Raise `InputError` if the colors of a stream or frame cannot be read right."""
    transfer = _TRANSFERS.get(source.color_trc)
    if transfer is not None:
        raise InputError(
            f"{name} is HDR or a camera's own format (transfer function {transfer}): without a "
            f"tone curve it would be pale. Convert it, for instance with FFmpeg 8: `{_TO_BT709}`."
        )
    if source.colorspace not in _MATRICES:
        raise InputError(
            f"{name} has the color matrix {source.colorspace} of ITU-T H.273, which is not read. "
            "Convert it, for instance with `ffmpeg -i IN -vf zscale=matrix=709 OUT.mp4`."
        )


def _check_frame(frame: VideoFrame, name: str) -> None:
    """Raise `InputError` if a frame is not one upright image of a pinhole or its like."""
    _check_color(frame, name)
    a, b, c, d = _display_matrix(frame)
    if (a or d) and (b or c):
        problem = "is rotated by an angle that is not a multiple of 90°"
        command = "ffmpeg -display_rotation 0 -i IN -c copy OUT.mp4"
    elif frame.interlaced_frame:
        problem = "is interlaced: rows of two times alternate in a frame"
        command = "ffmpeg -i IN -vf bwdif=mode=send_frame OUT.mp4"
    elif _side_value(frame, "STEREO3D") not in (None, *_ONE_VIEW):
        problem = "is stereoscopic: each frame holds two views, for instance side by side (sbsl)"
        command = "ffmpeg -i IN -vf stereo3d=sbsl:ml OUT.mp4"
    elif _side_value(frame, "SPHERICAL") not in (None, _RECTILINEAR):
        problem = "is spherical (360° or 180°), not the image of a pinhole"
        command = "ffmpeg -i IN -vf v360=e:flat:h_fov=90:v_fov=60 OUT.mp4"
    else:
        return
    raise InputError(f"{name} {problem}. Convert it, for instance with `{command}`.")


def _side_value(frame: VideoFrame, kind: str) -> int | None:
    """Return the first field of a frame's side data, or None if the frame has none."""
    if kind not in frame.side_data:
        return None
    return int(np.frombuffer(bytes(frame.side_data[kind]), np.int32, count=1)[0])


def _upright(frame: VideoFrame, pixels: np.ndarray) -> np.ndarray:
    """Rotate and mirror a frame by its display matrix."""
    a, b, c, d = _display_matrix(frame)
    if b or c:
        pixels, a, d = pixels.swapaxes(0, 1), c, b
    return pixels[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1]


def _display_matrix(frame: VideoFrame) -> tuple[int, int, int, int]:
    """Return a, b, c and d of a frame's display matrix (a b u, c d v, x y w).

    A point (x, y) is shown at (a x + c y, b x + d y), y downward.
    """
    if "DISPLAYMATRIX" not in frame.side_data:
        return 1, 0, 0, 1
    a, b, _, c, d, *_ = np.frombuffer(bytes(frame.side_data["DISPLAYMATRIX"]), np.int32).tolist()
    return a, b, c, d


def check_count(name: str, frames: int, area: int) -> None:
    """Raise `InputError` if `frames` frames of `area` pixels exceed the limits of one call."""
    if frames > MAX_FRAMES:
        raise InputError(
            f"{name}: one call decodes at most {MAX_FRAMES:,} frames. Cut the video, for instance "
            "with `ffmpeg -i IN -f segment -segment_time 60 OUT%03d.mp4`."
        )
    if frames * area > MAX_PIXELS:
        raise InputError(
            f"{name}: one call decodes at most {MAX_PIXELS:,} pixels, and each frame has {area:,}. "
            "Cut the video, or make it smaller."
        )
