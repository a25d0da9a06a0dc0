"""Read segments of long videos without decoding the frames before them.

First the packets are listed without decoding, which counts frames exactly at any frame rate. Then
decoding starts at the last key frame before the segment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from egosim_jax.io.bounded import quote_path, quote_text
from egosim_jax.io.boxes import MAX_SAMPLES
from egosim_jax.io.decoding import (
    MAX_FRAMES,
    DamagedError,
    File,
    FrameBuffer,
    check_packet,
    check_size,
    container_of,
    decode_packet,
    frame_rate,
    open_file,
    open_video,
    pixel_aspect,
    shown_size,
    to_rgb,
)
from egosim_jax.io.video import Video, VideoInfo
from egosim_jax.types import InputError, check_counts


@dataclass(frozen=True, kw_only=True)
class _Listing:
    times: list[int]
    """Presentation time of every frame, in order, in units of the stream."""
    keys: list[tuple[int, int]]
    """Presentation and decoding time of every key frame, in order."""


def probe_long_video(path: Path) -> VideoInfo:
    """Count the frames of a video of any length and read its size and rate.

    Decodes only the first frame; the packets show whether frames are equally spaced. Raises
    `InputError` if the video is unreadable or damaged.
    """
    name = quote_path(path)
    with open_file(path) as file:
        listing = _list(file, name)
        with open_video(file, name, None) as stream:
            decoded = next(_frames(stream, name, listing.keys[0][1]))
            height, width = shown_size(stream, decoded)
            fps, unit = frame_rate(stream, name), stream.time_base
            aspect = pixel_aspect(stream)
    return VideoInfo(
        frames=len(listing.times),
        height=height,
        width=width,
        fps=fps,
        pixel_aspect=aspect,
        unevenness_s=_unevenness(listing.times) * float(unit or 0),
    )


def read_segment(
    path: Path,
    *,
    start: int,
    count: int,
    each: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Video:
    """Decode `count` frames of a video of any length, starting at frame `start`.

    `each` is applied to every frame as it is decoded. Raises `InputError` if the file is unreadable
    or damaged, or ends before the segment.
    """
    check_counts({"The number of frames": count})
    name = quote_path(path)
    kept = FrameBuffer(name)
    with open_file(path) as file:
        listing = _list(file, name)
        if start < 0 or start + count > len(listing.times):
            raise InputError(
                f"Frames {start} to {start + count - 1} of {name} cannot be read: it has "
                f"{len(listing.times)}, counted from 0."
            )
        first, last = listing.times[start], listing.times[start + count - 1]
        with open_video(file, name, None) as stream:
            key = max((k for k in listing.keys if k[0] <= first), default=listing.keys[0])
            for decoded in _frames(stream, name, key[1]):
                time = first - 1 if decoded.pts is None else decoded.pts
                if time < first:
                    continue
                if time != listing.times[start + len(kept)]:
                    break
                frame = to_rgb(stream, decoded, "accurate")
                kept.append(frame if each is None else each(frame))
                if time >= last:
                    break
            fps = frame_rate(stream, name)
    if len(kept) < count:
        raise DamagedError(f"{name} is damaged: frame {start + len(kept)} cannot be decoded.")
    return Video(frames=kept.frames(), fps=fps)


def _list(file: File, name: str) -> _Listing:
    """List the frames of a video without decoding them."""
    times, keys = list[int](), list[tuple[int, int]]()
    with open_video(file, name, None) as stream:
        try:
            for packet in container_of(stream).demux(stream):
                if not packet.size:
                    continue
                if packet.is_corrupt or packet.pts is None or len(times) > MAX_SAMPLES:
                    raise DamagedError(f"{name} is damaged after {len(times)} frames.")
                check_packet(stream, packet, name)
                if packet.is_keyframe:
                    keys.append((packet.pts, packet.pts if packet.dts is None else packet.dts))
                if not packet.is_discard:
                    times.append(packet.pts)
        except OSError as error:  # from FFmpeg's parsers
            raise DamagedError(f"{name} is damaged: {quote_text(str(error))}.") from error
    file.seek(0)
    if not times or not keys or len(set(times)) != len(times):
        raise DamagedError(f"{name} has no frames, no key frame, or two frames at one time.")
    return _Listing(times=sorted(times), keys=sorted(keys))


def _unevenness(times: list[int]) -> float:
    """Return the maximum deviation of frame times from equal spacing, in units of the stream."""
    even = np.linspace(times[0], times[-1], len(times))
    return float(np.abs(np.array(times) - even).max())


def _frames(stream: VideoStream, name: str, dts: int) -> Iterator[VideoFrame]:
    """Yield decoded frames, starting at the key frame with decoding time `dts`."""
    container = container_of(stream)
    container.seek(dts, stream=stream, backward=True)
    size, count = None, 0
    for packet in container.demux(stream):
        for decoded in decode_packet(stream, packet if packet.size else None, name):
            size = size or (decoded.height, decoded.width)
            if decoded.is_corrupt or size != (decoded.height, decoded.width):
                raise DamagedError(f"{name} is damaged at {decoded.time} s.")
            count += 1
            check_size(name, count, size[0] * size[1], MAX_FRAMES)
            yield decoded
