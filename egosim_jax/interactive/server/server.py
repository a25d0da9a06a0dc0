"""HTTP and websocket server of sessions, with FastAPI on uvicorn.

The websocket at / follows OpenPI's protocol. The server first sends a map that describes it. Then
each binary message is a request with one reply: a map as a binary message, or an error as text. A
streamed step gets its frames before the reply. HTTP has the same requests as JSON. Each error has a
status, a code and a message.
"""

from __future__ import annotations

import asyncio
import json
import socket
import threading
from contextlib import aclosing
from importlib import metadata
from typing import Annotated, Any

import uvicorn
from fastapi import Depends, FastAPI, Path, Request, Response, WebSocket, WebSocketDisconnect
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, PlainTextResponse
from starlette.exceptions import HTTPException

from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.guard import (
    BoundedProtocol,
    BoundedWebSocket,
    Guard,
    response,
    too_large,
)
from egosim_jax.interactive.server.service import Requests, Service
from egosim_jax.io.bounded import quote, quote_text
from egosim_jax.types import InputError

DRAIN_TIMEOUT_S = 300.0
"""Maximum time that a shutdown waits for running requests."""
MAX_READ_BYTES = 2 * wire.MAX_BYTES
"""Size up to which a too large message gets an error; above it uvicorn closes the websocket."""
BODY = {
    "requestBody": {
        "description": "Fields of the request; see docs/protocol.md.",
        "content": {"application/json": {"schema": {"type": "object"}}},
        "required": True,
    }
}
"""OpenAPI description of a body; FastAPI does not parse it, because `Guard` bounds its size."""
SessionId = Annotated[str, Path(description="Id returned by create.")]


async def _fields(request: Request) -> dict[str, Any]:
    """Return the fields of a JSON body, unpacked in a thread."""
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind != "application/json":
        raise RequestError(
            415,
            "invalid",
            f"The body is {quote(kind)}: its Content-Type must be application/json. Send JSON.",
        )
    return await asyncio.to_thread(wire.unpack_json, await request.body())


Fields = Annotated[dict[str, Any], Depends(_fields)]


def make_app(service: Requests, *, token: str | None = None) -> FastAPI:
    """Return the application of a service; without a token, only this machine can use it."""
    app = FastAPI(
        title="egosim_jax",
        version=metadata.version("egosim-jax"),
        docs_url=None,  # the default pages load scripts from a CDN
        redoc_url=None,
    )
    app.add_middleware(Guard, token=token)

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Any, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        place = quote_text(".".join(map(str, first["loc"])))
        what = quote_text(str(first["msg"]))
        return response(RequestError(422, "invalid", f"{place}: {what}. Correct it."))

    @app.exception_handler(InputError)
    async def unreadable(_: Any, error: InputError) -> JSONResponse:
        return response(service.metrics.refuse(error))

    @app.exception_handler(HTTPException)
    async def refused(_: Any, error: HTTPException) -> JSONResponse:
        code = "unknown_path" if error.status_code in (404, 405) else "invalid"
        message = f"{error.detail}: /openapi.json lists the paths and methods of this server."
        return response(RequestError(error.status_code, code, message))

    async def call(name: str, fields: dict[str, Any]) -> Response:
        """Return the response to an HTTP request."""
        with service.active():
            try:
                reply = await service.handle({**_from_json(fields), "request": name})
            except Exception as error:
                return response(service.metrics.refuse(error))
            data = await asyncio.to_thread(wire.pack_json, reply)
            return Response(data, media_type="application/json")

    @app.get("/healthz", summary="The process is up")
    async def healthz() -> PlainTextResponse:
        return PlainTextResponse("OK\n")

    @app.get("/readyz", summary="The server accepts requests")
    async def readyz() -> PlainTextResponse:
        problem = await asyncio.to_thread(service.problem)
        return PlainTextResponse(f"{problem or 'OK'}\n", status_code=503 if problem else 200)

    @app.get("/metrics", summary="Metrics in the Prometheus format")
    async def metrics() -> PlainTextResponse:
        return PlainTextResponse(service.metrics.text().decode())

    @app.get("/", summary="World, limits and requests of the server")
    async def describe() -> JSONResponse:
        return JSONResponse(await service.describe())

    @app.get("/sessions", summary="Sessions and their committed steps")
    async def sessions() -> Response:
        return await call("status", {})

    @app.post("/sessions", summary="Create a session", openapi_extra=BODY)
    async def create(fields: Fields) -> Response:
        return await call("create", fields)

    @app.get("/sessions/{session}", summary="Status of a session")
    async def status(session: SessionId) -> Response:
        return await call("status", {"session": session})

    @app.delete("/sessions/{session}", summary="Close a session and delete its files")
    async def close(session: SessionId, keep: bool = False) -> Response:
        return await call("close", {"session": session, "keep": keep})

    for name, summary in {
        "step": "Make a step; a repeated step_id returns the first result",
        "reset": "Continue from a seed or episode",
        "save": "Save the current position under a name",
        "load": "Continue from a saved position",
    }.items():
        _add(app, name, summary, call)

    @app.websocket("/")
    async def websocket(socket: WebSocket) -> None:
        await _converse(socket, service)

    return app


