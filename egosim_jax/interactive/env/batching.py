"""Batching of clips that many threads request.

Each caller calls the batcher like a generator, in its own thread. The batcher's thread drains the
queue into the largest batch size that it can fill and that is compiled. It pads only to the number
of devices. Before a batch it waits up to `wait_s` for callers that have announced a clip. The next
batch gathers while one runs.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cached_property
from queue import SimpleQueue
from typing import Any, no_type_check

import numpy as np
from jaxtyping import UInt8

from egosim_jax.rendering import PriorKind
from egosim_jax.runtime.terminal import printable
from egosim_jax.simulation.streams import ClipStream, VideoGenerator, WholeClip
from egosim_jax.types import Action, InputError, Triplet, View, check_counts, check_seed

COMPILER = "compiler"
"""Name of the thread that compiles for larger batches."""


@no_type_check
@dataclass(eq=False, kw_only=True)
class _Request:
    """Clip that a caller waits for, with a queue of its decoded frames."""

    triplet: Triplet
    seed: int
    since: float = field(default_factory=time.monotonic)
    _groups: SimpleQueue = field(default_factory=SimpleQueue)
    _sent: int = 0

    def send(self, number: int, frames: UInt8[np.ndarray, "g h w 3"]) -> None:
        """Queue a group of frames, unless an earlier run of the clip already sent it."""
        if number == self._sent:
            self._groups.put(frames)
            self._sent += 1

    def end(self, error: Exception | None = None) -> None:
        """End the groups; the caller then continues, or raises the error."""
        self._groups.put(error)

    def receive(self) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the groups, in the caller's thread."""
        while (group := self._groups.get()) is not None:
            if isinstance(group, Exception):
                raise group
            yield group


