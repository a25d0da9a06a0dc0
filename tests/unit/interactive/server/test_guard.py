"""Requests refused before they are read, and bounds on connections."""

import asyncio
import base64
import http.client as http_client
import io
import json
import socket
import tempfile
import threading
import zipfile

import pytest
import websockets.sync.client

from egosim_jax.interactive.options import Limits
from egosim_jax.interactive.server import guard, wire
from egosim_jax.interactive.server.client import Client
from egosim_jax.interactive.server.server import make_app
from tests.unit.interactive.server.served import TOKEN, http, run


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "http://["}, 400),
        ({"Host": "evil.example"}, 403),
    ],
)
def test_pages_of_other_origins_are_refused(server, headers, status):
    _, port = server
    assert http(port, "/sessions", **headers)[0] == status
    address = f"ws://127.0.0.1:{port}"
    with (
        pytest.raises(websockets.exceptions.InvalidStatus),
        websockets.sync.client.connect(address, additional_headers=headers),
    ):
        pass


def test_a_body_too_large_or_no_json_is_refused(server):
    _, port = server
    connection = http_client.HTTPConnection("127.0.0.1", port, timeout=60)
    connection.putrequest("POST", "/sessions")
    connection.putheader("Content-Length", str(wire.MAX_BYTES + 1))
    connection.endheaders()
    with connection.getresponse() as reply:
        assert (reply.status, json.loads(reply.read())["code"]) == (413, "too_large")
    connection.close()
    for path, fields, code in (("/sessions", [1], "invalid"), ("/fly", None, "unknown_path")):
        assert json.loads(http(port, path, fields)[1])["code"] == code


def post(service, receive):
    """Status and code of the reply to a request whose body `receive` returns."""
    sent = []

    async def send(message):
        sent.append(message)

    headers = [(b"host", b"localhost"), (b"content-type", b"application/json")]
    scope = {"type": "http", "method": "POST", "path": "/sessions", "headers": headers}
    asyncio.run(make_app(service)({**scope, "query_string": b""}, receive, send))
    return sent[0]["status"], json.loads(sent[1]["body"])["code"]


def test_a_body_that_grows_too_large_is_refused(server):
    async def receive():
        return {"type": "http.request", "body": bytes(1 << 20), "more_body": True}

    assert post(server[0], receive) == (413, "too_large")


@pytest.mark.parametrize(
    ("data", "kind", "status"),
    [
        (b"[" * 300_000, "application/json", 422),
        (b'{"seed": ' + b"[" * 20 + b"]" * 20 + b"}", "application/json", 422),
        (b'{"seed": 1, "seed": 2}', "application/json", 422),
        (b"{}", "text/plain", 415),
    ],
    ids=["items", "depth", "names", "kind"],
)
def test_a_body_that_is_no_bounded_json_is_refused(server, data, kind, status):
    connection = http_client.HTTPConnection("127.0.0.1", server[1], timeout=60)
    connection.request("POST", "/sessions", data, {"Content-Type": kind})
    with connection.getresponse() as reply:
        assert (reply.status, json.loads(reply.read())["code"]) == (status, "invalid")
    connection.close()


def test_a_body_that_comes_too_slowly_is_refused(server, monkeypatch):
    monkeypatch.setattr(guard, "BODY_TIMEOUT_S", 0.01)

    async def receive():
        await asyncio.sleep(60)

    assert post(server[0], receive) == (408, "too_slow")


def test_an_idle_connection_is_closed_and_one_above_the_limit_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(guard, "HEAD_S", 0.4)
    service, port, _ = run(tmp_path, limits=Limits(connections=1))
    with Client(f"ws://127.0.0.1:{port}") as client:
        status, body = http(port, "/healthz")
        assert (status, json.loads(body)["code"]) == (503, "too_many_connections")
        threading.Event().wait(0.5)
        assert client.request("status")["sessions"] == {}
    with socket.create_connection(("127.0.0.1", port), timeout=10) as slow:
        slow.sendall(b"GET / HTTP/1.1\r\nHost: ")
        assert slow.recv(1) == b""
    assert http(port, "/healthz")[0] == 200
    service.store.close()


def test_a_token_is_asked_for(tmp_path):
    service, port, _ = run(tmp_path, token=TOKEN)
    assert http(port, "/healthz")[0] == 200
    for given, status in (
        ({}, 401),
        ({"Authorization": "Bearer wrong"}, 401),
        ({"Authorization": f"Api-Key {TOKEN}"}, 200),
        ({"Authorization": f"bearer {TOKEN}"}, 200),
        ({"Authorization": f"Bearer {TOKEN}", "Host": "a/healthz?"}, 200),
        ({"Host": "a/healthz?"}, 401),  # the header opens no path
    ):
        assert http(port, "/sessions", **given)[0] == status
    with Client(f"ws://127.0.0.1:{port}", token=TOKEN) as client:
        assert client.request("status")["sessions"] == {}
    service.store.close()


def test_the_sessions_that_are_kept_are_bounded(tmp_path):
    service, port, _ = run(tmp_path, limits=Limits(kept=1))
    for name in ("one", "two"):
        assert http(port, "/sessions", {"session": name})[0] == 200
    assert http(port, "/sessions/one?keep=true", method="DELETE")[0] == 200
    status, body = http(port, "/sessions/two?keep=true", method="DELETE")
    assert (status, json.loads(body)["code"]) == (429, "too_many_kept")
    assert http(port, "/sessions/two", method="DELETE")[0] == 200
    service.store.close()


def test_an_episode_that_is_refused_says_nothing_of_the_servers_folders(server):
    _, port = server
    assert http(port, "/sessions", {"session": "told"})[0] == 200
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        archive.writestr("state/state.json", "{}")
    episode = base64.b64encode(data.getvalue()).decode()
    status, body = http(port, "/sessions/told/reset", {"episode": episode})
    assert status == 422
    assert tempfile.gettempdir() not in body.decode()
