"""Nothing listens beyond this machine's loopback unless an address was named."""

import json
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from egosim_jax.cli import view
from egosim_jax.train.distributed import free_local_address
from tests import flags
from tests.training.line import write_points

ROOT = Path(__file__).parents[2]
LISTENING = "0A"
LOOPBACK = {"0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F"}


def descendants(pid: int) -> set[int]:
    found = {pid}
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            found |= descendants(int(child))
    return found


def listening(pid: int) -> set[str]:
    """Addresses, as the kernel writes them, on which a process or its children listen."""
    inodes = set()
    for process in descendants(pid):
        for link in Path(f"/proc/{process}/fd").iterdir():
            try:
                target = os.readlink(link)
            except OSError:
                continue
            if target.startswith("socket:"):
                inodes.add(target[8:-1])
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == LISTENING and fields[9] in inodes:
                found.add(fields[1].partition(":")[0])
    return found


def seen_while(processes: list[subprocess.Popen]) -> set[str]:
    """Every address on which any of the processes listened until they ended."""
    found: set[str] = set()
    while any(process.poll() is None for process in processes):
        for process in processes:
            try:
                found |= listening(process.pid)
            except OSError:  # it ended meanwhile
                continue
        time.sleep(0.05)
    assert [process.returncode for process in processes] == [0] * len(processes)
    return found


def test_what_listens_everywhere_would_be_seen():
    with socket.create_server(("0.0.0.0", 0)), socket.create_server(("127.0.0.1", 0)):  # noqa: S104
        assert listening(os.getpid()) >= {"00000000", "0100007F"}


def gloo_is_local() -> bool:
    found = socket.getaddrinfo(socket.gethostname(), None, type=socket.SOCK_STREAM)
    return str(found[0][4][0]).startswith("127.")


@pytest.mark.parametrize("count", [1, 2])
def test_training_listens_on_the_loopback_alone(tmp_path, count):
    if count > 1 and not gloo_is_local():
        pytest.skip("gloo listens at the address of the hostname, which is not the loopback's")
    data, address = write_points(tmp_path), free_local_address()
    settings = json.dumps({"steps": 20, "save_every": 10, "pause": 0.05})
    processes = []
    for index in range(count):
        several = {
            "JAX_COORDINATOR_ADDRESS": address,
            "JAX_NUM_PROCESSES": str(count),
            "JAX_PROCESS_ID": str(index),
        }
        command = [sys.executable, "-m", "tests.training.line", str(tmp_path / "run"), str(data)]
        processes.append(
            subprocess.Popen(
                [*command, settings],
                cwd=ROOT,
                env=os.environ | flags.devices(1) | (several if count > 1 else {}),
                stderr=subprocess.DEVNULL,
            )
        )
    found = seen_while(processes)
    assert found, "the coordination service was not seen"
    assert found <= LOOPBACK


def test_the_workers_of_a_command_listen_nowhere(tmp_path):
    """`test_secrets.py` has other commands."""
    options = "data make tabletop --scenes 2 --frames 5 --height 32 --width 48 --fps 16 --out"
    command = [sys.executable, "-m", "egosim_jax.cli", *options.split(), str(tmp_path / "out")]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    assert seen_while([subprocess.Popen(command, cwd=ROOT, **quiet)]) == set()


def opened(monkeypatch, tmp_path, **options) -> list[str]:
    commands = []

    def run(command, check):
        commands.append(command)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(view.subprocess, "run", run)
    (tmp_path / "simulation.rrd").touch()
    view.View(path=tmp_path, **options).run()
    return commands[0]


def test_the_viewer_listens_on_the_loopback_unless_an_address_is_given(monkeypatch, tmp_path):
    command = opened(monkeypatch, tmp_path)
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    command = opened(monkeypatch, tmp_path, host="192.0.2.1")
    assert command[command.index("--bind") + 1] == "192.0.2.1"


def test_rerun_listens_on_the_given_address():
    port = free_local_address().rpartition(":")[2]
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--serve-grpc"]
    process = subprocess.Popen([*command, "--port", port], stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 60
        while not (found := listening(process.pid)) and time.monotonic() < deadline:
            time.sleep(0.1)
        assert found
        assert found <= LOOPBACK
    finally:
        process.kill()
        process.wait()