def _add(app: FastAPI, name: str, summary: str, call: Any) -> None:
    path = f"/sessions/{{session}}/{name}"

    @app.post(path, summary=summary, operation_id=name, openapi_extra=BODY)
    async def run(session: SessionId, fields: Fields) -> Response:
        return await call(name, {**fields, "session": session})


def _from_json(fields: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a JSON request, with a Base64 episode decoded."""
    import base64
    import binascii

    episode = fields.get("episode")
    if not isinstance(episode, str):
        return fields
    try:
        return {**fields, "episode": base64.b64decode(episode, validate=True)}
    except binascii.Error as error:
        raise InputError("episode must be the bytes of a .zip in Base64.") from error


async def _converse(socket: WebSocket, service: Requests) -> None:
    """Describe the server to a client, then reply to its messages in order."""
    await socket.accept()
    connections = service.metrics.connections
    connections.inc()
    try:
        await socket.send_bytes(wire.pack(await service.describe()))
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            data = message.get("bytes")
            if len(data or message.get("text") or "") > wire.MAX_BYTES:
                await _refuse(socket, service, too_large())
                await socket.close(1009)
                return
            with service.active():
                await _reply(socket, service, data)
    except (WebSocketDisconnect, RuntimeError):  # the client disconnected during a reply
        return
    finally:
        connections.dec()


async def _reply(socket: WebSocket, service: Requests, data: bytes | None) -> None:
    try:
        if data is None:
            raise InputError("The message is text: it must be binary, packed as MessagePack.")
        message = await asyncio.to_thread(wire.unpack, data, limit=wire.MAX_BYTES)
    except Exception as error:
        await _refuse(socket, service, error)
        return
    async with aclosing(service.replies(message)) as replies:
        while True:
            try:
                reply = await asyncio.to_thread(wire.pack, await anext(replies))
            except StopAsyncIteration:
                return
            except Exception as error:
                await _refuse(socket, service, error)
                return
            await socket.send_bytes(reply)


async def _refuse(socket: WebSocket, service: Requests, error: Exception) -> None:
    await socket.send_text(json.dumps(service.metrics.refuse(error).body()))


class _Server(uvicorn.Server):
    """Server that finishes running requests before it shuts down."""

    def __init__(self, config: uvicorn.Config, service: Service):
        super().__init__(config)
        self._service = service

    def handle_exit(self, sig: int, frame: Any) -> None:
        """Drain, then shut down; a second signal shuts down at once."""
        if self._service.store.draining:
            self.force_exit = self.should_exit = True
            return
        self._service.store.draining = True
        threading.Thread(target=self._drain, daemon=True).start()

    def _drain(self) -> None:
        self._service.drain(DRAIN_TIMEOUT_S)
        self.should_exit = True


def serve(service: Service, bound: socket.socket, *, token: str | None, ready: Any = None) -> bool:
    """Serve until SIGTERM or Ctrl-C; call `ready` with the port once it listens.

    Returns False if a second signal ended it before the running requests finished.
    """
    config = uvicorn.Config(
        make_app(service, token=token),
        log_level="warning",
        access_log=False,
        http=BoundedProtocol,
        limit_concurrency=service.store.limits.connections + 1,
        ws=BoundedWebSocket,
        ws_max_size=MAX_READ_BYTES,
        ws_ping_interval=30.0,
        ws_ping_timeout=300.0,
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=30,
    )
    server = _Server(config, service)

    async def run() -> None:
        running = asyncio.create_task(server.serve([bound]))
        while not server.started and not running.done():
            await asyncio.sleep(0.02)
        if server.started and ready is not None:
            ready(bound.getsockname()[1])
        await running

    asyncio.run(run())
    return not server.force_exit
