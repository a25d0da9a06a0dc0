"""Server in this process, reached over its sockets."""

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import websockets.sync.client

from egosim_jax.interactive.origins import bind
from egosim_jax.interactive.server import wire
from egosim_jax.interactive.server.client import Client
from egosim_jax.interactive.server.errors import RequestError
from egosim_jax.types import InputError
from tests.painted import VIDEO, WRIST, PaintedWorld, Painter
from tests.unit.interactive.server.served import http, run


def test_a_client_waits_for_a_server_that_starts(tmp_path):
    bound = bind("127.0.0.1", 0, token=None)
    address = f"ws://127.0.0.1:{bound.getsockname()[1]}"
    with pytest.raises(ConnectionRefusedError):
        Client(address)
    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(Client, address, wait=60.0)
        time.sleep(0.5)
        assert not waiting.done()
        service, _, _ = run(tmp_path, bound=bound)
        with waiting.result(60) as client:
            assert client.server["world"] == "painted"
    service.store.close()


def test_two_clients_step_their_sessions_and_one_continues_the_others(server):
    _, port = server
    with Client(f"ws://127.0.0.1:{port}") as a, Client(f"ws://127.0.0.1:{port}") as b:
        assert a.server["rows"] == 4
        one, two = a.create(seed=3), b.create(seed=3)
        rows = np.tile(one.reply["row"], (4, 1))
        replies = [session.step(rows, observe=["frames", "depth"]) for session in (one, two)]
        np.testing.assert_array_equal(replies[0]["frames"], replies[1]["frames"])
        assert replies[0]["depth"].shape == replies[0]["frames"].shape[1:3]
        same = b.attach(one.id)
        assert same.step(rows)["step_id"] == 2
        with pytest.raises(RequestError, match="made with another action"):
            one.step(rows + 0.01)
        assert one.status()["committed_step_id"] == 2
        one.close()
        with pytest.raises(RequestError, match="no session"):
            same.status()


def test_a_reply_has_the_observed_frames_and_depth_of_further_cameras(server):
    _, port = server
    wrist = {"name": "wrist", "mount": "right_wrist", "pose": WRIST, "field_of_view_deg": 90}
    with Client(f"ws://127.0.0.1:{port}") as client:
        assert "right_wrist" in client.server["mounts"]
        session = client.create(seed=3, cameras=[wrist], observe=["wrist.frames"])
        declared = {**wrist, "pose": WRIST.tolist()}
        assert session.reply["cameras"] == session.status()["cameras"] == [declared]
        assert "frames" not in session.reply
        rows, shown = np.tile(session.reply["row"], (4, 1)), []
        observe = ["frames", "wrist.frames", "wrist.depth"]
        reply = session.step(rows, observe=observe, show=shown.append)
        np.testing.assert_array_equal(np.concatenate(shown), reply["frames"])
        assert reply["wrist.frames"].shape == reply["frames"].shape
        assert reply["wrist.depth"].shape == reply["frames"].shape[1:3]
        assert reply["info"]["unobserved"].keys() == {"wrist"}
        assert session.reset()["frames"].shape[0] == 1
        with pytest.raises(RequestError, match=r"wrist\.frames, wrist\.depth"):
            session.step(rows, observe=["side.frames"])
        with pytest.raises(RequestError, match="at most 8 maps"):
            client.create(cameras=[wrist] * 9)


def test_a_client_that_vanishes_loses_nothing(server):
    _, port = server
    with Client(f"ws://127.0.0.1:{port}") as client:
        session = client.create(seed=3)
    rows = np.tile(session.reply["row"], (4, 1))
    fields = {"session": session.id, "step_id": 1, "actions": rows}
    with websockets.sync.client.connect(f"ws://127.0.0.1:{port}") as vanishing:
        vanishing.send(wire.pack({"request": "step", **fields}))
    with Client(f"ws://127.0.0.1:{port}") as again:
        assert again.attach(session.id).step_id in (0, 1)
        found = again.attach(session.id)
        found.step_id = 0
        assert found.step(rows)["step_id"] == 1


class Gated(Painter):
    """Painter whose last frames wait for `opened`."""

    def __init__(self):
        super().__init__()
        object.__setattr__(self, "opened", threading.Event())

    def stream(self, view, action, first_frame, seed):
        frames = self(view, action, first_frame, seed)
        yield frames[:1]
        assert self.opened.wait(30)
        yield frames[1:]


@pytest.fixture
def gated(tmp_path):
    painter = Gated()
    world = PaintedWorld(generator=painter, video=VIDEO, perception=None)
    service, port, _ = run(tmp_path, world=world)
    yield painter, service, port
    painter.opened.set()
    service.store.close()


def test_a_streamed_step_is_shown_before_it_is_decoded(gated):
    painter, service, port = gated
    with Client(f"ws://127.0.0.1:{port}") as client:
        session, shown = client.create(seed=3), []
        rows = np.tile(session.reply["row"], (4, 1))

        def show(frames):
            if not shown:
                assert service.store.get(session.id).committed == 0
            shown.append(frames)
            painter.opened.set()

        reply = session.step(rows, show=show)
        assert [len(frames) for frames in shown] == [1, 4]
        np.testing.assert_array_equal(np.concatenate(shown), reply["frames"])
        timing = reply.pop("timing")
        assert 0 < timing["first_frames_s"] <= timing["last_frames_s"]
        session.step_id = 0
        shown.clear()
        again = session.step(rows, show=show)
        assert not shown
        assert again.keys() == reply.keys()
        assert again["info"] == reply["info"]
    assert b"egosim_first_frames_seconds_count 1.0" in http(port, "/metrics")[1]


