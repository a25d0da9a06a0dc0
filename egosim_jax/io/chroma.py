"""Convert RGB to YUV 4:2:0 so that reading and writing a video again and again moves no color.

FFmpeg's scaler centers the chroma that it writes between two columns, but H.264 means the left one,
and the reader follows H.264: each trip would move colors by half a pixel. Its low-pass filter also
blurs them at each trip. The filters here are sited on the left column, between two rows, and are
left inverses of the bicubic filter that enlarges chroma again (B = 0, C = 0.6): the chroma of a
frame that was read is written unchanged. Of all left inverses of their length, they are the nearest
to the least-squares solution.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import no_type_check

import av
import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import ColorRange, Colorspace, Interpolation
from jaxtyping import Float32, UInt8

COLUMN_TAPS = (92, 0, -614, 1229, 2682, 1229, -614, 0, 92)
"""Weights of the columns around an even one, times `UNIT`."""
ROW_TAPS = (-60, 179, 92, -595, 190, 2242, 2242, 190, -595, 92, 179, -60)
"""Weights of the rows around the middle of an even row and the next one, times `UNIT`."""
UNIT = 4096


@no_type_check
def to_yuv420(frame: UInt8[np.ndarray, "h w 3"], interpolation: Interpolation) -> VideoFrame:
    """Return an RGB frame of even size as BT.601 yuv420p of limited range, its chroma at left."""
    full = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24").reformat(
        format="yuv444p",
        interpolation=interpolation,
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
