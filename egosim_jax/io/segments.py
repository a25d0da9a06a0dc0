"""Read segments of long videos without decoding the frames before them.

First the packets are listed without decoding (`io/listing.py`), which gives the time of each frame.
Then decoding starts at the last key frame before the segment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import no_type_check

import numpy as np
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream
from jaxtyping import Float

from egosim_jax.io.bounded import quote_path
from egosim_jax.io.boxes import MAX_SAMPLES
from egosim_jax.io.decoding import (
    MAX_FRAMES,
    DamagedError,
    File,
    FrameBuffer,
    check_size,
    container_of,
    damaged,
    decode_packet,
    open_file,
    open_video,
    skip_leading,
    to_rgb,
)
from egosim_jax.io.listing import Listing, list_frames
from egosim_jax.io.timing import convert
from egosim_jax.io.video import Video, VideoInfo, describe
from egosim_jax.types import InputError, check_counts


def probe_long_video(path: Path) -> VideoInfo:
    """Count the frames of a video of any length and read its size and rate.

    Decodes only the first frame. Raises `InputError` if the video is unreadable or damaged, or has
    a variable frame rate.
    """
    name = quote_path(path)
    with open_file(path) as file:
        listing = _list(file, name)
        with open_video(file, name, None) as stream:
            return describe(stream, name, listing)


def read_segment(
    path: Path,
    *,
    start: int,
    count: int,
    each: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Video:
    """Decode `count` frames of a video of any length, starting at frame `start`.

    `each` is applied to every frame as it is decoded. Raises `InputError` if the file is unreadable
    or damaged, has a variable frame rate, or ends before the segment.
    """
    check_counts({"The number of frames": count})
    name = quote_path(path)
    with open_file(path) as file:
        listing = _list(file, name)
        timeline = listing.timeline
        if start < 0 or start + count > timeline.count:
            raise InputError(
                f"Frames {start} to {start + count - 1} of {name} cannot be read: it has "
                f"{timeline.count}, counted from 0."
            )
        return _read(file, name, listing, timeline.moments_s(start, start + count), each)


@no_type_check
def read_moments(
    path: Path,
    times_s: Float[np.ndarray, " f"],
    *,
    each: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Video:
    """Decode the frames nearest to increasing times, in seconds after the first frame.

    Otherwise as `read_segment`.
    """
    name = quote_path(path)
    with open_file(path) as file:
        listing = _list(file, name)
        return _read(file, name, listing, times_s, each)


@no_type_check
def _read(
    file: File,
    name: str,
    listing: Listing,
    times_s: Float[np.ndarray, " f"],
    each: Callable[[np.ndarray], np.ndarray] | None,
) -> Video:
    """Decode the frames nearest to increasing times."""
    listing.timeline.check(name, times_s)
    stamps = listing.stamps[listing.timeline.nearest(times_s)].tolist()
    first = listing.keys[0]
    key = max((key for key in listing.keys if key[0] <= stamps[0]), default=first)
    try:
        frames = _decode(file, name, listing, key, stamps, each)
    except DamagedError as error:
        if key == first and listing.cut:
            raise listing.undecodable(name) from error
        if key == first:
            raise
        # An open GOP may make the decoder forget frames that it knows only from the beginning.
        file.seek(0)
        try:
            frames = _decode(file, name, listing, first, stamps, each)
        except InputError as error:
            raise listing.undecodable(name) from error
    return Video(frames=frames, fps=listing.timeline.fps)


def _decode(
    file: File,
    name: str,
    listing: Listing,
    key: tuple[int, int],
    stamps: list[int],
    each: Callable[[np.ndarray], np.ndarray] | None,
) -> np.ndarray:
    """Decode the frames with increasing time stamps, starting at a key frame."""
    kept, before, scaler = FrameBuffer(name), None, VideoReformatter()
    with open_video(file, name, None) as stream:
        for decoded in _frames(stream, name, key[1]):
            stamp = stamps[0] - 1 if decoded.pts is None else decoded.pts
            if before is not None and stamp < before:
                raise InputError(
                    f"{name} has frames whose time stamps are not in order, as in AVI files. "
                    f"Encode them again, for instance with `{convert(listing.timeline.fps)}`."
                )
            before, frame = stamp, None
            while len(kept) < len(stamps) and stamps[len(kept)] == stamp:
                if frame is None:
                    frame = to_rgb(stream, decoded, "accurate", scaler)
                    frame = frame if each is None else each(frame)
                kept.append(frame)
            if len(kept) == len(stamps):
                return kept.frames()
    at_s = (stamps[len(kept)] - int(listing.stamps[0])) * float(listing.unit_s)
    raise damaged(name, f"its frame at {at_s:.3f} s cannot be decoded")


def _list(file: File, name: str) -> Listing:
    with open_video(file, name, None) as stream:
        listing = list_frames(stream, name, MAX_SAMPLES)
    file.seek(0)
    return listing


def _frames(stream: VideoStream, name: str, dts: int) -> Iterator[VideoFrame]:
    """Yield decoded frames, starting at the key frame with decoding time `dts`."""
    container = container_of(stream)
    container.seek(dts, stream=stream, backward=True)
    size, count = None, 0
    packets = (packet if packet.size else None for packet in container.demux(stream))
    for packet in skip_leading(packets):
        for decoded in decode_packet(stream, packet, name):
            size = size or (decoded.height, decoded.width)
            if decoded.is_corrupt or size != (decoded.height, decoded.width):
                raise damaged(name, f"its frame at {decoded.time} s is corrupt or of another size")
            count += 1
            check_size(name, count, size[0] * size[1], MAX_FRAMES)
            yield decoded
