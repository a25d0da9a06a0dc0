"""Connections of clients, bounded in number and in the time that one may take for a request.

uvicorn reads a request however slowly it comes, and has no option against it. Here a connection
that has no request under way is closed after `HEAD_S`, and one above the limit is refused before
anything of it is read. The client of a websocket gets an error for a message above the limit before
its connection is closed. This is the only module that knows the inside of uvicorn: it subclasses
`H11Protocol` and `WebSocketsSansIOProtocol`. Their names are checked in
`tests/unit/interactive/server/test_connections.py`.
"""

from __future__ import annotations

import json
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import PayloadTooBig
from websockets.frames import Frame, Opcode

from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.guard import too_large

HEAD_S = 20.0
"""Longest time that a connection takes for the head of a request, and is kept without one."""


DISCARD_S = 5.0
"""Longest time in which the rest of a too large message is read and discarded."""


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


class BoundedWebsocket(WebSocketsSansIOProtocol):
    """Websocket of uvicorn that sends the error of a too large message before it closes."""

    def data_received(self, data: bytes) -> None:
        """Read data, or discard it after a message was refused."""
        if self.conn.parser_exc is None:
            super().data_received(data)

    def handle_parser_exception(self) -> None:
        """Send the error of a too large message, and close once the client has sent all of it."""
        if not isinstance(self.conn.parser_exc, PayloadTooBig):
            super().handle_parser_exception()
            return
        error = Frame(Opcode.TEXT, json.dumps(too_large().body()).encode())
        self.transport.write(error.serialize(mask=False))
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        # closed with unread data, the connection is reset and the client never sees the error
        self.close_timer = self.loop.call_later(DISCARD_S, self.transport.close)
        self.queue.put_nowait({"type": "websocket.disconnect", "code": 1009})


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
