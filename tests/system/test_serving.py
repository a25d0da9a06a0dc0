"""A killed server resumes its sessions; clients continue, also OpenPI's from its own environment.

    python -m venv openpi && openpi/bin/pip install openpi-client typing_extensions
    OPENPI_PYTHON=openpi/bin/python pytest -m slow tests/system/test_serving.py

The same with the model that comes with the package, printed step by step, with batches of 4 clips:

    OPENPI_PYTHON=openpi/bin/python python -m tests.system.test_serving FOLDER 4
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.interactive.server.client import Client

ROOT = Path(__file__).parents[2]
STEPS = 4
NEEDS_OPENPI = pytest.mark.skipif(
    "OPENPI_PYTHON" not in os.environ,
    reason="no OPENPI_PYTHON: it needs numpy < 2",
)

OURS = """
import sys
from egosim_jax.interactive.server.client import Client
def connect(port):
    client = Client(f"ws://127.0.0.1:{port}")
    return lambda name, **fields: client.request(name, **fields), client.server
"""
OPENPI = """
import sys
from openpi_client.websocket_client_policy import WebsocketClientPolicy
def connect(port):
    policy = WebsocketClientPolicy("127.0.0.1", port)
    ask = lambda name, **fields: policy.infer({"request": name, **fields})
    return ask, policy.get_server_metadata()
"""
DRIVE = """
import json, numpy as np
port, session, seed, steps = int(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
ask, server = connect(port)
if session not in ask("status")["sessions"]:
    ask("create", session=session, seed=seed)
row = np.array([0.15, 0.02, 0.16, -0.5, 0.0, 0.4, 0.25])
path = np.linspace(0, 0.03, server["rows"])[:, None] * np.eye(7)[1]
for number in range(1, steps + 1):
    rows = row + path + 0.03 * (number - 1) * np.eye(7)[1]
    reply = ask("step", session=session, step_id=number, actions=rows)
    state, frames = reply["info"]["state_sha256"], int(reply["frames"].sum())
    print(json.dumps([number, state, frames]), flush=True)
"""


class Server:
    """A server in a process, and the port it listens on."""

    def __init__(self, folder, command):
        environment = {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
        self.process = subprocess.Popen(
            [sys.executable, "-m", *command, str(folder)],
            stdout=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env=environment,
        )
        self.port = self.process.stdout.readline().strip().rpartition(":")[2]
        assert self.port, "the server does not start"

    def end(self, number):
        self.process.send_signal(number)
        code = self.process.wait(120)
        self.process.stdout.close()
        return code


def client(kind, port, session, seed):
    """A process that makes all steps of a session; steps that were made before are repeated."""
    python = os.environ["OPENPI_PYTHON"] if kind is OPENPI else sys.executable
    command = [python, "-c", kind + DRIVE, port, session, str(seed), str(STEPS)]
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, cwd=ROOT
    )


def lines(process, found):
    """Collect a client's lines as they come."""
    with process:
        for line in process.stdout:
            found.append(json.loads(line))
            print(found[-1], flush=True)


def drive(kind, port, *, names="ab", until=None):
    """Run two clients at once until they end, or until one has made some steps."""
    clients = [client(kind, port, name, seed) for name, seed in zip(names, (3, 4), strict=True)]
    found = [[], []]
    threads = [
        threading.Thread(target=lines, args=pair) for pair in zip(clients, found, strict=True)
    ]
    for thread in threads:
        thread.start()
    if until is not None:
        while max(map(len, found)) < until and any(p.poll() is None for p in clients):
            time.sleep(0.01)
        return clients, threads, found
    for thread in threads:
        thread.join()
    return clients, threads, found


def committed(folder):
    """The hash of the state of each committed step, and the sessions with a step under way."""
    states, underway = {}, []
    for path in sorted(folder.glob("*/steps/*/request.json")):
        session, number = path.parts[-4], int(path.parts[-2])
        info = path.with_name("info.json")
        if info.exists():
            states[session, number] = json.loads(info.read_text())["state_sha256"]
        else:
            underway.append(session)
    return states, underway


def kill_and_continue(kind, command, folder):
    """Kill the server in mid step, continue: the steps before and after, what was committed."""
    server = Server(folder, command)
    clients, threads, before = drive(kind, server.port, until=2)
    time.sleep(0.3)
    server.end(signal.SIGKILL)
    for process, thread in zip(clients, threads, strict=True):
        process.wait(60)
        thread.join()
    states, underway = committed(folder)
    print(f"killed with {len(states)} committed steps, {underway} under way", flush=True)
    server = Server(folder, command)
    after = drive(kind, server.port)[2]
    straight = drive(kind, server.port, names="cd")[2]
    assert server.end(signal.SIGTERM) == 0
    return before, after, straight, (states, underway)


def check_kept(before, after, killed):
    """Check that all committed steps are as they were, and that all steps are made once."""
    kept, underway = killed
    assert underway
    assert all(underway.count(session) == 1 for session in underway)
    for session, some, all_ in zip("ab", before, after, strict=True):
        assert [step[0] for step in all_] == list(range(1, STEPS + 1))
        assert some == all_[: len(some)]
        assert len(some) < STEPS
        states = {number: state for number, state, _ in all_}
        steps = [number for name, number in kept if name == session]
        assert steps == list(range(1, len(steps) + 1))
        assert all(kept[session, number] == states[number] for number in steps)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [OURS, pytest.param(OPENPI, marks=NEEDS_OPENPI)], ids=len)
