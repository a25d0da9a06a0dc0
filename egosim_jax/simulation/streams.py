"""Generators of clips, and the streams of their frames.

A generator is a function from view, action, first frame and seed to frames. It may also yield the
frames in groups, or make a clip chunk by chunk. `begin` gives all of them one interface.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from egosim_jax.types import Action, View
from egosim_jax.types.arrays import RgbImage, Video

Show = Callable[[UInt8[np.ndarray, "g h w 3"]], None]
"""Callback for each decoded group of frames."""


@runtime_checkable
class VideoGenerator(Protocol):
    """Function that generates the video of an action.

    Its attributes `renderer`, `point_px` and `prior`, if it has them, replace the NumPy renderer,
    the default side of a point in pixels, and a view of objects at rest.
    """

    def __call__(self, view: View, action: Action, first_frame: RgbImage, seed: int) -> Video:
        """Generate the frames of a clip, of the view's number and size."""
        ...


@runtime_checkable
class StreamedGenerator(VideoGenerator, Protocol):
    """Generator that yields the first frames of a video before it has the last ones."""

    def stream(
        self, view: View, action: Action, first_frame: RgbImage, seed: int
    ) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the frames of a clip in order, in groups."""
        ...


@runtime_checkable
class ClipStream(Protocol):
    """Clip that is generated chunk by chunk: conditions in (`put`), frames out (`take`)."""

    def put(self, view: View, action: Action) -> None:
        """Begin the next chunk, from the view and the action of its frames; do not wait for it."""
        ...

    def take(self) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the frames of the oldest chunk that was put, in groups, as they are decoded."""
        ...


@runtime_checkable
class ChunkedGenerator(VideoGenerator, Protocol):
    """Generator whose clips may get the conditions of each chunk once the one before is seen."""

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip."""
        ...

    def begin(self, first_frame: RgbImage, seed: int) -> ClipStream:
        """Begin a clip."""
        ...


@runtime_checkable
class BatchedGenerator(VideoGenerator, Protocol):
    """Generator that batches the clips that several threads request."""

    def announced(self) -> AbstractContextManager[None]:
        """Announce a clip that this thread requests inside the context: batches wait for it."""
        ...


@dataclass(frozen=True, kw_only=True)
class Latency:
    """Seconds from an action to its frames; all latencies compare equal, so equal steps stay so."""

    first_frame_s: float = field(compare=False)
    """Time until the first frames are decoded."""
    last_frame_s: float = field(compare=False)
    """Time until the last frames are decoded."""


@dataclass
class FrameTimer:
    """Callback for each decoded group of frames that measures their latency."""

    show: Show | None = None
    """Callback to call too."""
    since: float = field(default_factory=time.monotonic)
    """Time of the action."""
    times: list[float] = field(default_factory=list)
    """Seconds from the action to each group."""

    def __call__(self, frames: UInt8[np.ndarray, "g h w 3"]) -> None:
        """Note the time, and show the frames."""
        self.times.append(time.monotonic() - self.since)
        if self.show is not None:
            self.show(frames)

    @property
    def latency(self) -> Latency:
        """Latency of the groups so far; there must be one."""
        return Latency(first_frame_s=self.times[0], last_frame_s=self.times[-1])


def chunk_frames(generator: VideoGenerator) -> tuple[int, ...] | None:
    """Return the frames of each chunk of a generator; None: one chunk of any length."""
    return generator.chunk_frames if isinstance(generator, ChunkedGenerator) else None


def begin(generator: VideoGenerator, first_frame: RgbImage, seed: int) -> ClipStream:
    """Begin a clip; a generator that makes clips at once gets one chunk."""
    if isinstance(generator, ChunkedGenerator):
        return generator.begin(first_frame, seed)
    return WholeClip(generator, first_frame, seed)


@dataclass
class WholeClip:
    """Clip of a generator that makes clips at once, as one chunk (`ClipStream`)."""

    generator: VideoGenerator
    """Generator of the clip."""
    first_frame: UInt8[np.ndarray, "h w 3"]
    """First frame of the clip."""
    seed: int
    """Seed of the clip."""
    given: list[tuple[View, Action]] = field(default_factory=list)
    """View and action of the clip, once they are put."""

    def put(self, view: View, action: Action) -> None:
        """Give the view and the action of the clip."""
        self.given.append((view, action))

    def take(self) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the frames of the clip, in groups if the generator streams."""
        ((view, action),) = self.given
        given = view, action, self.first_frame, self.seed
        if isinstance(self.generator, StreamedGenerator):
            yield from self.generator.stream(*given)
        else:
            yield np.asarray(self.generator(*given))


@dataclass(frozen=True)
class KeptStream:
    """Chunks of a clip that was made before (`ClipStream`)."""

    chunks: Iterator[UInt8[np.ndarray, "f h w 3"]]
    """Frames of each chunk."""

    def put(self, view: View, action: Action) -> None:
        """Begin the next chunk; its frames are known."""

    def take(self) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the frames of the next chunk."""
        yield next(self.chunks)
