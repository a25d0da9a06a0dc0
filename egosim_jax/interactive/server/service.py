"""Service of a store: a request map in, a reply map out, preceded by streamed frames."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
from collections.abc import AsyncGenerator, Iterator, Mapping
from concurrent.futures import Future
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import UInt8

from egosim_jax.interactive.env import World, load_backend
from egosim_jax.interactive.env.action_spec import LAYOUTS
from egosim_jax.interactive.env.chunks import OBSERVATIONS, STATE_FIELDS, view_of
from egosim_jax.interactive.env.parts import part_rows
from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.prometheus import Metrics
from egosim_jax.interactive.server.requests import (
    REQUESTS,
    cameras_of,
    is_streamed,
    observations_of,
    parse_request,
)
from egosim_jax.interactive.server.session import Result, Session
from egosim_jax.interactive.server.store import Store
from egosim_jax.io.executables import share_with_jax
from egosim_jax.runtime.processes import return_freed_blocks
from egosim_jax.simulation.rig import MOUNTS
from egosim_jax.types import InputError

T = TypeVar("T")


async def last_of(replies: AsyncGenerator[dict[str, Any], None]) -> dict[str, Any]:
    """Return the last of some replies, which is the reply to the request."""
    return [reply async for reply in replies][-1]


class Requests:
    """Object that replies to clients: a `Service`, or an `Entrance` to several."""

    def __init__(self, metrics: Metrics):
        self.metrics = metrics

    def problem(self) -> str:
        """Return why no request is accepted now, or empty text."""
        return ""

    def active(self) -> AbstractContextManager[None]:
        """Return the context that holds back a shutdown until the reply is sent."""
        return nullcontext()

    async def describe(self) -> dict[str, Any]:
        """Return the description that a client receives when it connects."""
        raise NotImplementedError

    def replies(self, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the reply to a request, after the frames of a streamed step."""
        raise NotImplementedError

    async def handle(self, message: Any) -> dict[str, Any]:
        """Return the reply to a request. `Metrics.refuse` converts any error."""
        if is_streamed(message):
            raise InputError(
                "stream is true, but this request has one reply: frames are streamed over the "
                "websocket only. Connect there, or omit stream. (stream)"
            )
        return await last_of(self.replies(message))