class Batcher:
    """Generator that batches the clips of several threads (`streams.StreamedGenerator`)."""

    def __init__(self, generator: Any, *, max_batch: int = 8, unit: int = 1, wait_s: float = 0.05):
        """Start the thread of a `generation.generator.Generator`, or of one with its methods.

        `unit` is the number of mesh parts that share a batch.
        """
        check_counts({"batch size": max_batch, "parts of the mesh": unit})
        if max_batch % unit:
            raise InputError(
                f"Batches of {max_batch} clips cannot be divided over {unit} parts of the devices: "
                f"give a multiple of {unit}. (--batch)"
            )
        self.renderer = generator.renderer
        self.point_px = generator.point_px
        self.prior: PriorKind = generator.prior
        self._generator = generator
        self.sizes = [unit]
        # powers of two keep the number of programs to compile small
        while 2 * self.sizes[-1] <= max_batch:
            self.sizes.append(2 * self.sizes[-1])
        if self.sizes[-1] < max_batch:
            self.sizes.append(max_batch)
        self._wait_s = wait_s
        self._waiting: list[_Request] = []
        self._announced = 0
        self._changed = threading.Condition()
        self._caller = threading.local()
        self._closed = False
        self.runs: dict[int, int] = dict.fromkeys(self.sizes, 0)
        """Number of runs by batch size."""
        self._thread = threading.Thread(target=self._work, name="batcher", daemon=True)
        self._thread.start()

    def compile(self, *, behind: bool = False) -> None:
        """Compile the generator for all batch sizes.

        With `behind` only the smallest is compiled now, and the others in a thread: until one is
        ready, smaller batches take its clips.
        """
        if not behind:
            self._generator.compile(*self.sizes, streamed=True)
            return
        first, *larger = self.sizes
        self._generator.compile(first, streamed=True)
        self.sizes = [first]
        threading.Thread(target=self._add, args=(larger,), name=COMPILER, daemon=True).start()

    def _add(self, sizes: list[int]) -> None:
        """Compile further batch sizes, and take each as soon as it is compiled."""
        for size in sizes:
            if self._closed:
                return
            try:
                self._generator.compile(size, streamed=True)
            except Exception as error:  # such as too little memory of the device
                print(
                    f"batches of {size} clips cannot be compiled, so at most {self.sizes[-1]} are "
                    f"generated at once: {printable(error)}",
                    file=sys.stderr,
                    flush=True,
                )
                return
            with self._changed:
                self.sizes = [*self.sizes, size]

    @cached_property
    def _fingerprint(self) -> str:
        return self._generator.fingerprint()

    def fingerprint(self) -> str:
        """Return the generator's content hash; batching does not change a clip."""
        return self._fingerprint

    @property
    def chunk_frames(self) -> tuple[int, ...]:
        """Frames of each chunk of a clip."""
        return self._generator.chunk_frames

    def begin(self, first_frame: UInt8[np.ndarray, "h w 3"], seed: int) -> ClipStream:
        """Begin a clip. A clip of several chunks, given one after the other, is not batched."""
        if len(self.chunk_frames) == 1:
            return WholeClip(self, first_frame, seed)
        return self._generator.begin(first_frame, seed)

    @contextmanager
    def announced(self) -> Iterator[None]:
        """Announce a clip that this thread requests inside the context, unless it fails first."""
        with self._changed:
            self._announced += 1
        self._caller.announced = True
        try:
            yield
        finally:
            self._arrive()

    def _arrive(self) -> None:
        if getattr(self._caller, "announced", False):
            self._caller.announced = False
            with self._changed:
                self._announced -= 1
                self._changed.notify_all()

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """Generate one clip, batched with the clips of other threads."""
        return np.concatenate(list(self.stream(view, action, first_frame, seed)))

    def stream(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the frames of one clip in groups, as its batch is decoded."""
        check_seed(seed, name="seed")
        request = _Request(triplet=self._generator.condition(view, action, first_frame), seed=seed)
        with self._changed:
            if self._closed:
                raise InputError("The generator is closed: it takes no more clips.")
            self._waiting.append(request)
            self._changed.notify_all()
        self._arrive()
        yield from request.receive()

    def close(self) -> None:
        """Generate the waiting clips, then end the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _work(self) -> None:
        while batch := self._next():
            self._run(batch)

    def _next(self) -> list[_Request]:
        """Wait for requests; return the next batch, empty when closed."""
        with self._changed:
            while not self._waiting:
                if self._closed:
                    return []
                self._changed.wait()
            # the oldest request sets the deadline: later ones must not delay it further
            until = self._waiting[0].since + self._wait_s
            while len(self._waiting) < self.sizes[-1] and self._announced:
                left = until - time.monotonic()
                if left <= 0:
                    break
                self._changed.wait(left)
            count = max([n for n in self.sizes if n <= len(self._waiting)], default=self.sizes[0])
            batch, self._waiting = self._waiting[:count], self._waiting[count:]
        return batch

    def _run(self, batch: list[_Request]) -> None:
        size = min(n for n in self.sizes if n >= len(batch))
        padded = [*batch, *[batch[-1]] * (size - len(batch))]
        try:
            groups = self._generator.groups(
                [request.triplet for request in padded], [request.seed for request in padded]
            )
            for number, group in enumerate(groups):
                for request, frames in zip(batch, group, strict=False):
                    request.send(number, frames)
        except Exception as error:
            if len(batch) == 1:
                batch[0].end(error)
                return
            for request in batch:  # one bad clip must not fail the others
                self._run([request])
            return
        self.runs[size] += 1
        for request in batch:
            request.end()


def announced(generator: VideoGenerator) -> AbstractContextManager[None]:
    """Return the context in which a thread requests a clip; only a `Batcher` counts it."""
    return generator.announced() if isinstance(generator, Batcher) else nullcontext()


def is_compiling() -> bool:
    """Return True while a thread compiles for larger batches; Python cannot end it."""
    return any(thread.name == COMPILER for thread in threading.enumerate())
