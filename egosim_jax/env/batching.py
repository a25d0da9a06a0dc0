"""Clips of many callers, generated together by one program.

Each caller runs in its thread and calls the batcher like the generator. A thread of the batcher
takes what waits and runs the program of the largest batch size that it fills, so that nothing is
padded but to the devices of a mesh. It waits for callers that have announced themselves, for a
moment at most: while one batch runs, the next one gathers.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cached_property
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from egosim_jax.rendering import Renderer
from egosim_jax.simulator import VideoGenerator
from egosim_jax.types import Action, Clip, InputError, Triplet, View, check_counts, check_seed


@runtime_checkable
class BatchGenerator(VideoGenerator, Protocol):
    """Generator of several clips in one program (`generator.Generator`)."""

    renderer: Renderer

    def condition(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"]
    ) -> Triplet:
        """Return the conditions of a clip."""
        ...

    def generate(self, triplets: Sequence[Triplet], seeds: Sequence[int]) -> list[Clip]:
        """Generate a clip for each triplet."""
        ...

    def fingerprint(self) -> str:
        """Return the content hash of config and weights."""
        ...


class _Request(NamedTuple):
    triplet: Triplet
    seed: int
    since: float
    result: Future[UInt8[np.ndarray, "f h w 3"]]


class Batcher:
    """Generator that gathers the clips of several threads (`simulator.VideoGenerator`)."""

    def __init__(
        self, generator: BatchGenerator, *, most: int = 8, unit: int = 1, wait_s: float = 0.05
    ):
        """`unit` is the number of parts of a mesh that divides batches; `most` a multiple of it."""
        check_counts({"batch size": most, "parts of the mesh": unit})
        if most % unit:
            raise InputError(
                f"Batches of {most} clips cannot be divided over {unit} parts of the devices: give "
                f"a multiple of {unit}. (--batch)"
            )
        self.renderer = generator.renderer
        self._generator = generator
        self.sizes = [unit]
        while 2 * self.sizes[-1] <= most:
            self.sizes.append(2 * self.sizes[-1])
        if self.sizes[-1] < most:
            self.sizes.append(most)
        self._wait_s = wait_s
        self._waiting: list[_Request] = []
        self._coming = 0
        self._changed = threading.Condition()
        self._caller = threading.local()
        self._closed = False
        self.runs: dict[int, int] = dict.fromkeys(self.sizes, 0)
        """Number of runs of the program of each batch size."""
        self._thread = threading.Thread(target=self._work, name="batcher", daemon=True)
        self._thread.start()

    @cached_property
    def _fingerprint(self) -> str:
        return self._generator.fingerprint()

    def fingerprint(self) -> str:
        """Return the generator's content hash: batching is no property of a clip."""
        return self._fingerprint

    @contextmanager
    def announced(self) -> Iterator[None]:
        """Announce a clip that this thread will ask for, unless it fails before."""
        with self._changed:
            self._coming += 1
        self._caller.announced = True
        try:
            yield
        finally:
            self._arrive()

    def _arrive(self) -> None:
        if getattr(self._caller, "announced", False):
            self._caller.announced = False
            with self._changed:
                self._coming -= 1
                self._changed.notify_all()

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """Generate one clip together with those of other threads."""
        check_seed(seed, name="seed")
        triplet = self._generator.condition(view, action, first_frame)
        request = _Request(triplet, seed, time.monotonic(), Future())
        with self._changed:
            if self._closed:
                raise InputError("The generator is closed: it takes no more clips.")
            self._waiting.append(request)
            self._changed.notify_all()
        self._arrive()
        return request.result.result()

    def close(self) -> None:
        """Generate what waits, then end."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _work(self) -> None:
        while batch := self._next():
            self._run(batch)

    def _next(self) -> list[_Request]:
        """Wait for requests; return those of the next run, none when closed."""
        with self._changed:
            while not self._waiting:
                if self._closed:
                    return []
                self._changed.wait()
            until = self._waiting[0].since + self._wait_s
            while len(self._waiting) < self.sizes[-1] and self._coming:
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
            clips = self._generator.generate(
                [request.triplet for request in padded], [request.seed for request in padded]
            )
        except Exception as error:
            if len(batch) == 1:
                batch[0].result.set_exception(error)
                return
            for request in batch:  # so that one clip's failure is not the others'
                self._run([request])
            return
        self.runs[size] += 1
        for request, clip in zip(batch, clips, strict=False):
            request.result.set_result(clip.frames)


def announced(generator: VideoGenerator) -> AbstractContextManager[None]:
    """Return the context in which a thread will ask a generator for a clip."""
    return generator.announced() if isinstance(generator, Batcher) else nullcontext()
