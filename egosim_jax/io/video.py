"""Read videos: uint8 RGB frames at a constant rate (`io/timing.py`), from files of any length.

First the packets are listed without decoding, which gives the time of each frame. Then decoding
starts at the last key frame before the first frame that is wanted. `io/decoding.py` says which
files are refused.

Colors are converted from YUV with accurate rounding and interpolated chroma. EgoSim's loader
(`decoding="official"`) uses the scaler's fast default, whose frames are about one gray level
darker. That error would accumulate in a loop that writes clips and reads them back.
"""

from __future__ import annotations

import io
import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import no_type_check

import numpy as np
from av.packet import Packet
from av.video.reformatter import VideoReformatter
from jaxtyping import Float, UInt8

from egosim_jax.io.bounded import open_regular, quote_path
from egosim_jax.io.decoding import (
    Damage,
    DamagedError,
    Decoding,
    File,
    check_count,
    damaged,
    decode_frames,
    open_video,
    pixel_aspect,
    read_packets,
    shown_size,
    skip_leading,
    to_rgb,
)
from egosim_jax.io.timing import Timeline, convert
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)

VIDEO_SUFFIXES = (
    ".mp4", ".m4v", ".mov", ".qt", ".3gp", ".mkv", ".webm", ".avi", ".ts", ".mts", ".m2ts",
    ".mpg", ".mpeg", ".wmv", ".flv", ".ogv",
)  # fmt: skip
"""Suffixes of the files that are taken for videos; files of the last line are refused by name."""
MAX_KEPT = 3 * 2**28
"""Maximum size of the frames that one call returns, in bytes."""
Each = Callable[[np.ndarray], np.ndarray]
"""Function that is applied to every frame as it is decoded, for example to make it smaller."""


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


def probe_video(
    source: Path | bytes, *, damage: Damage = "refuse", name: str = "the encoded video"
) -> VideoInfo:
    """Count a video's frames and read its size and rate; only the first frame is decoded.

    `source` is a path, or the bytes of a file, which errors call `name`. Raises `InputError` for a
    file that is missing, unreadable or damaged, and for a variable frame rate.
    """
    with _open(source, name) as (file, name):
        listing = _list(file, name, damage)
        timeline = listing.timeline
        timeline.check(name)
        with open_video(file, name) as stream:
            try:
                first = next(decode_frames(stream, name), None)
            except DamagedError as error:
                if not listing.lost:
                    raise
                raise listing.open_group(name) from error
            if first is None:
                raise InputError(f"{name} holds no frames. Export or download it again.")
            height, width = shown_size(stream, first)
            aspect = pixel_aspect(stream)
    if listing.lost:
        logger.warning(
            "%s: %d frames at its start refer to frames that are not in the file; they are dropped",
            name, listing.lost,
        )  # fmt: skip
    timeline.report(name)
    return VideoInfo(
        frames=timeline.count, height=height, width=width, fps=timeline.fps, timeline=timeline,
        pixel_aspect=aspect,
    )  # fmt: skip


def read_video(
    source: Path | bytes,
    *,
    start: int = 0,
    stop: int | None = None,
    whole: bool = False,
    decoding: Decoding = "accurate",
    damage: Damage = "refuse",
    each: Each | None = None,
    name: str = "the encoded video",
) -> Video:
    """Decode frames `start` (inclusive) to `stop` (exclusive; the end if None) of a video.

    A video that ends before `stop` yields fewer frames, or is refused if the `whole` range is
    wanted. Otherwise as `probe_video`; a pause outside of the range is not looked at.
    """
    with _open(source, name) as (file, name):
        listing = _list(file, name, damage)
        count = listing.timeline.count
        end = count if stop is None else min(stop, count)
        if not 0 <= start < end or (whole and stop not in (None, end)):
            last = "" if stop is None else f" to {stop - 1}"
            raise InputError(
                f"Frames {start}{last} of {name} cannot be read: it has {count}, counted from 0."
            )
        check_count(name, end - start, 0)
        moments_s = listing.timeline.moments_s(start, end)
        return _read(file, name, listing, moments_s, each, decoding=decoding, damage=damage)


@no_type_check
def read_moments(
    path: Path, times_s: Float[np.ndarray, " f"], *, each: Each | None = None
) -> Video:
    """Decode the frames nearest to increasing times, in seconds after the first frame.

    Otherwise as `read_video`.
    """
    with _open(path, "") as (file, name):
        return _read(file, name, _list(file, name, "refuse"), times_s, each)


@contextmanager
def _open(source: Path | bytes, name: str) -> Iterator[tuple[File, str]]:
    """Open a source and name it, so that FFmpeg gets bytes and never resolves a name."""
    if isinstance(source, bytes):
        yield io.BytesIO(source), name
        return
    with open_regular(source) as file:
        if not os.fstat(file.fileno()).st_size:
            raise InputError(f"{quote_path(source)} is empty (0 bytes).")
        yield file, quote_path(source)