class Service(Requests):
    """Replies to the requests of clients, from the sessions of a store."""

    def __init__(self, store: Store, *, world: str):
        super().__init__(store.metrics)
        self.store, self._world = store, world
        self._active = 0
        self._quiet = threading.Condition()

    def problem(self) -> str:
        """Return why the server accepts no requests now, or empty text."""
        return "draining" if self.store.draining else self.store.storage_problem()

    async def describe(self) -> dict[str, Any]:
        """Return the description that a client receives when it connects."""
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
            "part_rows": list(part_rows(self.store.backend.chunk_frames)),
            "layouts": list(LAYOUTS),
            "observations": list(OBSERVATIONS),
            "mounts": list(MOUNTS),
            "requests": {name: list(fields) for name, fields in REQUESTS.items()},
            "limits": limits.to_json(),
        }

    @contextmanager
    def active(self) -> Iterator[None]:
        """Hold back a shutdown until the reply is sent."""
        with self._quiet:
            self._active += 1
        try:
            yield
        finally:
            with self._quiet:
                self._active -= 1
                self._quiet.notify_all()

    def drain(self, timeout_s: float) -> bool:
        """Refuse new requests; return True once no request is running, False after the timeout."""
        self.store.draining = True
        with self._quiet:
            return self._quiet.wait_for(lambda: not self._active, timeout_s)

    async def _reply_to(self, name: str, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the reply to a request that is not streamed."""
        store = self.store
        if name == "status":
            return self.status(request)
        if name == "create":
            observe = observations_of(request, cameras_of(request))
            session = await self._wait(store.submit(lambda: store.create(request)))
            low, high = session.actions.bounds
            spec = {**session.actions.to_json(), "names": list(session.actions.names)}
            reply = await self._reply(session, session.result, observe)
            cameras = [camera.to_json() for camera in session.observer.cameras]
            about = {"cameras": cameras} if cameras else {}
            return {**reply, "actions": {**spec, "low": low, "high": high}, **about}
        session = store.get(request.get("session"))
        observe = observations_of(request, session.observer.cameras)
        if name == "save":
            saved = await self._wait(store.save(request))
            return {"session": session.id, "step_id": session.committed, "name": saved}
        if name == "close":
            return {"session": await self._wait(store.remove(request)), "closed": True}
        run = {"step": store.step, "reset": store.reset, "load": store.load}[name]
        result = await self._wait(run(request))
        if name == "step" and result.part is None:
            self.metrics.steps.inc()
        return await self._reply(session, result, observe)

    async def replies(self, message: Any) -> AsyncGenerator[dict[str, Any], None]:
        """Yield the reply to a request, after the frames of a streamed step.

        A step that is already committed or running yields only the reply.
        """
        name, request = parse_request(message)
        if not is_streamed(message):
            yield await self._reply_to(name, request)
            return
        then, times = time.monotonic(), []
        session = self.store.get(request.get("session"))
        observe = observations_of(request, session.observer.cameras)
        groups: asyncio.Queue[UInt8[np.ndarray, "g h w 3"] | None] = asyncio.Queue()
        loop = asyncio.get_running_loop()

        def show(frames: UInt8[np.ndarray, "g h w 3"]) -> None:
            with suppress(RuntimeError):  # the loop has ended, and the step finishes without it
                loop.call_soon_threadsafe(groups.put_nowait, frames)

        future = self.store.step(request, show)
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
            made.cancel()  # the client disconnected; this ends the wait, not the step
        if result.part is None:
            self.metrics.steps.inc()
        reply = await self._reply(session, result, observe)
        if times:
            self.metrics.first_frames.observe(times[0])
            reply["timing"] = {"first_frames_s": times[0], "last_frames_s": times[-1]}
        yield reply

    def status(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Return the status of a session, or of the server if none is named."""
        if request.get("session") is None:
            steps = {name: s.committed for name, s in sorted(self.store.sessions.items())}
            return {
                "sessions": steps,
                "damaged": sorted(self.store.damaged),
                "draining": self.store.draining,
            }
        session = self.store.get(request["session"])
        cameras = [camera.to_json() for camera in session.observer.cameras]
        return {
            "session": session.id,
            "committed_step_id": session.committed,
            "busy": session.busy,
            "saved": session.saved,
            "actions": session.actions.to_json(),
            **({"cameras": cameras} if cameras else {}),
            **session.result.info,
        }

    async def _wait(self, future: Future[T]) -> T:
        """Wait for a result; the work continues if the client disconnects or the wait times out."""
        timeout = self.store.limits.step_timeout
        waiting = asyncio.shield(asyncio.wrap_future(future))
        try:
            return await asyncio.wait_for(waiting, timeout)
        except TimeoutError:
            raise RequestError(
                504,
                "timeout",
                f"The request has taken more than {timeout:g} s, the maximum wait: it continues. "
                "Request the status, or send the same step_id again.",
                retry_after_s=1.0,
            ) from None

    async def _reply(
        self, session: Session, result: Result, observe: tuple[str, ...]
    ) -> dict[str, Any]:
        reply: dict[str, Any] = {
            "session": session.id,
            "step_id": result.step_id,
            "row": result.row,
        }
        if "frames" in observe:
            reply["frames"] = result.frames
        if "keypoints" in observe:
            reply["keypoints"] = session.actions.joints(result.row[None])[0]
        for item in observe:
            if item.endswith(".frames") and result.part is None:
                reply[item] = result.others[item.partition(".")[0]]
        if (latency := result.latency) is not None:  # of a part, which changes no state
            seconds = {"first_frames_s": latency.first_frame_s}
            seconds["last_frames_s"] = latency.last_frame_s
            return {**reply, "part": result.part, "timing": seconds}
        reply["info"] = dict(result.info)
        if "state" in observe:
            reply["state"] = {name: getattr(result.state, name) for name in STATE_FIELDS}
        if "depth" in observe:
            simulator = session.backend.simulator(session.now)
            render = partial(view_of, simulator, result.state, result.camera)
            view = await self._wait(self.store.submit(render, bounded=False))
            reply["depth"] = np.asarray(view.depth_m[0])
        for item in observe:
            camera, _, what = item.partition(".")
            if what == "depth":
                seen = partial(
                    session.observer.depth, camera, session.now, result.state, result.camera,
                    result.row,
                )  # fmt: skip
                reply[item] = await self._wait(self.store.submit(seen, bounded=False))
        return reply


def open_service(folder: Path, limits: Limits, world: World, **options: Any) -> Service:
    """Load and compile a world, resume the sessions of a folder, and return the service.

    Larger batches are compiled while it serves. `load_backend` has the same options.
    """
    share_with_jax()
    return_freed_blocks()
    backend = load_backend(world, compile="behind", **options)
    store = Store(folder, backend, limits)
    print(f"resumed {len(store.sessions)} sessions", file=sys.stderr)
    return Service(store, world=backend.identity()["world"])
