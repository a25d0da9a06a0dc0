"""Checks before a request is read: token, origin, host, and size and time of the body."""

from __future__ import annotations

import asyncio
import hmac
import time
from urllib.parse import SplitResult, urlsplit

from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from egosim_jax.interactive.origins import is_loopback
from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.io.bounded import quote

OPEN_PATHS = ("/healthz", "/readyz")
"""Paths without a token."""
BODY_TIMEOUT_S = 60.0
"""Maximum time in which the body of a request must arrive."""


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
                raise HTTPException(408) from None
            complete = not message.get("more_body", False)
            total += len(message.get("body", b""))
            if total > wire.MAX_BYTES:
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


def too_large() -> RequestError:
    """Return the error for a message above the limit."""
    return RequestError(
        413,
        "too_large",
        f"The message is larger than the maximum of {wire.MAX_BYTES:,} bytes. Send fewer rows or a "
        "smaller episode.",
    )


def too_slow() -> RequestError:
    """Return the error for a body that did not arrive in time."""
    return RequestError(
        408,
        "too_slow",
        f"The body did not arrive within the maximum of {BODY_TIMEOUT_S:g} s. Send it again.",
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
