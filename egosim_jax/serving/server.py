"""HTTP and websocket server of sessions: FastAPI on uvicorn.

The websocket at / speaks OpenPI's protocol: the server sends a map that describes it, then each
binary message is a request and gets one reply, a map as a binary message or an error as text. HTTP
has the same requests as JSON. All that is refused has a status, a code and a message.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import json
import socket
import threading
from typing import Annotated, Any
from urllib.parse import SplitResult, urlsplit

import uvicorn
from fastapi import Body, FastAPI, Path, WebSocket, WebSocketDisconnect
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse, PlainTextResponse
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from egosim_jax.io.untrusted import quote, quote_text
from egosim_jax.serving import wire
from egosim_jax.serving.errors import RequestError
from egosim_jax.serving.service import Service
from egosim_jax.types import InputError

OPEN_PATHS = ("/healthz", "/readyz")
"""Paths that need no token."""
DRAIN_S = 300.0
"""Longest time that a shutdown waits for the requests that are under way."""
Fields = Annotated[dict[str, Any], Body(description="Fields of the request; see docs/serving.md.")]
SessionId = Annotated[str, Path(description="Id that create has returned.")]


class Guard:
    """ASGI middleware that checks token, origin and size before a request is read."""

    def __init__(self, app: ASGIApp, *, token: str | None, limit: int = wire.MAX_BYTES):
        self._app, self._token, self._limit = app, token, limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            return await self._app(scope, receive, send)
        try:
            self._check(HTTPConnection(scope))
        except RequestError as error:
            return await _refuse(error, scope, receive, send)
        if scope["type"] == "websocket":
            return await self._app(scope, receive, send)
        await self._app(scope, self._bounded(receive), send)

    def _check(self, connection: HTTPConnection) -> None:
        headers, path = connection.headers, connection.scope["path"]  # url contains the Host header
        host, origin = headers.get("host", ""), headers.get("origin")
        if origin is not None and _address(origin).netloc != host:
            raise RequestError(
                403,
                "wrong_origin",
                "The request comes from a page of another origin, which may not use this server. "
                "Use a client of your own.",
            )
        if self._token is None and not is_loopback(_address(f"//{host}").hostname or ""):
            raise RequestError(
                403,
                "wrong_host",
                "The host of the request is not this machine: without a token, the server is used "
                "as localhost or 127.0.0.1 only.",
            )
        if self._token is not None and path not in OPEN_PATHS:
            scheme, _, given = headers.get("authorization", "").partition(" ")
            valid = hmac.compare_digest(given.strip().encode(), self._token.encode())
            if scheme.lower() not in ("bearer", "api-key") or not valid:
                raise RequestError(
                    401,
                    "wrong_token",
                    "The token is missing or wrong: send the header Authorization: Bearer TOKEN, "
                    "or give openpi-client the token as api_key.",
                )
        size = headers.get("content-length", "0")
        if not size.isdecimal() or int(size) > self._limit:
            raise _too_large(self._limit)

    def _bounded(self, receive: Receive) -> Receive:
        total = 0

        async def bounded() -> Message:
            nonlocal total
            message = await receive()
            total += len(message.get("body", b""))
            if total > self._limit:
                raise HTTPException(413)
            return message

        return bounded


def _address(url: str) -> SplitResult:
    try:
        return urlsplit(url)
    except ValueError:
        raise RequestError(
            400, "invalid", f"{quote(url)} in Host or Origin is not a valid address. Send one."
        ) from None


def _too_large(limit: int) -> RequestError:
    return RequestError(
        413,
        "too_large",
        f"The message is larger than {limit:,} bytes, the most that is read. Send fewer rows or a "
        "smaller episode.",
    )


async def _refuse(error: RequestError, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get(
        "extensions", {}
    ):
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": error.code})
        return
    response = _response(error)
    await response(scope, receive, send)


def _response(error: RequestError) -> JSONResponse:
    headers = {}
    if error.retry_after_s is not None:
        headers["Retry-After"] = str(max(1, round(error.retry_after_s)))
    return JSONResponse(error.body(), status_code=error.status, headers=headers)


def is_loopback(host: str) -> bool:
    """Return True if a host is this machine's loopback."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def make_app(service: Service, *, token: str | None = None) -> FastAPI:
    """Return the application of a service; without a token it is used from this machine only."""
    app = FastAPI(title="egosim_jax", version=service.describe()["version"])
    app.add_middleware(Guard, token=token)

    @app.exception_handler(RequestValidationError)
    async def invalid(_: Any, error: RequestValidationError) -> JSONResponse:
        found = error.errors()[0]
        place = quote_text(".".join(map(str, found["loc"])))
        what = quote_text(str(found["msg"]))
        return _response(
            RequestError(422, "invalid", f"{place}: {what}. The body must be a JSON object.")
        )

    @app.exception_handler(HTTPException)
    async def refused(_: Any, error: HTTPException) -> JSONResponse:
        if error.status_code == 413:
            return _response(_too_large(wire.MAX_BYTES))
        code = "unknown_path" if error.status_code in (404, 405) else "invalid"
        message = f"{error.detail}: /openapi.json lists the paths and methods of this server."
        return _response(RequestError(error.status_code, code, message))

    async def call(name: str, fields: dict[str, Any]) -> JSONResponse:
        """Reply to a request of HTTP."""
        with service.active():
            try:
                reply = await service.handle({**_from_json(fields), "request": name})
            except Exception as error:
                return _response(service.refused(error))
            return JSONResponse(wire.to_json(reply))

    @app.get("/healthz", summary="The process is up")
    async def healthz() -> PlainTextResponse:
        return PlainTextResponse("OK\n")

    @app.get("/readyz", summary="The server takes requests")
    async def readyz() -> PlainTextResponse:
        if service.store.draining:
            return PlainTextResponse("draining\n", status_code=503)
        return PlainTextResponse("OK\n")

    @app.get("/metrics", summary="Metrics in Prometheus's format")
    async def metrics() -> PlainTextResponse:
        return PlainTextResponse(service.store.metrics.text().decode())

    @app.get("/", summary="World, limits and requests of the server")
    async def describe() -> JSONResponse:
        return JSONResponse(service.describe())

    @app.get("/sessions", summary="Sessions and their committed steps")
    async def sessions() -> JSONResponse:
        return await call("status", {})

    @app.post("/sessions", summary="Create a session")
    async def create(fields: Fields) -> JSONResponse:
        return await call("create", fields)

    @app.get("/sessions/{session}", summary="Status of a session")
    async def status(session: SessionId) -> JSONResponse:
        return await call("status", {"session": session})

    @app.delete("/sessions/{session}", summary="Close a session and remove its files")
    async def close(session: SessionId, keep: bool = False) -> JSONResponse:
        return await call("close", {"session": session, "keep": keep})

    for name, summary in {
        "step": "Make a step; a repeated step_id returns the result of the first time",
        "reset": "Continue from a seed or episode",
        "save": "Save where the session is under a name",
        "load": "Continue from what was saved",
    }.items():
        _add(app, name, summary, call)

    @app.websocket("/")
    async def websocket(socket: WebSocket) -> None:
        await _converse(socket, service)

    return app


