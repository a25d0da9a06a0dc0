"""Connections that are slow, and the names of uvicorn that closing them needs."""

import asyncio
import operator
import socket
from importlib.metadata import version
from unittest.mock import MagicMock

import pytest
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from egosim_jax.interactive.server import connections
from tests.unit.interactive.server.served import run


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
