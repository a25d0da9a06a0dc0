"""Policies by name: functions, classes, servers and scripted ones."""

import json
import threading
import time

import msgpack
import numpy as np
import pytest
import websockets.sync.server

from egosim_jax.interactive.env import ActionSpec
from egosim_jax.trials import policies
from egosim_jax.trials.policies import RowsError, Serving, parse, parse_all, parse_sent, rows_of
from egosim_jax.types import InputError
from tests.unit.trials import conftest

MODULE = "tests.unit.trials.conftest"
SPEC = ActionSpec()
OBSERVATION = {
    "image": np.full((4, 6, 3), 7, np.uint8),
    "row": SPEC.rest,
    "prompt": "Lift the red box.",
    "chunk": 0,
}


def read(text):
    return parse(text, SPEC, Serving())


def pack(array):
    """An array in the format of openpi_client.msgpack_numpy, written without our code."""
    return {
        b"__ndarray__": True,
        b"data": array.tobytes(),
        b"dtype": array.dtype.str,
        b"shape": array.shape,
    }


def unpack(found):
    if b"__ndarray__" not in found:
        return found
    return np.ndarray(buffer=found[b"data"], dtype=found[b"dtype"], shape=found[b"shape"])


class Server:
    """Policy server as `openpi.serving.websocket_policy_server` has it: metadata, then replies."""

    def __init__(self, reply):
        self.reply, self.seen, self.headers = reply, [], []
        self.server = websockets.sync.server.serve(self.handle, "127.0.0.1", 0, compression=None)
        self.port = self.server.socket.getsockname()[1]
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def handle(self, connection):
        self.headers.append(connection.request.headers.get("Authorization"))
        connection.send(msgpack.packb({"robot": "test"}))
        for message in connection:
            self.seen.append(msgpack.unpackb(message, object_hook=unpack))
            connection.send(self.reply(self.seen[-1]))


@pytest.fixture
def server():
    """A server of the policy `forward`."""

    def reply(observation):
        rows = observation["observation/state"] + 0.01 * np.arange(3)[:, None]
        return msgpack.packb({"actions": pack(rows), "server_timing": {"infer_ms": 1.0}})

    made = Server(reply)
    yield made
    made.server.shutdown()


@pytest.mark.parametrize("kind", ["openpi:127.0.0.1:{}", "ws://127.0.0.1:{}"])
def test_a_policy_server_gets_the_observation_and_returns_rows(server, kind):
    policy = read(f"pi={kind.format(server.port)}")
    policy.open()
    assert policy.name == "pi"
    with policy.agent(None, 0) as infer:
        reply = infer(OBSERVATION)
        infer(OBSERVATION)
    rows = rows_of(reply, SPEC, SPEC.rest, 17)
    np.testing.assert_allclose(rows, SPEC.rest + 0.01 * np.arange(3)[:, None])
    first, _ = server.seen
    assert sorted(first) == ["observation/image", "observation/state", "prompt"]
    assert first["prompt"] == "Lift the red box."
    np.testing.assert_array_equal(first["observation/image"], OBSERVATION["image"])


def test_keys_and_the_api_key_can_be_chosen(server, monkeypatch):
    monkeypatch.setenv(policies.KEY, "secret")
    sent = parse_sent(
        ["observation/exterior_image_1_left=image", "prompt=prompt", "observation/state=row"]
    )
    policy = parse(f"openpi:127.0.0.1:{server.port}", SPEC, Serving(sent=sent))
    with policy.agent(None, 0) as infer:
        infer(OBSERVATION)
    assert "observation/exterior_image_1_left" in server.seen[0]
    assert server.headers == ["Api-Key secret"]


def test_an_error_of_the_server_is_its_last_line():
    server = Server(lambda seen: "Traceback:\n  in infer\nKeyError: 'wrist_image'")
    policy = read(f"openpi:127.0.0.1:{server.port}")
    with (
        policy.agent(None, 0) as infer,
        pytest.raises(RuntimeError, match="the policy server failed: KeyError: 'wrist_image'"),
    ):
        infer(OBSERVATION)
    server.server.shutdown()


def test_a_server_that_ends_fails_the_trial_alone(server):
    policy = read(f"openpi:127.0.0.1:{server.port}")
    policy.open()
    server.server.shutdown()
    with pytest.raises(ConnectionRefusedError), policy.agent(None, 0):
        pass