@dataclass(frozen=True, kw_only=True)
class _Listing:
    """Frames of a video that can be decoded and are shown."""

    stamps: np.ndarray
    """Time stamp of each frame in order, in units of the stream, without repeated ones."""
    keys: list[tuple[int, int]]
    """Presentation and decoding time of every key frame, in order."""
    timeline: Timeline
    """Times of the frames and their rate."""
    lost: int
    """Number of shown frames before the first key frame, which cannot be decoded."""

    def open_group(self, name: str) -> DamagedError:
        """Return the error for frames that cannot be decoded, perhaps because of an open GOP."""
        return DamagedError(
            f"{name} is damaged, or a key frame refers to frames before it (open GOP). Encode "
            f"it again, for instance with `{convert(self.timeline.fps)}`, and look at the result."
        )


def _list(file: File, name: str, damage: Damage) -> _Listing:
    """List the frames of a video by its packets.

    Raises `InputError` if none can be decoded, and `DamagedError` for a damaged video, unless the
    frames before the damage are wanted.
    """
    stamps, keys, shown = list[int](), list[tuple[int, int]](), 0
    with open_video(file, name) as stream:
        rates = stream.average_rate, stream.guessed_rate, stream.base_rate
        rate = rates[0] or rates[1] or Fraction(1)

        def packets() -> Iterator[Packet]:
            nonlocal shown
            for packet in read_packets(stream, name):
                shown += not packet.is_discard
                yield packet

        try:
            for packet in skip_leading(packets()):
                if packet.pts is None:
                    raise InputError(
                        f"{name} has a frame without a time stamp, after {len(stamps)} others: "
                        f"each must have one. Encode it again, for instance with `{convert(rate)}`."
                    )
                if packet.is_keyframe:
                    keys.append((packet.pts, packet.pts if packet.dts is None else packet.dts))
                if not packet.is_discard:
                    stamps.append(packet.pts)
        except DamagedError:
            if damage == "refuse" or not stamps:
                raise
        unit_s = stream.time_base or Fraction(1)
    if not shown or (keys and not stamps):
        raise InputError(f"{name} holds no frames. Export or download it again.")
    if not keys:
        raise InputError(
            f"{name} has no key frame, without which no frame can be decoded. Cut it again with "
            "encoding, for instance with `ffmpeg -ss TIME -i ORIGINAL OUT`."
        )
    try:
        timeline = Timeline.of(stamps, unit_s, rates)
    except InputError as error:
        raise InputError(f"{name} does not say its frame rate.") from error
    return _Listing(
        stamps=np.unique(stamps), keys=sorted(keys), timeline=timeline, lost=shown - len(stamps)
    )


@no_type_check
def _read(
    file: File,
    name: str,
    listing: _Listing,
    times_s: Float[np.ndarray, " f"],
    each: Each | None,
    *,
    decoding: Decoding = "accurate",
    damage: Damage = "refuse",
) -> Video:
    """Decode the frames nearest to increasing times: what every reader of frames calls."""
    listing.timeline.check(name, times_s)
    stamps = listing.stamps[listing.timeline.nearest(times_s)].tolist()
    first = listing.keys[0]
    near = max((key for key in listing.keys if key[0] <= stamps[0]), default=first)
    if near != first:
        try:
            frames = _decode(file, name, near[1], stamps, each, decoding, "refuse")
            return Video(frames=frames, fps=listing.timeline.fps)
        except DamagedError:
            pass  # An open GOP may make the decoder forget frames that it has from the beginning.
    try:
        frames = _decode(file, name, None, stamps, each, decoding, damage)
    except InputError as error:
        if near == first and not (listing.lost and isinstance(error, DamagedError)):
            raise
        raise listing.open_group(name) from error
    return Video(frames=frames, fps=listing.timeline.fps)


def _decode(
    file: File,
    name: str,
    key: int | None,
    stamps: list[int],
    each: Each | None,
    decoding: Decoding,
    damage: Damage,
) -> np.ndarray:
    """Decode the frames with increasing time stamps (`decode_frames`)."""
    kept, frames, before, scaler = 0, np.empty((0,)), None, VideoReformatter()
    with open_video(file, name) as stream:
        try:
            for decoded in decode_frames(stream, name, key=key):
                stamp = stamps[0] - 1 if decoded.pts is None else decoded.pts
                if before is not None and stamp < before:
                    raise InputError(
                        f"{name} has frames whose time stamps are not in order, as H.264 in AVI. "
                        "Encode them again, for instance with `ffmpeg -i IN OUT.mp4`."
                    )
                before, frame = stamp, None
                while kept < len(stamps) and stamps[kept] == stamp:
                    if frame is None:
                        frame = to_rgb(stream, decoded, decoding, scaler)
                        frame = frame if each is None else each(frame)
                    if not kept:
                        frames = _room(name, len(stamps), frame)
                    frames[kept], kept = frame, kept + 1
                if kept == len(stamps):
                    return frames
            at_s = float(stamps[kept] * (stream.time_base or 1))
            raise damaged(name, f"its frame at {at_s:.3f} s cannot be decoded")
        except DamagedError:
            if damage == "refuse" or not kept:
                raise
            return frames[:kept]


def _room(name: str, count: int, frame: np.ndarray) -> np.ndarray:
    """Return an array for frames. Raises `InputError` above the limit."""
    if count * frame.nbytes > MAX_KEPT:
        raise InputError(
            f"{name}: {count} frames have more than {MAX_KEPT:,} bytes ({frame.nbytes:,} each), "
            "the maximum of one call."
        )
    return np.empty((count, *frame.shape), frame.dtype)
