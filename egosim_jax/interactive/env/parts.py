"""Parts of a clip: action rows that are given while the clip is made.

A causal student makes a clip chunk by chunk, so a policy or a wearer can see the frames of one part
before it gives the rows of the next. A part has a row for each frame of a chunk; the first one has
none for frame 0, which repeats the row before the clip. Any other model has one part, the clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import Backend
from egosim_jax.interactive.env.chunks import Chunk, make_chunk
from egosim_jax.interactive.env.observing import Observer
from egosim_jax.simulation.actions import split_action
from egosim_jax.simulation.simulator import OpenClip, Step
from egosim_jax.simulation.start import Start
from egosim_jax.simulation.streams import Latency, Show
from egosim_jax.types import InputError


def part_rows(chunk_frames: Sequence[int]) -> tuple[int, ...]:
    """Return the number of rows of each part, by the frames of the chunks of a clip."""
    return tuple(sum(frames) for frames in _parts(chunk_frames))


def _parts(chunk_frames: Sequence[int]) -> list[list[int]]:
    """Return the frames with rows of each part's chunks: a first chunk of frame 0 has none."""
    first, *others = chunk_frames
    if first == 1 and others:
        return [[0, others[0]], *([frames] for frames in others[1:])]
    return [[first - 1], *([frames] for frames in others)]


class OpenStep:
    """Step of an episode whose rows are given part by part."""

    def __init__(
        self,
        backend: Backend,
        spec: ActionSpec,
        start: Start,
        prompt: str | None = None,
        observer: Observer | None = None,
    ):
        """Begin the clip that follows a start, also as further cameras observe it."""
        self.start = start
        self._spec, self._video, self._prompt = spec, backend.video, prompt
        self._observer = observer
        self._parts = _parts(backend.chunk_frames)
        self._rows: list[Float[np.ndarray, "k d"]] = []
        self._clip = OpenClip(
            backend.simulator(start),
            start.state,
            seed=start.seed + start.steps + 1,
            first_frame=start.first_frame,
        )

    @property
    def done(self) -> int:
        """Number of parts that are made."""
        return len(self._rows)

    @property
    def left(self) -> int:
        """Number of parts that are not made."""
        return len(self._parts) - self.done

    @property
    def row(self) -> Float[np.ndarray, " d"]:
        """Last row of hands and camera."""
        if self._rows:
            return self._rows[-1][-1]
        return self._spec.rest if self.start.row is None else self.start.row

    @property
    def frames(self) -> UInt8[np.ndarray, "f h w 3"]:
        """Frames of the parts that are made."""
        return self._clip.frames

    def frames_of(self, camera: str) -> UInt8[np.ndarray, "f h w 3"]:
        """Frames of the parts that are made, as a further camera sees them."""
        return self._clip.others[camera].clip.frames

    @property
    def latency(self) -> Latency:
        """Latency of the last part, since its rows were given."""
        return self._latency

    def step(self, rows: object, show: Show | None = None) -> UInt8[np.ndarray, "f h w 3"]:
        """Return the frames of the next part; a short part is padded with its last row.

        `show` gets each group of frames as it is decoded. Raises `InputError` for invalid rows,
        after which the part can be given again, and after the last part.
        """
        if not self.left:
            raise InputError(
                f"All {self.done} parts of this clip are made: finish it, and begin another one."
            )
        counts = self._parts[self.done]
        chunk = make_chunk(
            self._spec,
            rows,
            start=replace(self.start, row=self.row),
            video=replace(self._video, frames=sum(counts) + 1),
            prompt=self._prompt,
        )
        begun = self.done > 0
        lengths = [counts[0] + 1, *counts[1:]] if not begun else [1, *counts]
        actions = split_action(chunk.action, lengths)[int(begun) :]
        if self._observer is not None:
            before = self._spec.rest if self.start.row is None else self.start.row
            rows_so_far = np.concatenate([before[None], *self._rows, chunk.rows[1:]])
            self._clip.simulator = self._observer.on(self._clip.simulator, rows_so_far)
        taken = len(self._clip.latencies)
        ahead = not self._clip.by_chunk
        frames = []
        for number, action in enumerate(actions):
            self._clip.put(action, show)
            if number or not ahead:
                frames.append(self._clip.take())
        if ahead:
            frames.append(self._clip.take())
        first, last = self._clip.latencies[taken], self._clip.latencies[-1]
        self._latency = Latency(first_frame_s=first.first_frame_s, last_frame_s=last.last_frame_s)
        self._rows.append(chunk.rows[1:])
        return np.concatenate(frames)

    def chunk(self) -> Chunk:
        """Return the rows and the action of the clip, once all parts are made."""
        return make_chunk(
            self._spec,
            np.concatenate(self._rows),
            start=self.start,
            video=self._video,
            prompt=self._prompt,
        )

    def finish(self) -> tuple[Chunk, Step]:
        """Return the clip's rows and action, and the step that they make."""
        chunk = self.chunk()
        return chunk, self._clip.finish(chunk.action)
