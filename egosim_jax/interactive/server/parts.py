"""Parts of steps: rows that a client gives while the clip of a step is made.

Nothing of a step is on disk before its last part, which commits the step. After a crash the client
begins the step again, with part 1.
"""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field

from egosim_jax.interactive.env.parts import OpenStep
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.requests import request_hash
from egosim_jax.interactive.server.session import Result, Session
from egosim_jax.simulation.streams import Show


@dataclass
class _OpenParts:
    """Step of a session whose parts are being given."""

    step: OpenStep
    results: list[Result] = field(default_factory=list)
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
    ) -> Result:
        """Make the next part of a session's next step, or return the result of a part it has made.

        Part 1 begins the step again, unless it is repeated. The first part's prompt counts. Raises
        `RequestError` for a part out of order, for another action under a used number, and while
        too many steps are open.
        """
        request = request_hash(rows, prompt, part)
        if (committed := session.committed_result(step_id, request)) is not None:
            return committed
        made = self._open.get(session.id)
        if made is not None and made.step.start is not session.now:
            made = None  # a step, reset or load came between
        done = 0 if made is None else len(made.results)
        if made is not None and part <= done and made.requests[part - 1] == request:
            return made.results[part - 1]
        if part not in (1, done + 1):
            raise RequestError(
                409,
                "part_out_of_order",
                f"Part {part} of step {step_id} cannot follow part {done}: parts are made once "
                f"and in order. Send part {done + 1}, or begin the step again with part 1.",
            )
        if made is None or part == 1:
            made = self._begin(session, prompt)
        step, now = made.step, session.now
        try:
            frames = step.step(rows, show)
        except Exception:
            self._open.pop(session.id, None)  # no part can follow one that failed
            raise
        if not step.left:
            self._open.pop(session.id, None)
            return session.commit(step_id, step.chunk(), request, frames=step.frames)
        result = Result(
            step_id=step_id,
            frames=frames,
            state=now.state,
            row=step.row,
            camera=now.camera,
            info={},
            part=part,
            latency=step.latency,
        )
        made.results.append(result)
        made.requests.append(request)
        made.since = time.monotonic()
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
            made = self._open[session.id] = _OpenParts(step)
        return made
