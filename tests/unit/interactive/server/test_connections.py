"""Connections that are slow, and the names of uvicorn that closing them needs."""

import asyncio
import gc
import json
import operator
import socket
import struct
import time
from contextlib import suppress
from importlib.metadata import version
from unittest.mock import MagicMock

import pytest
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState
from websockets.exceptions import ConnectionClosedError
from websockets.sync.client import connect

from egosim_jax.interactive.server import guard, wire
from tests.unit.interactive.server.served import run


@pytest.mark.parametrize(("size", "text"), [(wire.MAX_BYTES + 1, False), (30 << 20, True)])
def test_a_too_large_message_is_answered_before_its_connection_is_closed(server, size, text):
    with connect(f"ws://127.0.0.1:{server[1]}", compression=None, max_size=None) as socket_:
        socket_.recv(timeout=30)
        socket_.send("x" * size if text else bytes(size))
        error = json.loads(socket_.recv(timeout=30))
        assert (error["status"], error["code"]) == (413, "too_large")
        assert "16,777,216 bytes" in error["message"]
        with pytest.raises(ConnectionClosedError) as closed:
            socket_.recv(timeout=30)
        assert closed.value.rcvd.code == 1009


def test_the_limit_itself_is_accepted_and_the_server_goes_on(server):
    with connect(f"ws://127.0.0.1:{server[1]}", compression=None, max_size=None) as socket_:
        socket_.recv(timeout=30)
        socket_.send(bytes(wire.MAX_BYTES))
        assert json.loads(socket_.recv(timeout=30))["code"] == "invalid"
        socket_.send(wire.pack({"request": "status"}))
        assert wire.unpack(socket_.recv(timeout=30))["damaged"] == []


def test_text_that_is_not_utf_8_is_answered_like_other_text(server):
    with connect(f"ws://127.0.0.1:{server[1]}", compression=None) as socket_:
        socket_.recv(timeout=30)
        socket_.send(b"\xff\xfe", text=True)
        assert "must be binary" in json.loads(socket_.recv(timeout=30))["message"]


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
                "egosim_jax/interactive/server/guard.py uses."
            )

    asyncio.run(get())


def test_a_second_request_may_not_come_slowly_either(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "HEAD_S", 0.4)
    service, port, _ = run(tmp_path)
    with socket.create_connection(("127.0.0.1", port), timeout=10) as slow:
        slow.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert slow.recv(1000).startswith(b"HTTP/1.1 200")
        slow.sendall(b"GET / HTTP/1.1\r\nHost: ")
        while slow.recv(1000):
            continue
    service.store.close()


def unfinished(port, size):
    """A websocket that sends a part of a message of 1 MiB."""
    client = socket.create_connection(("127.0.0.1", port), timeout=30)
    head = "GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    key = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
    client.sendall((head + key).encode())
    client.recv(1 << 16)
    with suppress(OSError):
        client.sendall(struct.pack("!BBQ4x", 0x82, 0x80 | 127, 1 << 20) + bytes(size))
    return client


def held():
    """The bytes of messages that the websockets of this process hold."""
    return sum(o.held for o in gc.get_objects() if isinstance(o, guard.BoundedWebSocket))


def post(port, size):
    """The reply to a request, also where the server closes before it has read all."""
    head = "POST /sessions HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    with socket.create_connection(("127.0.0.1", port), timeout=30) as client:
        with suppress(OSError):
            client.sendall(f"{head}Content-Length: {size}\r\n\r\n".encode() + bytes(size))
        return client.recv(1000)


def everything(client):
    """Bytes that a client receives until its connection is closed."""
    found = b""
    with client, suppress(OSError):
        while data := client.recv(1 << 16):
            found += data
    return found


def test_a_message_that_does_not_arrive_in_time_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "BODY_TIMEOUT_S", 0.4)
    service, port, _ = run(tmp_path)
    with connect(f"ws://127.0.0.1:{port}", compression=None) as quick:
        assert b'"too_slow"' in everything(unfinished(port, 1000))
        quick.recv(timeout=30)
        time.sleep(0.6)  # without a message, a websocket stays open
        quick.send(wire.pack({"request": "status"}))
        assert wire.unpack(quick.recv(timeout=30))["damaged"] == []
    service.store.close()


def test_all_connections_together_hold_a_maximum_of_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "MAX_HELD", 17 << 16)
    service, port, _ = run(tmp_path)
    first = unfinished(port, 700 << 10)
    while held() < 700 << 10:
        time.sleep(0.01)
    assert b'"too_many_bytes"' in everything(unfinished(port, 500 << 10))
    assert post(port, 500 << 10).startswith(b"HTTP/1.1 503")
    with connect(f"ws://127.0.0.1:{port}", compression=None) as small:
        small.recv(timeout=30)
        small.send(wire.pack({"request": "status"}))
        assert wire.unpack(small.recv(timeout=30))["damaged"] == []
    first.sendall(bytes(324 << 10))
    while held():  # until the reply
        time.sleep(0.01)
    first.close()
    assert post(port, 500 << 10).startswith(b"HTTP/1.1 422")
    service.store.close()