def test_a_client_that_vanishes_in_a_stream_leaves_its_step_to_be_made(gated):
    painter, service, port = gated
    client = Client(f"ws://127.0.0.1:{port}")
    session = client.create(seed=3)
    rows = np.tile(session.reply["row"], (4, 1))

    def vanish(frames):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        session.step(rows, show=vanish)
    with Client(f"ws://127.0.0.1:{port}") as again:
        same = again.attach(session.id)
        shown = []
        with ThreadPoolExecutor(1) as thread:
            reply = thread.submit(same.step, rows, show=shown.append)
            painter.opened.set()
            assert reply.result()["step_id"] == 1
        assert not shown  # the step is under way for the client that vanished
    assert service.store.get(session.id).committed == 1


def test_an_error_ends_a_stream_and_the_connection_stays(gated, monkeypatch):
    painter, _, port = gated

    def fail(*_):
        yield np.zeros((1, 32, 48, 3), np.uint8)
        raise FloatingPointError

    with Client(f"ws://127.0.0.1:{port}") as client:
        session, shown = client.create(seed=3), []
        rows = np.tile(session.reply["row"], (4, 1))
        with monkeypatch.context() as patched:
            patched.setattr(Gated, "stream", fail)
            with pytest.raises(RequestError, match="not finite"):
                session.step(rows, show=shown.append)
        assert len(shown) == 1
        with pytest.raises(RequestError, match="stream is 1: it must be true or false"):
            client.request("step", session=session.id, step_id=1, actions=rows, stream=1)
        painter.opened.set()
        assert session.step(rows, show=shown.append)["step_id"] == 1


def test_http_has_the_same_requests(server):
    _, port = server
    status, body = http(port, "/sessions", {"seed": 3})
    session = json.loads(body)
    assert status == 200
    rows = [session["row"]]
    path = f"/sessions/{session['session']}"
    _, body = http(port, f"{path}/step", {"step_id": 1, "actions": rows, "observe": ["frames"]})
    assert json.loads(body)["frames"]["shape"] == [5, 32, 48, 3]
    status, body = http(port, f"{path}/step", {"step_id": 9, "actions": rows})
    assert (status, json.loads(body)["code"]) == (409, "step_out_of_order")
    assert http(port, f"{path}/save", {"name": "a"})[0] == 200
    assert json.loads(http(port, path)[1])["saved"] == ["a"]
    assert http(port, path, method="DELETE")[0] == 200
    assert http(port, path)[0] == 404
    paths = json.loads(http(port, "/openapi.json")[1])["paths"]
    assert "/sessions/{session}/step" in paths


def test_health_and_metrics(server):
    _, port = server
    assert http(port, "/healthz") == (200, b"OK\n")
    assert http(port, "/readyz")[0] == 200
    assert b"egosim_sessions" in http(port, "/metrics")[1]


def test_a_client_waits_while_the_server_is_full(server, monkeypatch):
    service, port = server
    create, refusals = service.store.create, []

    def full(request):
        if len(refusals) < 2:
            refusals.append(request)
            raise RequestError(429, "too_many_sessions", "Full.", retry_after_s=0.01)
        return create(request)

    monkeypatch.setattr(service.store, "create", full)
    with Client(f"ws://127.0.0.1:{port}", patience_s=10.0) as client:
        client.create(seed=3).close()
    assert len(refusals) == 2
    refusals.clear()
    hasty = Client(f"ws://127.0.0.1:{port}", patience_s=0.0)
    with hasty, pytest.raises(RequestError, match="Full"):
        hasty.create(seed=3)


def test_text_and_damaged_messages_are_refused_and_the_connection_stays(server):
    _, port = server
    with websockets.sync.client.connect(f"ws://127.0.0.1:{port}") as socket:
        socket.recv()
        for data in ("text", b"", b"\xc1", wire.pack([1]), wire.pack({"request": "fly"})):
            socket.send(data)
            assert json.loads(socket.recv())["status"] == 422
    with Client(f"ws://127.0.0.1:{port}") as client:
        with pytest.raises(RequestError, match="observe has"):
            client.request("create", observe=[np.zeros(2)])
        with pytest.raises(RequestError, match="no field 'seeds'"):
            client.request("create", seeds=3)
        assert client.request("status")["draining"] is False


def test_another_address_needs_a_token():
    with pytest.raises(InputError, match="needs a token"):
        bind("0.0.0.0", 0, token=None)  # noqa: S104


def test_a_port_in_use_is_refused(server):
    with pytest.raises(InputError, match="Choose another port"):
        bind("127.0.0.1", server[1], token=None)


def test_a_defect_is_logged_and_counted(server, monkeypatch, capsys):
    service, port = server

    def fail(request):
        raise OSError("no space")

    with monkeypatch.context() as patched:
        patched.setattr(service, "status", fail)
        assert http(port, "/sessions")[0] == 500
    assert "no space" in capsys.readouterr().err
    assert b'egosim_refused_total{code="internal"} 1.0' in http(port, "/metrics")[1]
