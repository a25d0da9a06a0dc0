"""Requests of clients by websocket or HTTP: a map in, a map out; before it maps of frames."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
import traceback
from collections.abc import AsyncGenerator, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import asdict
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import UInt8

from egosim_jax.interactive.env import World, backend_of
from egosim_jax.interactive.env.action_spec import LAYOUTS
from egosim_jax.interactive.env.chunks import view_of
from egosim_jax.interactive.env.specs import vars_of
from egosim_jax.interactive.server.errors import RequestError, as_request_error
from egosim_jax.interactive.server.prometheus import Metrics
from egosim_jax.interactive.server.session import Result, Session
from egosim_jax.interactive.server.store import Limits, Store
from egosim_jax.io.bounded import quote
from egosim_jax.io.executables import share_with_jax
from egosim_jax.types import InputError

T = TypeVar("T")
OBSERVATIONS = ("frames", "depth", "keypoints", "state")
FIELDS = {
    "create": ("session", "seed", "prompt", "episode", "actions", "observe"),
    "step": ("session", "step_id", "actions", "prompt", "observe", "stream"),
    "reset": ("session", "seed", "prompt", "episode", "observe"),
    "save": ("session", "name"),
    "load": ("session", "name", "observe"),
    "close": ("session", "keep"),
    "status": ("session",),
}
"""Fields of each request."""


class Service:
    """Requests of clients to the sessions of a store."""

    def __init__(self, store: Store, *, world: str):
        self.store, self._world = store, world
        self._active = 0
        self._quiet = threading.Condition()

    @property
    def metrics(self) -> Metrics:
        """Metrics of the store."""
        return self.store.metrics

    @property
    def draining(self) -> bool:
        """True if the server is ending and takes nothing new."""
        return self.store.draining

    async def describe(self) -> dict[str, Any]:
        """Return the description that a client gets when it connects."""
        video, limits = self.store.backend.video, self.store.limits
        return {
            "server": "egosim_jax",
            "version": metadata.version("egosim-jax"),
            "protocol": 1,
            "world": self._world,
            "frames": video.frames,
            "height": video.height,
            "width": video.width,
            "fps": video.fps,
            "rows": video.frames - 1,
            "layouts": list(LAYOUTS),
            "observations": list(OBSERVATIONS),
            "requests": {name: list(fields) for name, fields in FIELDS.items()},
            "limits": asdict(limits),
        }

    @contextmanager
    def active(self) -> Iterator[None]:
        """Keep a shutdown waiting, until a reply is sent."""
        with self._quiet:
            self._active += 1
        try:
            yield
        finally:
            with self._quiet:
                self._active -= 1
                self._quiet.notify_all()

    def refused(self, error: Exception) -> RequestError:
        """Count the error of a request and return it for the client; log a defect of the server."""
        return refusal(error, self.metrics)

    def drain(self, timeout_s: float) -> bool:
        """Refuse new work; return True when no request is under way any more."""
        self.store.draining = True
        with self._quiet:
            return self._quiet.wait_for(lambda: not self._active, timeout_s)

    async def handle(self, message: Any) -> dict[str, Any]:
        """Return the reply to a request. Raises what `refused` returns for the client."""
        name, request = _parsed(message)
        if is_streamed(message):
            raise InputError(
                "stream is true, and this request has one reply: frames are streamed over the "
                "websocket only. Connect there, or leave stream out. (stream)"
            )
        observe = _observe(request.get("observe", ["frames"]))
        store = self.store
        if name == "status":
            return self.status(request)
        if name == "create":
            session = await self._wait(store.submit(lambda: store.create(request)))
            low, high = session.actions.bounds
            spec = {**vars_of(session.actions), "names": list(session.actions.names)}
            reply = await self._reply(session, session.result, observe)
            return {**reply, "actions": {**spec, "low": low, "high": high}}
        session = store.get(request.get("session"))
        if name == "save":
            saved = await self._wait(store.save(request))
            return {"session": session.id, "step_id": session.committed, "name": saved}
        if name == "close":
            return {"session": await self._wait(store.remove(request)), "closed": True}
        run = {"step": store.step, "reset": store.reset, "load": store.load}[name]
        result = await self._wait(run(request))
        if name == "step":
            store.metrics.steps.inc()
        return await self._reply(session, result, observe)

    async def replies(self, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the reply to a request, after the frames of a step that is streamed.

        A step that was made before, or is under way already, has the reply alone.
        """
        if not is_streamed(message):
            yield await self.handle(message)
            return
        then, times = time.monotonic(), []
        request = _parsed(message)[1]
        observe = _observe(request.get("observe", ["frames"]))
        groups: asyncio.Queue[UInt8[np.ndarray, "g h w 3"] | None] = asyncio.Queue()
        loop = asyncio.get_running_loop()

        def show(frames: UInt8[np.ndarray, "g h w 3"]) -> None:
            with suppress(RuntimeError):  # the loop has ended: the step is finished without it
                loop.call_soon_threadsafe(groups.put_nowait, frames)

        session, future = self.store.get(request.get("session")), self.store.step(request, show)
        made = asyncio.ensure_future(self._wait(future))
        made.add_done_callback(lambda _: groups.put_nowait(None))
        try:
            first = 0
            while (frames := await groups.get()) is not None:
                group = {"session": session.id, "step_id": int(request["step_id"])}
                yield {**group, "first_frame": first, "frames": frames}
                times.append(time.monotonic() - then)
                first += len(frames)
            result = await made
        finally:
            made.cancel()  # of a client that has vanished; the step continues
        self.metrics.steps.inc()
        reply = await self._reply(session, result, observe)
        if times:
            self.metrics.first_frames.observe(times[0])
            reply["timing"] = {"first_frames_s": times[0], "last_frames_s": times[-1]}
        yield reply

    def status(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return where a session is, or without one the sessions of the server."""
        if request.get("session") is None:
            steps = {name: s.committed for name, s in sorted(self.store.sessions.items())}
            return {
                "sessions": steps,
                "damaged": sorted(self.store.damaged),
                "draining": self.store.draining,
            }
        session = self.store.get(request["session"])
        return {
            "session": session.id,
            "committed_step_id": session.committed,
            "busy": session.busy.locked(),
            "saved": session.saved,
            "actions": vars_of(session.actions),
            **session.result.info,
        }

    async def _wait(self, future: Future[T]) -> T:
        """Return a result that may take a while; the request continues if the client vanishes."""
        timeout = self.store.limits.step_timeout_s
        waiting = asyncio.shield(asyncio.wrap_future(future))
        try:
            return await asyncio.wait_for(waiting, timeout)
        except TimeoutError:
            raise RequestError(
                504,
                "timeout",
                f"The request has taken more than {timeout:g} s, the longest that a client waits: "
                "it continues. Ask for the status, or send the same step_id again.",
                retry_after_s=1.0,
            ) from None

    async def _reply(
        self, session: Session, result: Result, observe: tuple[str, ...]
    ) -> dict[str, Any]:
        found: dict[str, Any] = {
            "session": session.id,
            "step_id": result.step_id,
            "row": result.row,
            "info": dict(result.info),
        }
        if "frames" in observe:
            found["frames"] = result.frames
        if "keypoints" in observe:
            found["keypoints"] = session.actions.joints(result.row[None])[0]
        if "state" in observe:
            names = ("points_m", "colors", "object_ids")
            found["state"] = {name: getattr(result.state, name) for name in names}
        if "depth" in observe:
            simulator = session.backend.simulator(session.now)
            render = partial(view_of, simulator, result.state, result.camera)
            view = await self._wait(self.store.submit(render, bounded=False))
            found["depth"] = np.asarray(view.depth_m[0])
        return found


def is_streamed(message: Any) -> bool:
    """Return True if a request is a step whose frames are asked for as they are decoded.

    Raises `InputError` if it does not say so by true or false.
    """
    if not isinstance(message, dict) or message.get("request") != "step":
        return False
    if not isinstance(stream := message.get("stream", False), bool):
        raise InputError(f"stream is {quote(stream)}: it must be true or false. (stream)")
    return stream


def refusal(error: Exception, metrics: Metrics) -> RequestError:
    """Count an error and return it for the client; log a defect of the server."""
    found = as_request_error(error)
    if found is not error and found.code == "internal":
        traceback.print_exception(error)
    metrics.refused.labels(found.code).inc()
    return found


def open_service(
    folder: Path,
    limits: Limits,
    *,
    world: World,
    config: str,
    weights: Path | None,
    perception: str,
    steps: int | None,
    batch: int,
) -> Service:
    """Load and compile a world, resume the sessions of a folder, and return their service."""
    share_with_jax()
    backend = backend_of(
        world, config=config, weights=weights, perception=perception, steps=steps, batch=batch
    )
    store = Store(folder, backend, limits, Metrics())
    print(f"{len(store.sessions)} sessions are resumed", file=sys.stderr)
    return Service(store, world=world)


def _parsed(message: Any) -> tuple[str, Mapping[str, Any]]:
    """Return name and fields of a request. Raises `InputError` for an unknown one."""
    if not isinstance(message, dict):
        raise InputError(
            f"The message is {quote(message)}: it must be a map with the field request."
        )
    name = message.get("request")
    if not isinstance(name, str) or name not in FIELDS:
        raise InputError(
            f"The request is {quote(name)}: it must be one of {', '.join(FIELDS)}. (request)"
        )
    allowed = ("request", *FIELDS[name])
    if unknown := [key for key in message if key not in allowed]:
        raise InputError(
            f"The request {name} has no field {quote(unknown[0])}: its fields are "
            f"{', '.join(FIELDS[name])}."
        )
    return name, {key: value for key, value in message.items() if key != "request"}


def _observe(names: Any) -> tuple[str, ...]:
    given = names if isinstance(names, list | tuple) else [names]
    if unknown := [n for n in given if not (isinstance(n, str) and n in OBSERVATIONS)]:
        raise InputError(
            f"observe has {quote(unknown[0])}: it must be a list of {', '.join(OBSERVATIONS)}."
        )
    return tuple(given)
