"""All sessions of a server: creation, a bounded queue of steps in threads, and resumption."""

from __future__ import annotations

import re
import secrets
import shutil
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from egosim_jax.env.backends import Backend
from egosim_jax.env.start import Start, check_size
from egosim_jax.episode import Episode
from egosim_jax.io.atomic import lock_folder
from egosim_jax.io.untrusted import quote
from egosim_jax.serving.errors import RequestError, as_request_error
from egosim_jax.serving.metrics import Metrics
from egosim_jax.serving.session import CLOSED, SETTINGS, Result, Session, request_hash, spec_of
from egosim_jax.types import InputError, check_counts, check_seed

T = TypeVar("T")
NAMES = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}")
"""Names of sessions and of what is saved."""
UNFINISHED = re.compile(r"starts|\.session\..*")
"""Names that a crash during the creation of a session leaves in its folder."""
REMOVED = ".removed-{}"
"""Name of the folder of a session while it is removed."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a server."""

    sessions: int = 64
    """Most open sessions."""
    queue: int = 32
    """Most steps that wait or run."""
    threads: int = 8
    """Most steps that run at the same time."""
    steps: int = 10_000
    """Most steps of a session."""
    saved: int = 100
    """Most starts that a session saves."""
    step_timeout_s: float = 120.0
    """Longest time that a request waits for its step, which continues without it."""

    def __post_init__(self) -> None:
        """Raise `InputError` unless all are positive."""
        check_counts({"queue": self.queue, "threads": self.threads, "sessions": self.sessions})
        check_counts({"steps of a session": self.steps, "saved starts": self.saved})
        if not self.step_timeout_s > 0:
            raise InputError(f"The timeout is {self.step_timeout_s} s: it must be positive.")


