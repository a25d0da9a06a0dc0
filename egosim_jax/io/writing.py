"""Write videos of uint8 RGB frames: H.264 in mp4.

Written files are tagged with the matrix of BT.601 and limited range, as readers assume of untagged
files, and with sRGB's primaries and transfer function. Their chroma is on the left columns, as
H.264 says of files that do not state another place.

FFmpeg's scaler centers the chroma that it writes between two columns, so that each trip from file
to file would move colors by half a pixel, and its low-pass filter would blur them. The filters here
are sited on the left column, between two rows, and are left inverses of the bicubic filter that
enlarges chroma again (B = 0, C = 0.6): the chroma of a frame that was read is written unchanged. Of
all left inverses of their length, they are the nearest to the least-squares solution.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any, no_type_check

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace
from jaxtyping import Float32, UInt8

from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.decoding import ACCURATE
from egosim_jax.types import InputError

CRF = 10
"""Default quality of x264: 0 is lossless, 10 visually lossless (about 50 dB), 23 x264's own."""
_SMPTE170M, _LIMITED_RANGE, _BT709, _SRGB = 6, 1, 1, 13
COLUMN_TAPS = (92, 0, -614, 1229, 2682, 1229, -614, 0, 92)
"""Weights of the columns around an even one, times `UNIT`."""
ROW_TAPS = (-60, 179, 92, -595, 190, 2242, 2242, 190, -595, 92, 179, -60)
"""Weights of the rows around the middle of an even row and the next one, times `UNIT`."""
UNIT = 4096


def write_video(
    path: Path | str,
    frames: UInt8[np.ndarray, "f h w 3"],
    fps: int | float | Fraction,
    *,
    crf: int = CRF,
) -> None:
    """Write an H.264 mp4 file atomically."""
    data = encode_video(frames, fps, crf=crf)
    with atomic_write(Path(path)) as temporary:
        temporary.write_bytes(data)


def encode_video(
    frames: UInt8[np.ndarray, "f h w 3"], fps: int | float | Fraction, *, crf: int = CRF
) -> bytes:
    """Encode RGB frames as an H.264 (yuv420p) mp4 file.

    Raises `InputError` for no frames, for other arrays than uint8, and for odd sizes, which 4:2:0
    cannot represent.
    """
    _check_dtype(frames)
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
    for no frames, and for frames of different sizes or of other dtypes.
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
            _check_dtype(frame)
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


def _check_dtype(frames: np.ndarray) -> None:
    """Raise `InputError` unless frames are uint8."""
    if frames.dtype != np.uint8:
        raise InputError(
            f"Frames of {frames.dtype} cannot be written: they must be uint8, from 0 to 255. Of "
            "floats from 0 to 1: (255 * frames).round().astype(np.uint8)."
        )


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
            container.mux(stream.encode(_to_yuv420(frame)))
        container.mux(stream.encode())


@no_type_check
def _to_yuv420(frame: UInt8[np.ndarray, "h w 3"]) -> VideoFrame:
    """Return an RGB frame of even size as BT.601 yuv420p of limited range, its chroma at left."""
    full = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24").reformat(
        format="yuv444p",
        interpolation=ACCURATE,
        dst_colorspace=Colorspace.ITU601,
        dst_color_range=ColorRange.MPEG,
    )
    planes = full.to_ndarray()
    rows = _halve(planes[1:].astype(np.float32), ROW_TAPS)
    chroma = _halve(np.ascontiguousarray(rows.swapaxes(1, 2)), COLUMN_TAPS).swapaxes(1, 2)
    chroma = np.clip(np.rint(chroma), 1, 254).astype(np.uint8)
    joined = np.concatenate([planes[0].ravel(), chroma.ravel()])
    height, width = frame.shape[:2]
    return av.VideoFrame.from_ndarray(joined.reshape(height * 3 // 2, width), format="yuv420p")


@no_type_check
def _halve(planes: Float32[np.ndarray, "n h w"], taps: Sequence[int]) -> np.ndarray:
    """Filter along the rows and keep every second one; border rows are repeated."""
    count, reach = planes.shape[1], (len(taps) - 1) // 2
    padded = np.pad(planes, ((0, 0), (reach, reach + 1), (0, 0)), mode="edge")
    # Element by element, so that the result is the same on every processor.
    return sum(
        np.float32(tap / UNIT) * padded[:, start : start + count : 2]
        for start, tap in enumerate(taps)
        if tap
    )
