"""Requests refused before they are read, and bounds on connections."""

import asyncio
import base64
import http.client as http_client
import io
import json
import socket
import tempfile
import threading
import urllib.error
import urllib.request
import zipfile

import pytest
import websockets.sync.client
from fastapi import FastAPI
from starlette.datastructures import URL
from starlette.requests import HTTPConnection

from egosim_jax.interactive.server import connections, guard, wire
from egosim_jax.interactive.server.client import Client
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.interactive.server.guard import Guard
from egosim_jax.interactive.server.server import make_app
from egosim_jax.interactive.server.store import Limits
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


def test_a_body_of_too_many_items_or_of_another_kind_is_refused(server):
    _, port = server
    for data, kind, status in (
        (b"[" * 300_000, "application/json", 422),
        (b'{"seed": ' + b"[" * 20 + b"]" * 20 + b"}", "application/json", 422),
        (b"{}", "text/plain", 415),
    ):
        request = urllib.request.Request(
            f"http://127.0.0.1:{port}/sessions", data=data, headers={"Content-Type": kind}
        )
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(request, timeout=60)  # noqa: S310 - of this machine
        with refused.value as error:
            found = json.loads(error.read())
        assert (error.code, found["code"]) == (status, "invalid")


def test_a_body_that_comes_too_slowly_is_refused(server, monkeypatch):
    monkeypatch.setattr(guard, "BODY_TIMEOUT_S", 0.01)

    async def receive():
        await asyncio.sleep(60)

    assert post(server[0], receive) == (408, "too_slow")


def test_an_idle_connection_is_closed_and_one_above_the_limit_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(connections, "HEAD_S", 0.4)
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
    assert http(port, "/sessions")[0] == 401
    assert http(port, "/sessions", Authorization="Bearer wrong")[0] == 401
    assert http(port, "/sessions", Authorization=f"Api-Key {TOKEN}")[0] == 200
    assert http(port, "/sessions", Authorization=f"bearer {TOKEN}")[0] == 200
    with Client(f"ws://127.0.0.1:{port}", token=TOKEN) as client:
        assert client.request("status")["sessions"] == {}
    service.store.close()


class OldConnection(HTTPConnection):
    """Connection whose URL begins with the Host header, as in older Starlette versions."""

    url = URL("http://a/healthz?/sessions")


def test_the_host_header_does_not_open_a_path():
    headers = [(b"host", b"a/healthz?")]
    connection = OldConnection({"type": "http", "path": "/sessions", "headers": headers})
    with pytest.raises(RequestError, match="token"):
        Guard(FastAPI(), token=TOKEN)._check(connection)


def test_the_sessions_that_are_kept_are_bounded(tmp_path):
    service, port, _ = run(tmp_path, limits=Limits(kept=1))
    for name in ("one", "two"):
        assert http(port, "/sessions", {"session": name})[0] == 200
    assert http(port, "/sessions/one?keep=true", method="DELETE")[0] == 200
    status, body = http(port, "/sessions/two?keep=true", method="DELETE")
    assert (status, json.loads(body)["code"]) == (429, "too_many_kept")
    assert http(port, "/sessions/two", method="DELETE")[0] == 200
    service.store.close()


def test_repeated_names_and_large_documents_are_refused(server):
    _, port = server
    for body in (b'{"seed": 1, "seed": 2}', b'{"seed": ' + b"[" * 100_000 + b"}"):
        connection = http_client.HTTPConnection("127.0.0.1", port, timeout=60)
        connection.request("POST", "/sessions", body, {"Content-Type": "application/json"})
        with connection.getresponse() as reply:
            assert reply.status == 422
        connection.close()
    with pytest.raises(Exception, match="repeated"):
        wire.unpack(b"\x82\xa1a\x01\xa1a\x02", limit=100)


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
