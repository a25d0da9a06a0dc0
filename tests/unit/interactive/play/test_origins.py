"""The page of `egosim play` is for this machine, and for its own page."""

import http.client
from importlib.util import find_spec

import pytest
import websockets.sync.client

from egosim_jax.interactive.origins import is_local

pytestmark = pytest.mark.skipif(find_spec("viser") is None, reason="needs viser")


@pytest.mark.parametrize(
    ("host", "origin", "local"),
    [
        ("127.0.0.1:80", None, True),
        ("localhost:80", "http://localhost:80", True),
        ("[::1]:80", "http://[::1]:80", True),
        ("evil.example", None, False),
        ("localhost:80", "http://evil.example", False),
        ("localhost:80", "http://localhost:81", False),
        ("localhost.evil.example", None, False),
        ("[", None, False),
    ],
)
def test_which_requests_are_local(host, origin, local):
    assert is_local(host, origin) is local


@pytest.fixture(scope="module")
def port():
    from egosim_jax.interactive.play.local_server import LocalServer

    server = LocalServer("127.0.0.1", 0)
    yield server.get_port()
    server.stop()


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ([("Host", "localhost:{}"), ("Origin", "http://localhost:{}")], 200),
        ([("Host", "evil.example")], 403),
        ([("Host", "127.0.0.1:{}"), ("Origin", "null")], 403),
        ([("Host", "127.0.0.1:{}"), ("Host", "evil.example")], 403),
    ],
)
def test_foreign_pages_do_not_reach_the_page(port, headers, status):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in headers:
        connection.putheader(name, value.format(port))
    connection.endheaders()
    assert connection.getresponse().status == status
    connection.close()


@pytest.mark.parametrize("origin", ["http://evil.example", "http://127.0.0.1:1"])
def test_foreign_pages_do_not_reach_the_websocket(port, origin):
    with (
        pytest.raises(websockets.exceptions.InvalidStatus, match="403"),
        websockets.sync.client.connect(f"ws://127.0.0.1:{port}", origin=origin),
    ):
        pass