def test_clients_continue_after_a_kill_to_the_same_states(tmp_path, kind, capfd):
    command = ["tests.painted", "--pause", "0.5", "--batch", "2"]
    before, after, straight, killed = kill_and_continue(kind, command, tmp_path)
    check_kept(before, after, killed)
    assert after == straight
    assert "a batch of 2" in capfd.readouterr().err


@pytest.mark.slow
def test_two_streams_of_a_batch_come_as_they_are_decoded_and_survive_a_kill(tmp_path):
    command = ["tests.painted", "--pause", "0.5", "--batch", "2"]
    server, rested = Server(tmp_path, command), {}

    def stream(name, step_id, shown):
        with Client(f"ws://127.0.0.1:{server.port}") as one:
            session = one.create(session=name, seed=3) if step_id == 1 else one.attach(name)
            rested[name] = session.reply.get("row", rested.get(name))
            rows = np.tile(rested[name], (4, 1)) + 0.01 * step_id
            return session.step(rows, show=shown.append)

    shown = {name: [] for name in "ab"}
    with ThreadPoolExecutor(2) as threads:
        replies = [threads.submit(stream, name, 1, shown[name]) for name in "ab"]
        for name, reply in zip("ab", replies, strict=True):
            found = reply.result()
            np.testing.assert_array_equal(np.concatenate(shown[name]), found["frames"])
            times = found["timing"]
            assert 0 < times["first_frames_s"] < times["last_frames_s"]
        parts = []
        broken = threads.submit(stream, "a", 2, parts)
        while not parts:
            time.sleep(0.01)
        server.end(signal.SIGKILL)
        assert broken.exception() is not None
    server = Server(tmp_path, command)
    again = []
    with Client(f"ws://127.0.0.1:{server.port}") as one:
        session = one.attach("a")
        session.step_id = 1
        reply = session.step(np.tile(rested["a"], (4, 1)) + 0.02, show=again.append)
    np.testing.assert_array_equal(reply["frames"][:1], parts[0])
    assert not again  # the step was on disk: the restarted server makes it before it is asked
    assert server.end(signal.SIGTERM) == 0


if __name__ == "__main__":
    batch = sys.argv[2:] or ["1"]
    served = ["egosim_jax.cli", "serve", "--port", "0", "--batch", *batch, "--out"]
    kinds = OPENPI if "OPENPI_PYTHON" in os.environ else OURS
    begun, continued, uninterrupted, at_kill = kill_and_continue(kinds, served, Path(sys.argv[1]))
    check_kept(begun, continued, at_kill)
    print("every committed step is as it was, the steps under way are made")
    equal = continued == uninterrupted
    print("equal to the byte" if equal else f"the uninterrupted run differs: {uninterrupted}")
