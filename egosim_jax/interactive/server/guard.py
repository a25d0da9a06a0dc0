"""Checks before a request is read: number of connections, token, origin, host, size, time.

uvicorn reads a request however slowly it comes, and has no option against it. Here a connection
that has no request under way is closed after `HEAD_S`, and one above the limit is refused before
anything of it is read. All connections together hold at most `MAX_HELD` bytes of requests.

This is the only module that knows the inside of uvicorn and websockets: it subclasses
`H11Protocol` and `WebSocketsSansIOProtocol`. Their names are checked in
`tests/unit/interactive/server/test_connections.py`.
"""

from __future__ import annotations

import asyncio
import hmac
import json
import time
from contextlib import suppress
from typing import Any
from urllib.parse import SplitResult, urlsplit

from fastapi.responses import JSONResponse
from starlette.requests import ClientDisconnect, HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from egosim_jax.interactive.origins import is_loopback
from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.io.bounded import quote

OPEN_PATHS = ("/healthz", "/readyz")
"""Paths without a token."""
HEAD_S = 20.0
"""Longest time that a connection takes for the head of a request, and is kept without one."""
BODY_TIMEOUT_S = 60.0
"""Maximum time in which the body of a request, or a message of a websocket, must arrive."""
MAX_HELD = 16 * wire.MAX_BYTES
"""Maximum number of bytes of requests that all connections hold, until their replies."""
SMALL = 1 << 16
"""Size up to which a request is always read."""