def _add(app: FastAPI, name: str, summary: str, call: Any) -> None:
    @app.post(f"/sessions/{{session}}/{name}", summary=summary, operation_id=name)
    async def run(session: SessionId, fields: Fields) -> JSONResponse:
        return await call(name, {**fields, "session": session})


def _from_json(fields: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a JSON request, in which an episode is Base64."""
    import base64
    import binascii

    episode = fields.get("episode")
    if not isinstance(episode, str):
        return fields
    try:
        return {**fields, "episode": base64.b64decode(episode, validate=True)}
    except binascii.Error as error:
        raise InputError("episode must be the bytes of a .zip in Base64.") from error


async def _converse(socket: WebSocket, service: Service) -> None:
    """Describe the server to a client, then reply to its messages one after the other."""
    await socket.accept()
    connections = service.store.metrics.connections
    connections.inc()
    try:
        await socket.send_bytes(wire.pack(service.describe()))
        while True:
            message = await socket.receive()
            if message["type"] == "websocket.disconnect":
                return
            with service.active():
                await _reply(socket, service, message.get("bytes"))
    except (WebSocketDisconnect, RuntimeError):  # it vanished while a reply was on its way
        return
    finally:
        connections.dec()


async def _reply(socket: WebSocket, service: Service, data: bytes | None) -> None:
    try:
        if data is None:
            raise InputError("The message is text: it must be binary, packed as MessagePack.")
        reply = await service.handle(wire.unpack(data, limit=wire.MAX_BYTES))
    except Exception as error:
        await socket.send_text(json.dumps(service.refused(error).body()))
        return
    await socket.send_bytes(wire.pack(reply))


class _Server(uvicorn.Server):
    """Server that finishes the requests under way when it is asked to end."""

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
        self._service.drain(DRAIN_S)
        self.should_exit = True


def bind(host: str, port: int, *, token: str | None) -> socket.socket:
    """Return a socket that is bound to an address and listens once it is served; 0 is a free port.

    Raises `InputError` if the port is in use, or for another address than the loopback's without a
    token.
    """
    if not is_loopback(host) and not token:
        raise InputError(
            f"{host} can be reached from other machines: the server needs a token to listen on it. "
            "Set EGOSIM_TOKEN, or listen on 127.0.0.1. (--host)"
        )
    bound = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        bound.bind((host, port))
    except OSError as error:
        bound.close()
        raise InputError(
            f"{host}:{port} cannot be listened on ({error.strerror}): address and port must be "
            "of this machine and free. Choose another port, 0 for any free one. (--port)"
        ) from error
    return bound


def serve(service: Service, bound: socket.socket, *, token: str | None, ready: Any = None) -> None:
    """Serve until SIGTERM or Ctrl-C; `ready` is called with the port that is listened on."""
    config = uvicorn.Config(
        make_app(service, token=token),
        log_level="warning",
        access_log=False,
        ws="websockets-sansio",
        ws_max_size=wire.MAX_BYTES,
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