def test_a_server_that_does_not_listen_is_refused_before_work():
    with pytest.raises(InputError, match="--policies"):
        read("openpi:127.0.0.1:9").open()


def test_a_function_and_a_class_of_a_module_are_policies():
    function = read(f"mine={MODULE}:forward")
    assert function.name == "mine"
    with function.agent(None, 0) as infer:
        assert set(infer({"row": SPEC.rest})) == {"actions"}
    counting = read(f"{MODULE}:Counting")
    conftest.Counting.resets = 0
    counting.open()
    for _ in range(2):
        with counting.agent(None, 0) as infer:
            assert [infer({"row": SPEC.rest}) is None for _ in range(3)] == [False, False, True]
    assert conftest.Counting.resets == 2


def test_trials_at_the_same_time_have_separate_objects():
    counting = read(f"{MODULE}:Counting")
    with counting.agent(None, 0) as one, counting.agent(None, 0) as other:
        assert one.__self__ is not other.__self__
    with counting.agent(None, 0) as third:
        assert third.__self__ in (one.__self__, other.__self__)


def test_a_function_is_called_by_one_trial_at_a_time(monkeypatch):
    inside, most = [], []

    def slow(observation):
        inside.append(1)
        most.append(len(inside))
        time.sleep(0.02)
        inside.pop()

    monkeypatch.setattr(conftest, "slow", slow, raising=False)
    policy = read(f"{MODULE}:slow")
    with policy.agent(None, 0) as infer:
        threads = [threading.Thread(target=infer, args=({},)) for _ in range(4)]
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
    assert most == [1] * 4


def test_a_policy_may_state_its_actions(monkeypatch):
    spec = ActionSpec(layout="gripper")
    monkeypatch.setattr(conftest.Counting, "actions", spec, raising=False)
    assert read(f"{MODULE}:Counting").actions == spec
    monkeypatch.setattr(conftest.Counting, "actions", "gripper", raising=False)
    with pytest.raises(InputError, match="must be an ActionSpec"):
        read(f"{MODULE}:Counting")


def test_a_scripted_policy_has_the_name_of_its_fault():
    policy = read("opens=opens after 50 %")
    assert (policy.name, policy.text) == ("opens", "opens after 50 %")
    assert policy.actions.layout == "keypoints"


@pytest.mark.parametrize(
    ("reply", "shape"),
    [
        (SPEC.rest, (16, 7)),
        (np.tile(SPEC.rest, (50, 1)), (16, 7)),
        ({"actions": np.tile(SPEC.rest, (3, 1))}, (3, 7)),
        ([SPEC.rest.tolist()], (1, 7)),
    ],
)
def test_rows_are_cut_to_a_clip_and_a_single_one_is_reached_over_it(reply, shape):
    assert rows_of(reply, SPEC, SPEC.rest, 17).shape == shape


def test_none_ends_a_trial():
    assert rows_of(None, SPEC, SPEC.rest, 17) is None
    assert rows_of({"actions": None}, SPEC, SPEC.rest, 17) is None


@pytest.mark.parametrize(
    "reply", [np.zeros((3, 5)), np.zeros((0, 7)), np.zeros((1, 1, 7)), {"action": 1}, "row", 3.0]
)
def test_other_replies_are_refused(reply):
    with pytest.raises(RowsError):
        rows_of(reply, SPEC, SPEC.rest, 17)


@pytest.mark.parametrize(
    "text", ["exakt", "a=", "=exact", f"{MODULE}:SPEC", f"{MODULE}:missing", "json:dumps.x"]
)
def test_what_is_no_policy_is_refused(text, monkeypatch):
    monkeypatch.setattr(conftest, "SPEC", json, raising=False)
    with pytest.raises(InputError, match="--policies"):
        read(text)


def test_names_must_differ():
    with pytest.raises(InputError, match="a=exact"):
        parse_all(["exact", "exact"], SPEC, Serving())


@pytest.mark.parametrize("text", ["image", "a=smell", "=image"])
def test_only_parts_of_an_observation_are_sent(text):
    with pytest.raises(InputError, match="--send"):
        parse_sent([text])