class Guard:
    """ASGI middleware that checks token, origin, host and size before a request is read."""

    def __init__(self, app: ASGIApp, *, token: str | None):
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Forward the request, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            return await self._app(scope, receive, send)
        try:
            self._check(HTTPConnection(scope))
        except RequestError as error:
            return await _refuse(error, scope, receive, send)
        if scope["type"] == "websocket":
            return await self._app(scope, receive, send)
        with suppress(ClientDisconnect):  # nobody waits for the response
            await self._app(scope, self._bounded(receive), send)

    def _check(self, connection: HTTPConnection) -> None:
        # not connection.url: it starts with the Host header, which the client chooses
        headers, path = connection.headers, connection.scope["path"]
        host, origin = headers.get("host", ""), headers.get("origin")
        if origin is not None and _address(origin).netloc != host:
            raise RequestError(
                403,
                "wrong_origin",
                "The request comes from a page of another origin, which may not use this server. "
                "Use a client outside the browser.",
            )
        # without a token, DNS rebinding would let a web page reach the loopback by its own name
        if self._token is None and not is_loopback(_address(f"//{host}").hostname or ""):
            raise RequestError(
                403,
                "wrong_host",
                "The host of the request is not this machine: without a token, the server must be "
                "addressed as localhost or 127.0.0.1. Use one of them, or set a token.",
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
        if not size.isdecimal() or int(size) > wire.MAX_BYTES:
            raise too_large()

    def _bounded(self, receive: Receive) -> Receive:
        total, complete = 0, False
        until = time.monotonic() + BODY_TIMEOUT_S

        async def bounded() -> Message:
            nonlocal total, complete
            left = None if complete else max(until - time.monotonic(), 0)
            try:
                message = await asyncio.wait_for(receive(), left)
            except TimeoutError:
                raise _too_slow() from None
            complete = not message.get("more_body", False)
            total += len(message.get("body", b""))
            if total > wire.MAX_BYTES:
                raise too_large()
            return message

        return bounded


def _address(url: str) -> SplitResult:
    try:
        return urlsplit(url)
    except ValueError:
        raise RequestError(
            400, "invalid", f"{quote(url)} in Host or Origin is not a valid address. Send one."
        ) from None


def too_large() -> RequestError:
    """Return the error for a message above the limit."""
    return RequestError(
        413,
        "too_large",
        f"The message is larger than the maximum of {wire.MAX_BYTES:,} bytes. Send fewer rows or a "
        "smaller episode.",
    )


def _too_slow(what: str = "body") -> RequestError:
    """Return the error for a body or message that did not arrive in time."""
    return RequestError(
        408,
        "too_slow",
        f"The {what} did not arrive within the maximum of {BODY_TIMEOUT_S:g} s. Send it again.",
    )


def _too_much() -> RequestError:
    """Return the error for a request while all connections hold too much."""
    return RequestError(
        503,
        "too_many_bytes",
        f"The requests of all connections have {MAX_HELD:,} bytes, the maximum. Try again later.",
        retry_after_s=1.0,
    )


async def _refuse(error: RequestError, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get(
        "extensions", {}
    ):
        await receive()
        await send({"type": "websocket.close", "code": 1008, "reason": error.code})
        return
    await response(error)(scope, receive, send)


def response(error: RequestError) -> JSONResponse:
    """Return the response to a refused request."""
    headers = {}
    if error.retry_after_s is not None:
        headers["Retry-After"] = str(max(1, round(error.retry_after_s)))
    return JSONResponse(error.body(), status_code=error.status, headers=headers)


class BoundedProtocol(H11Protocol):
    """HTTP/1.1 of uvicorn for one connection less than its `limit_concurrency`."""

    held = 0
    """Bytes of requests without their response."""

    def connection_made(self, transport: Any) -> None:
        """Accept a connection, or refuse it with status 503."""
        super().connection_made(transport)
        limit = (self.limit_concurrency or 0) - 1
        if 0 < limit < len(self.connections):
            self._end(_full(limit))
            return
        self._watch(None)

    def _end(self, error: RequestError) -> None:
        self.transport.write(_raw(error))
        self.transport.close()

    def data_received(self, data: bytes) -> None:
        """Read a part of a request, unless all connections hold too much."""
        self.held += len(data)
        if _is_over(self):
            self._end(_too_much())
        else:
            super().data_received(data)

    def on_response_complete(self) -> None:
        """Count the bytes of the next request."""
        self.held = 0
        super().on_response_complete()

    def _watch(self, seen: object) -> None:
        self._timer = self.loop.call_later(HEAD_S, self._look, seen)

    def _look(self, seen: object) -> None:
        """Close the connection if it has had no new request since the last look."""
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            return  # it is closed, or a websocket, which has pings
        cycle = self.cycle
        if cycle is seen and (cycle is None or cycle.response_complete):
            self.transport.close()
            return
        self._watch(cycle)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        if (timer := getattr(self, "_timer", None)) is not None:
            timer.cancel()
        super().connection_lost(exc)


class BoundedWebSocket(WebSocketsSansIOProtocol):
    """Websocket of uvicorn whose messages arrive in time, and whose memory is returned."""

    held = 0
    """Bytes of the message that arrives, and of the one that is in work."""
    _taken = 0
    _timer: asyncio.TimerHandle | None = None

    def data_received(self, data: bytes) -> None:
        """Read a part of a message, unless all connections hold too much."""
        super().data_received(data)
        arriving = len(self.conn.reader.buffer) + (self.conn.current_size or 0)
        self.held = arriving + self._taken
        if self.close_sent or self.transport.is_closing():
            return
        if _is_over(self):
            self._end(1013, _too_much())
        elif not arriving:
            self._stop()
        elif self._timer is None:
            self._timer = self.loop.call_later(BODY_TIMEOUT_S, self._late)

    def send_receive_event_to_app(self) -> None:
        """Hand a complete message to the application; the next one has its own time."""
        if self.curr_msg_data_type == "text":  # uvicorn logs a traceback if it is not UTF-8
            self.frames = [b"".join(self.frames).decode("utf-8", "ignore").encode()]
        self._taken = sum(map(len, self.frames))
        self._stop()
        super().send_receive_event_to_app()

    async def receive(self) -> Any:
        """Return the next message; the one before is done."""
        if self.queue.empty():
            self.held, self._taken = self.held - self._taken, 0
        return await super().receive()

    def _late(self) -> None:
        self._timer = None
        if self.read_paused:  # the client cannot send, as its last message is in work
            self._timer = self.loop.call_later(BODY_TIMEOUT_S, self._late)
        elif not (self.close_sent or self.transport.is_closing()):
            self._end(1008, _too_slow("message"))

    def _end(self, code: int, error: RequestError) -> None:
        """Refuse what arrives, and close the connection."""
        self._stop()
        if self.handshake_complete:
            self.conn.send_text(json.dumps(error.body()).encode())
            self.conn.fail(code, error.code)
            self.handle_parser_exception()
        self.transport.close()
        self._release()

    def _stop(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _release(self) -> None:
        # A generator of the parser keeps the connection in a cycle, which is collected much later.
        self.conn.reader.buffer.clear()
        self.frames.clear()
        self.held = 0

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection and what it has sent."""
        self._stop()
        self._release()
        super().connection_lost(exc)


def _is_over(connection: BoundedProtocol | BoundedWebSocket) -> bool:
    """Return True if a connection, with all others, holds more than the maximum."""
    if connection.held <= SMALL:
        return False
    return sum(getattr(other, "held", 0) for other in connection.connections) > MAX_HELD


def _full(limit: int) -> RequestError:
    return RequestError(
        503,
        "too_many_connections",
        f"{limit} connections are open, the most of this server. Close one, or try again later.",
        retry_after_s=1.0,
    )


def _raw(error: RequestError) -> bytes:
    """Return the response to a request that is not read."""
    body = json.dumps(error.body()).encode()
    head = (
        "HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/json\r\nRetry-After: 1\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body
