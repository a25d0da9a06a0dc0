"""List the frames of a video by its packets, without decoding them."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from av.packet import Packet
from av.video.stream import VideoStream

from egosim_jax.io.decoding import Damage, DamagedError, read_packets, skip_leading
from egosim_jax.io.timing import Timeline, convert
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Listing:
    """Frames of a video that can be decoded and are shown."""

    stamps: np.ndarray
    """Time stamp of each frame in order, in units of the stream, without repeated ones."""
    unit_s: Fraction
    """Unit of the stream in seconds."""
    keys: list[tuple[int, int]]
    """Presentation and decoding time of every key frame, in order."""
    timeline: Timeline
    """Times of the frames and their rate."""
    lost: int
    """Number of shown frames before the first key frame, which cannot be decoded."""
    cut: bool
    """True if the file has any frames before the first key frame."""

    def undecodable(self, name: str) -> DamagedError:
        """Return the error for frames that cannot be decoded from a key frame after an open GOP."""
        return DamagedError(
            f"{name} is damaged, or a key frame refers to frames before it (open GOP). Encode "
            f"it again, for instance with `{convert(self.timeline.fps)}`, and look at the result."
        )

    def report(self, name: str) -> None:
        """Log which frames are dropped or missing."""
        if self.lost:
            logger.warning(
                "%s: %d frames at its start refer to frames that are not in the file; they are "
                "dropped",
                name, self.lost,
            )  # fmt: skip
        self.timeline.report(name)


def list_frames(
    stream: VideoStream, name: str, max_frames: int, *, damage: Damage = "refuse"
) -> Listing:
    """List the frames of a stream.

    Raises `InputError` if none can be decoded or one has no time stamp, and `DamagedError` for a
    damaged video, unless the frames before the damage are wanted.
    """
    shown = count = 0
    stamps, keys, used = list[int](), list[tuple[int, int]](), 0

    def packets() -> Iterator[Packet | None]:
        nonlocal shown, count
        for packet in read_packets(stream, name, max_frames):
            count += packet is not None
            shown += packet is not None and not packet.is_discard
            yield packet

    rate = stream.average_rate or stream.guessed_rate or Fraction(1)
    try:
        for packet in skip_leading(packets()):
            if packet is None:
                continue
            used += 1
            if packet.pts is None:
                raise InputError(
                    f"{name} has a frame without a time stamp, after {len(stamps)} others: each "
                    f"must have one. Encode it again, for instance with `{convert(rate)}`."
                )
            if packet.is_keyframe:
                keys.append((packet.pts, packet.pts if packet.dts is None else packet.dts))
            if not packet.is_discard:
                stamps.append(packet.pts)
    except DamagedError:
        if damage == "refuse" or not stamps:
            raise
    if not shown or (keys and not stamps):
        raise InputError(f"{name} holds no frames. Export or download it again.")
    if not keys:
        raise InputError(
            f"{name} has no key frame, without which no frame can be decoded. Cut it again with "
            "encoding, for instance with `ffmpeg -ss TIME -i ORIGINAL OUT`."
        )
    unit_s = stream.time_base or Fraction(1)
    rates = (stream.average_rate, stream.guessed_rate, stream.base_rate)
    try:
        timeline = Timeline.of(stamps, unit_s, rates)
    except InputError as error:
        raise InputError(f"{name} does not say its frame rate.") from error
    return Listing(
        stamps=np.unique(stamps),
        unit_s=unit_s,
        keys=sorted(keys),
        timeline=timeline,
        lost=shown - len(stamps),
        cut=used < count,
    )
