"""Parts of steps: rows that a client gives while the clip of a step is made.

Nothing of a step is on disk before its last part, which commits the step. After a crash the client
begins the step again, with part 1.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field
from typing import no_type_check

import numpy as np
from jaxtyping import UInt8

from egosim_jax.interactive.env.parts import OpenStep
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.requests import request_hash
from egosim_jax.interactive.server.session import Result, Session
from egosim_jax.simulation.simulator import Latency, Show


@no_type_check
@dataclass(frozen=True, kw_only=True)
class PartResult:
    """Result of a part of a step, before the last one."""

    step_id: int
    """Number of the step."""
    part: int
    """Number of the part, from 1."""
    frames: UInt8[np.ndarray, "f h w 3"]
    """Frames of the part."""
    row: np.ndarray
    """Last row of hands and camera."""
    latency: Latency
    """Seconds from the rows to the frames."""


@dataclass
class _OpenParts:
    """Step of a session whose parts are being given."""

    step: OpenStep
    results: list[PartResult] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)
    """Hash of the request of each part."""
    since: float = field(default_factory=time.monotonic)
    """Time of the last part."""


class Parts:
    """Steps whose parts are being given, at most one in each session and `most` in all.

    Each one occupies memory of the device. One without a part for `idle_s` makes room for others.
    """

    def __init__(self, *, most: int, idle_s: float):
        self._most, self._idle_s = most, idle_s
        self._open: dict[str, _OpenParts] = {}
        self._changing = threading.Lock()

    def step(
        self,
        session: Session,
        step_id: int,
        part: int,
        rows: object,
        prompt: str | None,
        show: Show | None = None,
    ) -> PartResult | Result:
        """Make the next part of a session's next step, or return the result of a part it has made.

        Part 1 begins the step again, unless it is repeated. The first part's prompt counts. Raises
        `RequestError` for a part out of order, for another action under a used number, and while
        too many steps are open.
        """
        request = request_hash(rows, prompt, part)
        if (known := session.committed_result(step_id, request)) is not None:
            return known
        found = self._open.get(session.id)
        if found is not None and found.step.start is not session.now:
            found = None  # a step, reset or load came between
        done = 0 if found is None else len(found.results)
        if found is not None and part <= done and found.requests[part - 1] == request:
            return found.results[part - 1]
        if part not in (1, done + 1):
            raise RequestError(
                409,
                "part_out_of_order",
                f"Part {part} of step {step_id} cannot follow part {done}: parts are made once "
                f"and in order. Send part {done + 1}, or begin the step again with part 1.",
            )
        if found is None or part == 1:
            found = self._begin(session, prompt)
        try:
            frames = found.step.step(rows, show)
        except Exception:
            self._close(session)  # no part can follow one that failed
            raise
        if not found.step.left:
            self._close(session)
            return session.commit(step_id, found.step.chunk(), request, frames=found.step.frames)
        result = PartResult(
            step_id=step_id,
            part=part,
            frames=frames,
            row=found.step.row,
            latency=found.step.latency,
        )
        found.results.append(result)
        found.requests.append(request)
        found.since = time.monotonic()
        return result

    def _begin(self, session: Session, prompt: str | None) -> _OpenParts:
        """Open the parts of a session's next step."""
        with self._changing:
            self._open.pop(session.id, None)
            now = time.monotonic()
            for name, other in list(self._open.items()):
                if len(self._open) >= self._most and now - other.since > self._idle_s:
                    del self._open[name]
            if len(self._open) >= self._most:
                raise RequestError(
                    429,
                    "too_many_open_steps",
                    f"The parts of {len(self._open)} steps are being given, the maximum of this "
                    f"server is {self._most}. Give the step at once, or send it again later.",
                    retry_after_s=1.0,
                )
            step = OpenStep(session.backend, session.actions, session.now, prompt)
            found = self._open[session.id] = _OpenParts(step)
        return found

    def _close(self, session: Session) -> None:
        with self._changing:
            self._open.pop(session.id, None)
