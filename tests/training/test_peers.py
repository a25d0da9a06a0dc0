"""A process of a run whose other process dies ends with one line and exit code 75."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from egosim_jax.train.distributed import free_local_address
from egosim_jax.train.peers import PEER_DIED, is_peer_failure
from egosim_jax.types import InputError
from tests.flags import QUICK
from tests.training.line import write_points

REPORT = (
    "W1126 15:14:51.002613 3682 preemption_sync_manager.cc:147] Failed to retrieve\n"
    "F1126 15:14:51.002704 3682 client.h:80] Terminating process because the JAX distributed "
    "service detected fatal errors.\n*** Check failure stack trace: ***\n    @ 0x7f7bdc240634\n"
)


def start(code: str, **options) -> subprocess.Popen:
    program = (
        "import os, sys, time; from egosim_jax.train import peers; peers.HOLD_S = 1.0\n"
        f"from egosim_jax.train.peers import run_in_child\n{code}"
    )
    return subprocess.Popen([sys.executable, "-c", program], text=True, **options)


@pytest.mark.parametrize(
    ("code", "ends", "says"),
    [
        (f"sys.stderr.write({REPORT!r}); sys.stderr.flush(); os.abort()", 75, f"{PEER_DIED}\n"),
        (
            f"sys.stderr.write({REPORT!r}); sys.stderr.flush(); time.sleep(2); os.abort()",
            75,
            f"{PEER_DIED}\n",
        ),
        (f"sys.stderr.write({REPORT!r}); sys.exit(1)", 1, REPORT),
        ("sys.stderr.write('a defect'); sys.stderr.flush(); os.abort()", -6, "a defect"),
        ("sys.stderr.write('as usual'); sys.exit(3)", 3, "as usual"),
        ("os.kill(os.getpid(), 9)", -9, ""),
        ("os.close(2); time.sleep(0.2); os._exit(70)", 70, ""),
    ],
    ids=["report", "slow report", "report and exit", "abort", "exit", "killed", "closed stderr"],
)
def test_a_child_is_replaced_only_by_the_report_of_jax(code, ends, says):
    process = start(f"run_in_child()\n{code}", stderr=subprocess.PIPE)
    assert process.communicate(timeout=60)[1] == says
    assert process.returncode == ends


def test_sigterm_reaches_the_child_and_sigkill_ends_it():
    code = (
        "import signal; run_in_child(); signal.signal(15, lambda *_: os._exit(75))\n"
        "print('ready', flush=True); time.sleep(60)"
    )
    for number, ends in ((signal.SIGTERM, 75), (signal.SIGKILL, -9)):
        with start(code, stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            process.stdout.readline()
            process.send_signal(number)
            assert process.wait(timeout=30) == ends
            assert process.stdout.read() == ""  # the child, which has the other end, has ended


def test_errors_of_lost_connections_differ_from_others():
    for text in ("Gloo all-reduce failed: Connection closed by peer", "NCCL error: unhandled"):
        assert is_peer_failure(RuntimeError(text))
        assert is_peer_failure(ValueError(f"UNKNOWN: {text}"))  # by `multihost_utils`
    assert not is_peer_failure(RuntimeError("RESOURCE_EXHAUSTED: out of memory"))
    wrapped = InputError("the checkpoint cannot be read")
    wrapped.__cause__ = RuntimeError("UNAVAILABLE: the coordination service is gone")
    assert is_peer_failure(wrapped)
    assert not is_peer_failure(InputError("gloo/nccl.mp4 is missing"))
    assert not is_peer_failure(RuntimeError("RESOURCE_EXHAUSTED: optimization-barrier.3"))


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["first", "second", "second's child"])
def test_the_other_of_two_processes_ends_with_one_line(tmp_path, victim):
    data = write_points(tmp_path / "data")
    address, settings = (
        free_local_address(),
        json.dumps({"steps": 10**6, "pause": 0.01, "save_every": 10**6}),
    )
    command = [sys.executable, "-m", "tests.training.line", str(tmp_path / "out"), str(data)]
    processes = []
    for index in range(2):
        environment = os.environ | {
            "XLA_FLAGS": QUICK,
            "JAX_COORDINATOR_ADDRESS": address,
            "JAX_NUM_PROCESSES": "2",
            "JAX_PROCESS_ID": str(index),
        }
        with (tmp_path / f"{index}.log").open("w") as log:
            processes.append(
                subprocess.Popen([*command, settings], env=environment, stdout=log, stderr=log)
            )
    metrics, until = tmp_path / "out/metrics.jsonl", time.monotonic() + 300
    while not metrics.exists() or metrics.read_text().count("\n") < 10:
        assert time.monotonic() < until
        assert all(process.poll() is None for process in processes)
        time.sleep(0.05)
    killed = processes[victim != "first"]
    tasks = Path(f"/proc/{killed.pid}/task").glob("*/children")
    (child,) = {int(pid) for path in tasks for pid in path.read_text().split()}
    os.kill(child if "child" in victim else killed.pid, signal.SIGKILL)
    other = processes[victim == "first"]
    try:
        assert other.wait(timeout=55) == 75
    finally:
        for process in processes:
            process.kill()
            process.wait()
    text = (tmp_path / f"{int(victim == 'first')}.log").read_text()
    said = [line for line in text.splitlines() if not line.startswith(("step", "[Gloo]"))]
    assert said[-1] == PEER_DIED
    assert "stack" not in text
    assert "Traceback" not in text