class Store:
    """Sessions in a folder, which is locked while the store is open."""

    def __init__(self, folder: Path, backend: Backend, limits: Limits, metrics: Metrics):
        self.folder, self.backend, self.limits, self.metrics = folder, backend, limits, metrics
        self.sessions: dict[str, Session] = {}
        self.damaged: dict[str, str] = {}
        self.draining = False
        self._changing = threading.Lock()
        self._queued = 0
        self._threads = ThreadPoolExecutor(limits.threads, thread_name_prefix="step")
        self._lock = lock_folder(folder)
        self._lock.__enter__()
        self._resume()

    def _resume(self) -> None:
        """Open all sessions of the folder, and finish the steps that were under way."""
        for path in self.folder.glob(REMOVED.format("*")):
            shutil.rmtree(path, ignore_errors=True)
        for path in sorted(self.folder.glob(f"*/{SETTINGS}")):
            try:
                session = Session(path.parent, self.backend)
                number = session.committed + 1
                key = (number, session.request(number)) if session.pending else None
            except (InputError, OSError, ValueError, KeyError, TypeError, IndexError) as error:
                self.damaged[path.parent.name] = str(error)
                print(f"session {path.parent.name} is not resumed: {error}", file=sys.stderr)
                continue
            self.sessions[session.id] = session
            if key is not None:
                session.flight = key, self.submit(session, session.finish, bounded=False)
        self.metrics.sessions.set(len(self.sessions))

    def close(self) -> None:
        """Refuse new requests, wait for the steps that run or wait, then unlock the folder."""
        self.draining = True
        self._threads.shutdown(wait=True)
        self._lock.__exit__(None, None, None)

    def get(self, session_id: object) -> Session:
        """Return a session. Raises `RequestError` if there is none of that id."""
        session = self.sessions.get(session_id) if isinstance(session_id, str) else None
        if session is not None:
            return session
        if isinstance(session_id, str) and session_id in self.damaged:
            raise RequestError(
                410,
                "damaged_session",
                f"Session {session_id} could not be resumed: {self.damaged[session_id]}",
            )
        raise RequestError(
            404,
            "unknown_session",
            f"There is no session {quote(session_id)}: session must be an id that create has "
            "returned and that is not closed. Create one.",
        )

    def create(self, request: Mapping[str, Any]) -> Session:
        """Create a session of a seed or episode, with the id that is asked for or a new one."""
        self._check_open()
        actions = spec_of(_mapping(request.get("actions", {}), "actions"))
        start = self._start(request, actions)
        name = request.get("session", secrets.token_hex(8))
        with self._changing:
            if len(self.sessions) >= self.limits.sessions:
                raise RequestError(
                    429,
                    "too_many_sessions",
                    f"{len(self.sessions)} sessions are open, the most of this server is "
                    f"{self.limits.sessions}. Close one, or try again later.",
                    retry_after_s=5.0,
                )
            folder = self.folder / check_name(name, "session")
            if folder.is_dir() and all(UNFINISHED.fullmatch(p.name) for p in folder.iterdir()):
                shutil.rmtree(folder)
            if name in self.sessions or folder.exists():
                raise RequestError(
                    409,
                    "session_exists",
                    f"There is a session {quote(name)} already: choose another id, or none for a "
                    "new one.",
                )
            session = Session.create(folder, self.backend, actions, start)
            self.sessions[session.id] = session
            self.metrics.sessions.set(len(self.sessions))
        return session

    def _start(self, request: Mapping[str, Any], actions: Any) -> Start:
        """Return the start that a request chooses: `seed`, or the bytes of an `episode`."""
        seed, prompt = request.get("seed", 0), request.get("prompt")
        if isinstance(seed, bool) or not isinstance(seed, int):
            raise InputError(f"seed is {quote(seed)}: it must be a whole number from 0.")
        check_seed(seed, name="seed")
        if prompt is not None and not (isinstance(prompt, str) and len(prompt) <= 2000):
            raise InputError(f"prompt is {quote(prompt)}: it must be a text of at most 2000.")
        if (data := request.get("episode")) is not None:
            if not isinstance(data, bytes):
                raise InputError(f"episode is {quote(data)}: it must be the bytes of a .zip.")
            start = Start.of(Episode.from_bytes(data), seed=seed)
        else:
            start = self.backend.start(seed, actions)
        check_size(start, self.backend.video)
        return start if prompt is None else replace(start, prompt=prompt)

    def step(self, request: Mapping[str, Any]) -> Future[Result]:
        """Queue a step of a session."""
        session = self.get(request.get("session"))
        step_id, prompt = request.get("step_id"), request.get("prompt")
        if isinstance(step_id, bool) or not isinstance(step_id, int) or step_id < 1:
            raise InputError(
                f"step_id is {quote(step_id)}: it must be a whole number, one more than the last "
                f"committed step. Send {session.committed + 1}."
            )
        if prompt is not None and not (isinstance(prompt, str) and len(prompt) <= 2000):
            raise InputError(f"prompt is {quote(prompt)}: it must be a text of at most 2000.")
        if step_id > self.limits.steps:
            raise RequestError(
                429,
                "too_many_steps",
                f"Step {step_id} is more than a session's {self.limits.steps}: create a new one.",
            )
        if "actions" not in request:
            raise InputError("The step has no actions: give rows of numbers.")
        rows = request["actions"]
        flight = session.flight
        key = step_id, request_hash(rows, prompt)
        if flight is not None and flight[0] == key and not flight[1].done():
            return flight[1]  # a client that vanished and came back waits for its step
        run = partial(session.step, step_id, rows, prompt)
        if step_id <= session.committed:
            return self.submit(session, run, exclusive=False)
        future = self.submit(session, run)
        session.flight = key, future
        return future

    def reset(self, request: Mapping[str, Any]) -> Future[Result]:
        """Queue a reset of a session to a seed or episode, or to its own first start."""
        session = self.get(request.get("session"))

        def run() -> Result:
            if "seed" not in request and "episode" not in request:
                return session.restart(Start.load(session.folder / "starts" / "0"))
            return session.restart(self._start(request, session.actions))

        return self.submit(session, run)

    def save(self, request: Mapping[str, Any]) -> Future[str]:
        """Queue the saving of a session under a name."""
        session, name = self.get(request.get("session")), request.get("name")
        check_name(name, "name")

        def run() -> str:
            saved = session.saved
            if len(saved) >= self.limits.saved and name not in saved:
                raise RequestError(
                    429,
                    "too_many_saved",
                    f"The session has saved {len(saved)} starts, the most is {self.limits.saved}. "
                    "Save under one of their names.",
                )
            session.save(str(name))
            return str(name)

        return self.submit(session, run)

    def load(self, request: Mapping[str, Any]) -> Future[Result]:
        """Queue the return of a session to what it has saved."""
        session, name = self.get(request.get("session")), request.get("name")
        return self.submit(session, lambda: session.load(check_name(name, "name")))

    def remove(self, request: Mapping[str, Any]) -> Future[str]:
        """Queue the end of a session, and the removal of its folder unless `keep` is true."""
        session, keep = self.get(request.get("session")), request.get("keep", False)
        if not isinstance(keep, bool):
            raise InputError(f"keep is {quote(keep)}: it must be true or false.")

        removed = self.folder / REMOVED.format(session.id)

        def run() -> str:
            with self._changing:
                if keep:
                    (session.folder / SETTINGS).rename(session.folder / CLOSED)
                else:
                    shutil.rmtree(removed, ignore_errors=True)
                    session.folder.rename(removed)
                self.sessions.pop(session.id, None)
                self.metrics.sessions.set(len(self.sessions))
            shutil.rmtree(removed, ignore_errors=True)
            return session.id

        return self.submit(session, run)

    def submit(
        self,
        session: Session,
        run: Callable[[], T],
        *,
        exclusive: bool = True,
        bounded: bool = True,
    ) -> Future[T]:
        """Run a request of a session in a thread; a `bounded` one is refused if the queue is full.

        Of the `exclusive` ones, which change the session, another one must not be under way.
        """
        self._check_open()
        with self._changing:
            if bounded and self._queued >= self.limits.queue:
                self.metrics.refused.labels("queue_full").inc()
                raise RequestError(
                    429,
                    "queue_full",
                    f"{self._queued} requests wait or run, the most of this server is "
                    f"{self.limits.queue}. Send it again later.",
                    retry_after_s=1.0,
                )
            if exclusive and not session.busy.acquire(blocking=False):
                self.metrics.refused.labels("session_busy").inc()
                raise RequestError(
                    409,
                    "session_busy",
                    f"Session {session.id} has a request under way: one at a time can change it. "
                    "Wait for its reply, then send this one again.",
                    retry_after_s=0.5,
                )
            self._queued += 1
            self.metrics.queued.set(self._queued)
        return self._threads.submit(self._run, session, run, exclusive)

    def _run(self, session: Session, run: Callable[[], T], exclusive: bool) -> T:
        then = time.monotonic()
        try:
            return run()
        except Exception as error:
            found = as_request_error(error)
            if found.code == "internal":
                traceback.print_exc()
            self.metrics.refused.labels(found.code).inc()
            raise found from error
        finally:
            if exclusive:
                session.flight = None
                session.busy.release()
            with self._changing:
                self._queued -= 1
                self.metrics.queued.set(self._queued)
            self.metrics.seconds.observe(time.monotonic() - then)

    def _check_open(self) -> None:
        if self.draining:
            raise RequestError(
                503,
                "draining",
                "The server is shutting down: it finishes what runs and takes nothing new. Connect "
                "again when it is back; all sessions are kept.",
                retry_after_s=10.0,
            )


def check_name(name: object, what: str) -> str:
    """Return a name that is safe as a folder's. Raises `InputError` for any other."""
    if not isinstance(name, str) or not NAMES.fullmatch(name):
        raise InputError(
            f"{what} is {quote(name)}: it must have 1 to 64 letters, digits, _ or -, and begin "
            "with a letter or digit."
        )
    return name


def _mapping(value: object, what: str) -> Mapping[str, Any]:
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise InputError(f"{what} is {quote(value)}: it must be a map from names to values.")
    return value
