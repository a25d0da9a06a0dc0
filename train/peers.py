"""End of a run of several processes after one of them has died.

jax then aborts the other processes in C++, with a stack and signal 6. A supervisor that restarts on
exit codes would take this for a defect. So each process of such a run is a child of one that
only waits: it replaces jax's report by one line and exit code 75, and passes on everything else.
"""

from __future__ import annotations

import ctypes
import os
import re
import select
import signal
import subprocess
import sys
from typing import Any, cast

from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError

CHILD = "EGOSIM_TRAIN_CHILD"
"""Environment variable that the waiting process sets for its child."""
PEER_DIED = "another process of the run has died: run the same command again, in all processes"
HEARTBEAT_S = 45
"""Time after which a silent process counts as dead, in seconds."""
HOLD_S = 5.0
"""Time for which the waiting process keeps lines that may be the begin of jax's report."""
_REPORT = re.compile(rb"^[WEF]\d{4} [^\n]*(?:coordination_service|client\.h)", re.MULTILINE)
_FATAL = b"JAX distributed service detected fatal errors"
_LOST = re.compile(
    r"gloo|nccl|connection (?:reset|closed|refused)|socket closed|coordination service"
    r"|heartbeat timeout|barrier (?:failed|timed out)",
    re.IGNORECASE,
)
_PR_SET_PDEATHSIG = 1


def run_in_child() -> None:
    """Run this command again in a child process, wait for it and end as it ends.

    Returns in the child only, which ends with its parent.
    """
    if os.environ.pop(CHILD, None) is not None:
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        return
    child = subprocess.Popen(  # noqa: S603 - the command of this process
        [sys.executable, *sys.orig_argv[1:]],
        env={**os.environ, CHILD: "1"},
        stderr=subprocess.PIPE,
    )
    sent: list[int] = []

    def send(number: int, _: Any) -> None:
        sent.append(number)
        child.send_signal(number)

    signal.signal(signal.SIGTERM, send)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends it to the child, too
    last = _copy_stderr(child)
    code = child.wait()
    if code == -signal.SIGABRT and _FATAL in last:
        print(PEER_DIED, file=sys.stderr, flush=True)
        os._exit(ExitCode.RESUBMIT)
    os.write(2, last)
    if sent and code == -signal.SIGTERM:  # it had not begun
        os._exit(ExitCode.RESUBMIT)
    if code < 0:
        if code != -signal.SIGKILL:
            signal.signal(-code, signal.SIG_DFL)
        os.kill(os.getpid(), -code)
    os._exit(code)


def _copy_stderr(child: subprocess.Popen[bytes]) -> bytes:
    """Copy a child's stderr until it ends, except its last lines if they may be jax's report."""
    pipe, ended, held = cast(Any, child.stderr).fileno(), os.pidfd_open(child.pid), b""
    watched = [pipe, ended]
    while True:
        # After the fatal line the child ends; on a busy machine it may take long for its stack.
        limit = HOLD_S if held and _FATAL not in held else None
        ready = select.select(watched, [], [], limit)[0]
        data = os.read(pipe, 1 << 16) if pipe in ready else b""
        if pipe in ready and not data:
            watched.remove(pipe)  # closed by the child, which may still run
        held += data
        if ended in ready and not data:
            return held
        if not ready or not _REPORT.search(held):
            os.write(2, held)
            held = b""


def is_peer_failure(error: BaseException) -> bool:
    """Return True if an error or its cause is of a lost connection to another process."""
    cause: BaseException | None = error
    while cause is not None:
        # Ours may quote a path, a system error a server. jax's may also be a ValueError.
        if not isinstance(cause, InputError | OSError) and _LOST.search(str(cause)):
            return True
        cause = cause.__cause__ or cause.__context__
    return False
