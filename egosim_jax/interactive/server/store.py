"""Store of all sessions of a server: creation, a bounded queue with worker threads, resumption."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from egosim_jax.interactive.env.action_spec import ActionSpec
from egosim_jax.interactive.env.backends import Backend
from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server.errors import RequestError, as_request_error
from egosim_jax.interactive.server.parts import Parts
from egosim_jax.interactive.server.prometheus import Metrics
from egosim_jax.interactive.server.requests import (
    cameras_of,
    check_integer,
    check_mapping,
    check_name,
    part_of,
    prompt_of,
    request_hash,
)
from egosim_jax.interactive.server.session import (
    CLOSED,
    DAMAGE,
    SETTINGS,
    Result,
    Session,
    check_world,
)
from egosim_jax.io.atomic import atomic_write, lock_folder
from egosim_jax.io.bounded import only_inside, quote, quote_path
from egosim_jax.runtime.terminal import printable
from egosim_jax.simulation.episode import Episode
from egosim_jax.simulation.rig import check_cameras
from egosim_jax.simulation.start import Start, check_size
from egosim_jax.simulation.streams import Show
from egosim_jax.types import InputError

T = TypeVar("T")
MAX_SEED = 2**63 - 1_000_000
"""Maximum seed of a session: the seed of a step is larger by up to the number of steps."""
MIN_FREE_BYTES = 4 << 20
"""Minimum free space on the disk of a server that is ready, in bytes; a step writes about 1 MiB."""
REMOVED = ".removed-{}"
"""Name of a session's folder while it is deleted."""
PROBE = ".probe"
"""Name of a file that is written to know whether the disk has space."""


