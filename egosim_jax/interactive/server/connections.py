"""Connections of clients, bounded in number and in the time that one may take for a request.

uvicorn reads a request however slowly it comes, and has no option against it. Here a connection
that has no request under way is closed after `HEAD_S`, and one above the limit is refused before
anything of it is read. This is the only module that knows the inside of uvicorn: it subclasses
`H11Protocol`, whose names `tests/unit/interactive/server/test_connections.py` checks.
"""

from __future__ import annotations

import json
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from egosim_jax.interactive.server.errors import RequestError

HEAD_S = 20.0
"""Longest time that a connection takes for the head of a request, and is kept without one."""


class BoundedProtocol(H11Protocol):
    """HTTP/1.1 of uvicorn for one connection less than its `limit_concurrency`."""

    def connection_made(self, transport: Any) -> None:
        """Accept a connection, or refuse it with status 503."""
        super().connection_made(transport)
        limit = (self.limit_concurrency or 0) - 1
        if 0 < limit < len(self.connections):
            transport.write(_full(limit))
            transport.close()
            return
        self._watch(None)

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


def _full(limit: int) -> bytes:
    error = RequestError(
        503,
        "too_many_connections",
        f"{limit} connections are open, the most of this server. Close one, or try again later.",
        retry_after_s=1.0,
    )
    body = json.dumps(error.body()).encode()
    head = (
        "HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/json\r\nRetry-After: 1\r\n"
        f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body
