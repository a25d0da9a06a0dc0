"""A process of a run whose other process dies ends with one line and exit code 75."""

import signal
import subprocess
import sys

import pytest

from egosim_jax.train.peers import PEER_DIED, is_peer_failure
from egosim_jax.types import InputError

REPORT = (
    "W1126 15:14:51.002613 3682 coordination_service_agent.cc:147] Failed to retrieve\n"
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
