"""Connections that are slow, and the names of uvicorn that closing them needs."""

import asyncio
import json
import operator
import socket
from importlib.metadata import version
from unittest.mock import MagicMock

import pytest
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState
from websockets.exceptions import ConnectionClosedError

from egosim_jax.interactive.server import connections, wire
from egosim_jax.interactive.server.client import Client
from tests.unit.interactive.server.served import run


@pytest.mark.parametrize(
    ("size", "text"), [(wire.MAX_BYTES + 1, False), (wire.MAX_BYTES + 1, True), (48 << 20, False)]
)
def test_a_too_large_message_is_answered_before_its_connection_is_closed(
    server, monkeypatch, size, text
):
    monkeypatch.setattr(connections, "DISCARD_S", 2.0)
    with Client(f"ws://127.0.0.1:{server[1]}") as client:
        client._socket.send("x" * size if text else bytes(size))
        error = json.loads(client._socket.recv(timeout=30))
        assert (error["status"], error["code"]) == (413, "too_large")
        assert "16,777,216 bytes" in error["message"]
        with pytest.raises(ConnectionClosedError) as closed:
            client._socket.recv(timeout=30)
        assert closed.value.rcvd.code == 1009


def test_the_limit_itself_is_accepted_and_the_server_goes_on(server):
    with Client(f"ws://127.0.0.1:{server[1]}") as client:
        client._socket.send(bytes(wire.MAX_BYTES))
        assert json.loads(client._socket.recv(timeout=30))["code"] == "invalid"
        assert client.request("status")["damaged"] == []


@pytest.mark.parametrize(
    "name", ["close_sent", "close_timer", "conn", "loop", "queue", "transport"]
)
def test_the_websocket_of_uvicorn_has_the_names_that_are_used(name):
    async def get() -> None:
        config = uvicorn.Config(lambda *_: None, log_config=None)
        protocol = connections.WebSocketsSansIOProtocol(config, ServerState(), {})
        assert hasattr(protocol, name)
        assert hasattr(protocol.conn, "parser_exc")
        assert callable(protocol.handle_parser_exception)

    asyncio.run(get())


@pytest.mark.parametrize(
    "name", ["connections", "cycle.response_complete", "limit_concurrency", "loop", "transport"]
)
def test_uvicorn_has_the_names_that_are_used(name):
    async def application(scope, receive, send):
        pass

    async def get() -> None:
        config = uvicorn.Config(application, ws="none", log_config=None)
        protocol = H11Protocol(config, ServerState(), {})
        protocol.connection_made(MagicMock())
        protocol.data_received(b"GET / HTTP/1.1\r\nHost: a\r\n\r\n")
        try:
            operator.attrgetter(name)(protocol)
        except AttributeError:
            pytest.fail(
                f"uvicorn {version('uvicorn')} changed: H11Protocol no longer has {name}, which "
                "egosim_jax/interactive/server/connections.py uses."
            )

    asyncio.run(get())


def test_a_second_request_may_not_come_slowly_either(tmp_path, monkeypatch):
    monkeypatch.setattr(connections, "HEAD_S", 0.4)
    service, port, _ = run(tmp_path)
    with socket.create_connection(("127.0.0.1", port), timeout=10) as slow:
        slow.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert slow.recv(1000).startswith(b"HTTP/1.1 200")
        slow.sendall(b"GET / HTTP/1.1\r\nHost: ")
        while slow.recv(1000):
            continue
    service.store.close()