class Store:
    """Sessions in a folder; the folder is locked while the store is open."""

    def __init__(self, folder: Path, backend: Backend, limits: Limits):
        self.folder, self.backend, self.limits = folder, backend, limits
        self.metrics = Metrics()
        self.parts = Parts(most=limits.open_steps, idle_s=limits.step_timeout)
        self.sessions: dict[str, Session] = {}
        self.damaged: dict[str, str] = {}
        self.draining = False
        self._reserved: set[str] = set()
        self._changing = threading.Lock()
        self._queued = 0
        self._threads = ThreadPoolExecutor(limits.threads, thread_name_prefix="step")
        self._lock = lock_folder(folder)
        self._lock.__enter__()
        self._resume()

    def _resume(self) -> None:
        """Open all sessions of the folder, and finish interrupted steps."""
        for path in self.folder.glob(REMOVED.format("*")):
            shutil.rmtree(path, ignore_errors=True)
        for path in sorted(self.folder.glob(f"[!.]*/{SETTINGS}")):
            try:
                with only_inside([path.parent]):
                    check_world(path.parent, self.backend)
                    session = Session(path.parent, self.backend)
                    number = session.committed + 1
                    key = (number, session.hash_of(number)) if session.pending else None
            except DAMAGE as error:
                self.damaged[path.parent.name] = str(self._for_client(error))
                problem = f"cannot resume session {path.parent.name}: {error}"
                print(printable(problem), file=sys.stderr)
                continue
            self.sessions[session.id] = session
            if key is not None:
                self.submit(session.finish, changes=session, key=key, bounded=False)
        self.metrics.sessions.set(len(self.sessions))

    def close(self, *, at_once: bool = False) -> None:
        """Refuse new requests, finish waiting and running ones, then unlock the folder.

        With `at_once`, waiting requests are canceled. Accepted steps are made by the next store.
        """
        self.draining = True
        self._threads.shutdown(wait=True, cancel_futures=at_once)
        self._lock.__exit__(None, None, None)

    def get(self, session_id: object) -> Session:
        """Return a session. Raises `RequestError` for an unknown or damaged one."""
        session = self.sessions.get(session_id) if isinstance(session_id, str) else None
        if session is not None:
            return session
        if isinstance(session_id, str) and session_id in self.damaged:
            raise RequestError(
                410,
                "damaged_session",
                f"Session {session_id} could not be resumed: {self.damaged[session_id]}",
            )
        raise _unknown(session_id)

    def create(self, request: Mapping[str, Any]) -> Session:
        """Create a session from a seed or episode, with the requested id or a new one."""
        self._check_open()
        actions = ActionSpec.from_json(check_mapping(request.get("actions", {}), "actions"))
        cameras = check_cameras(cameras_of(request), actions.sides)
        name = check_name(request.get("session", secrets.token_hex(8)), "session")
        folder = self._reserve(name)
        try:
            start = self._start(request, actions)
            session = Session.create(folder, self.backend, actions, start, cameras)
            with self._changing:
                self.sessions[name] = session
                self.metrics.sessions.set(len(self.sessions))
        finally:
            with self._changing:
                self._reserved.remove(name)
        return session

    def _reserve(self, name: str) -> Path:
        """Reserve the id of a new session, and return its folder."""
        with self._changing:
            count = len(self.sessions.keys() | self._reserved)
            if count >= self.limits.sessions:
                raise RequestError(
                    429,
                    "too_many_sessions",
                    f"{count} sessions are open, the maximum of this server is "
                    f"{self.limits.sessions}. Close one, or try again later.",
                    retry_after_s=5.0,
                )
            folder = self.folder / name
            if name in self.sessions or name in self._reserved or folder.exists():
                raise RequestError(
                    409,
                    "session_exists",
                    f"There is already a session {quote(name)}: choose another id, or none for a "
                    "new one.",
                )
            self._reserved.add(name)
        return folder

    def _start(
        self,
        request: Mapping[str, Any],
        actions: ActionSpec,
        default: Callable[[], Start] | None = None,
    ) -> Start:
        """Return the start of a request's `seed` or `episode` bytes.

        Without either, return the default, or the start of seed 0.
        """
        prompt = prompt_of(request)
        seed = 0 if (chosen := request.get("seed")) is None else check_integer(chosen, "seed")
        if not 0 <= seed <= MAX_SEED:
            raise InputError(f"seed is {quote(seed)}: it must be from 0 to 2**63 - 1000000.")
        if (data := request.get("episode")) is not None:
            if not isinstance(data, bytes):
                raise InputError(f"episode is {quote(data)}: it must be the bytes of a .zip.")
            start = Start.of(Episode.from_bytes(data), seed=seed)
        elif chosen is None and default is not None:
            start = default()
        else:
            start = self.backend.start(seed, actions)
        check_size(start, self.backend.video)
        return start if prompt is None else replace(start, prompt=prompt)

    def step(self, request: Mapping[str, Any], show: Show | None = None) -> Future[Result]:
        """Queue a step of a session or, if the request has one, a part of it.

        `show` gets the frames of a new step only.
        """
        session = self.get(request.get("session"))
        step_id, prompt = check_integer(request.get("step_id"), "step_id"), prompt_of(request)
        if step_id < 1:
            raise InputError(
                f"step_id is {step_id}: it must be one more than the last committed step. Send "
                f"{session.committed + 1}."
            )
        if step_id > self.limits.max_steps:
            raise RequestError(
                429,
                "too_many_steps",
                f"Step {step_id} is more than a session's maximum of {self.limits.max_steps} "
                "steps: create a new session.",
            )
        if "actions" not in request:
            raise InputError("The step has no actions: give rows of numbers.")
        rows, part = request["actions"], part_of(request)
        key = step_id, request_hash(rows, prompt, part)
        if session.busy and (running := session.running) is not None and running[0] == key:
            return running[1]  # a client that reconnected waits for its running step
        run: Callable[[], Result]
        if part is None:
            run = partial(session.step, step_id, rows, prompt, show)
        else:
            run = partial(self.parts.step, session, step_id, part, rows, prompt, show)
        if step_id <= session.committed:  # a repeated step only reads, so it may run concurrently
            return self.submit(run)
        return self.submit(run, changes=session, key=key)

    def reset(self, request: Mapping[str, Any]) -> Future[Result]:
        """Queue a reset of a session to a seed or episode, by default to its first start."""
        session = self.get(request.get("session"))

        def run() -> Result:
            return session.restart(self._start(request, session.actions, session.first_start))

        return self.submit(run, changes=session)

    def save(self, request: Mapping[str, Any]) -> Future[str]:
        """Queue saving a session under a name."""
        session, name = self.get(request.get("session")), request.get("name")
        check_name(name, "name")

        def run() -> str:
            saved = session.saved
            if len(saved) >= self.limits.saved and name not in saved:
                raise RequestError(
                    429,
                    "too_many_saved",
                    f"The session has saved {len(saved)} starts, the maximum is "
                    f"{self.limits.saved}. Save under one of their names.",
                )
            session.save(str(name))
            return str(name)

        return self.submit(run, changes=session)

    def load(self, request: Mapping[str, Any]) -> Future[Result]:
        """Queue restoring a saved start."""
        session, name = self.get(request.get("session")), request.get("name")
        return self.submit(lambda: session.load(check_name(name, "name")), changes=session)

    def remove(self, request: Mapping[str, Any]) -> Future[str]:
        """Queue closing a session; its folder is deleted unless `keep` is true."""
        session, keep = self.get(request.get("session")), request.get("keep", False)
        if not isinstance(keep, bool):
            raise InputError(f"keep is {quote(keep)}: it must be true or false.")
        removed = self.folder / REMOVED.format(session.id)

        def run() -> str:
            with self._changing:
                if keep:
                    self._check_kept()
                    (session.folder / SETTINGS).rename(session.folder / CLOSED)
                else:  # renamed first: a crash while files are deleted leaves no half session
                    shutil.rmtree(removed, ignore_errors=True)
                    session.folder.rename(removed)
                self.sessions.pop(session.id, None)
                self.metrics.sessions.set(len(self.sessions))
            shutil.rmtree(removed, ignore_errors=True)
            return session.id

        return self.submit(run, changes=session)

    def _check_kept(self) -> None:
        count = sum(1 for _ in self.folder.glob(f"*/{CLOSED}"))
        if count >= self.limits.kept:
            raise RequestError(
                429,
                "too_many_kept",
                f"{count} closed sessions are kept, the maximum of this server is "
                f"{self.limits.kept}. Close it without keep, or have some folders removed.",
            )

    def submit(
        self,
        run: Callable[[], T],
        *,
        changes: Session | None = None,
        key: tuple[int, str] | None = None,
        bounded: bool = True,
    ) -> Future[T]:
        """Run a request in a worker thread.

        A `bounded` request is refused if the queue is full or the server is shutting down. A
        request that `changes` a session is refused while another one changes it; `key` is the
        number and hash of its step.
        """
        if bounded:
            self._check_open()
        with self._changing:
            if bounded and self._queued >= self.limits.queue:
                raise RequestError(
                    429,
                    "queue_full",
                    f"{self._queued} requests wait or run, the maximum of this server is "
                    f"{self.limits.queue}. Send it again later.",
                    retry_after_s=1.0,
                )
            if changes is not None and changes.busy:
                raise RequestError(
                    409,
                    "session_busy",
                    f"Session {changes.id} has a running request: one at a time can change it. "
                    "Wait for its reply, then send this request again.",
                    retry_after_s=0.5,
                )
            if changes is not None and self.sessions.get(changes.id) is not changes:
                raise _unknown(changes.id)  # closed between lookup and lock
            self._queued += 1
            self.metrics.queued.set(self._queued)
            future = self._threads.submit(self._run, run)
            if changes is not None:
                changes.running = key, future
        return future

    def _run(self, run: Callable[[], T]) -> T:
        then = time.monotonic()
        try:
            return run()
        except Exception as error:
            refusal = as_request_error(self._for_client(error))
            if refusal.code == "internal":
                traceback.print_exc()
            if refusal.code == "storage":
                text = printable(f"cannot write to {self.folder}: {refusal}")
                print(text, file=sys.stderr, flush=True)
            raise refusal from error
        finally:
            with self._changing:
                self._queued -= 1
                self.metrics.queued.set(self._queued)
            self.metrics.seconds.observe(time.monotonic() - then)

    def storage_problem(self) -> str:
        """Return why the folder takes no more data, or empty text; a small file is written."""
        try:
            if shutil.disk_usage(self.folder).free < MIN_FREE_BYTES:
                return os.strerror(errno.ENOSPC)
            with atomic_write(self.folder / PROBE) as temporary:
                temporary.touch()
            (self.folder / PROBE).unlink(missing_ok=True)
        except OSError as error:
            return error.strerror or str(error)
        return ""

    def _for_client(self, error: Exception) -> Exception:
        """Return the error without the path of the server's folder."""
        folder = f"{quote_path(self.folder)}/"
        if isinstance(error, InputError) and folder in str(error):
            return InputError(str(error).replace(folder, ""))
        return error

    def _check_open(self) -> None:
        if self.draining:
            raise RequestError(
                503,
                "draining",
                "The server is shutting down: it finishes running requests and accepts no new "
                "ones. Connect again after its restart; all sessions are kept.",
                retry_after_s=10.0,
            )


def _unknown(session_id: object) -> RequestError:
    return RequestError(
        404,
        "unknown_session",
        f"There is no session {quote(session_id)}: session must be the id of an open session, as "
        "returned by create. Create one.",
    )
