"""Start the processes of a run on machines without a scheduler.

    python -m egosim_jax.train.launch --processes 2 -- egosim train egosim_14b --out runs/egosim_14b

On several machines, run it on each, with the same --nodes and --coordinator and its --node-rank.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import IO, Annotated, Any

import tyro

from egosim_jax.runtime import command
from egosim_jax.runtime.command import ExitCode
from egosim_jax.types import InputError

END_S = 60.0
"""Time for which processes may save or notice a dead one before they are killed, in seconds."""
REJOIN_S = 60.0
"""Time before a restart on several machines, where old processes may still run, in seconds."""
POLL_S = 0.1


@dataclass(frozen=True, kw_only=True)
class Launch:
    """Start the processes of a run on this machine, as many times as they can be resumed."""

    program: Annotated[tuple[str, ...], tyro.conf.Positional] = ()
    """After `--`: the command of each process. One with --preflight runs once, without a run."""
    processes: int = 1
    """Number of processes on this machine, which share its GPUs evenly."""
    nodes: int = 1
    """Number of machines."""
    node_rank: int = 0
    """Number of this machine, from 0."""
    coordinator: str | None = None
    """An address of machine 0 with a free port, such as 10.0.0.1:1234; default: a local port."""
    restarts: int = 10
    """Maximum number of restarts after exit code 70 or 75, or a signal that ended a process."""

    def run(self) -> int:
        """Run the processes and return the exit code of the first that failed, or 0."""
        self._check()
        if any(option.partition("=")[0] == "--preflight" for option in self.program):
            return subprocess.call(self.program)  # noqa: S603 - the user's command
        running: list[subprocess.Popen[bytes]] = []
        stops: list[int] = []

        def stop(number: int, _: Any) -> None:
            stops.append(number)
            _end(running, signal.SIGTERM if len(stops) == 1 else signal.SIGKILL)

        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, stop)
        left = self.restarts
        while True:
            running.clear()
            running.extend(self._start())
            code = _wait(running)
            killed = code > 128 and code != ExitCode.INTERRUPTED  # whoever interrupts means it
            can_resume = killed or code in (ExitCode.HUNG, ExitCode.RESUBMIT)
            if stops or not can_resume or not left:
                return code
            print(f"a process ended with {code}; restarts left: {left}", file=sys.stderr)
            if self.nodes > 1:
                time.sleep(REJOIN_S)
            if stops:
                return code
            left -= 1

    def _check(self) -> None:
        if not self.program:
            raise InputError("No command: give it after --, as in `-- egosim train egosim_14b`.")
        if self.processes < 1 or self.restarts < 0 or not 0 <= self.node_rank < self.nodes:
            raise InputError(
                f"{self.processes} processes, {self.restarts} restarts, machine {self.node_rank} "
                f"of {self.nodes}: at least one process, no negative number, and a number of this "
                "machine below --nodes. (--processes, --restarts, --node-rank)"
            )
        if self.nodes > 1 and self.coordinator is None:
            raise InputError(f"{self.nodes} machines need an address of machine 0. (--coordinator)")

    def _start(self) -> Iterator[subprocess.Popen[bytes]]:
        """Start the processes of this machine."""
        from egosim_jax.train.distributed import NAMES, free_local_address

        address, count = self.coordinator or free_local_address(), self.nodes * self.processes
        shares = gpu_shares(self.processes)
        for index, share in enumerate(shares, start=self.node_rank * self.processes):
            joins = dict(zip(NAMES, (address, str(count), str(index)), strict=True))
            process = subprocess.Popen(  # noqa: S603 - the user's command
                self.program,
                env={"PYTHONUNBUFFERED": "1", **os.environ, **share, **joins},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches it as SIGTERM
            )
            threading.Thread(target=_copy, args=(index, process.stdout)).start()
            yield process


def gpu_shares(processes: int) -> Sequence[dict[str, str]]:
    """Return the variables that give each process its share of the visible GPUs, in order."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is None:
        count = sum(re.fullmatch(r"nvidia\d+", name) is not None for name in os.listdir("/dev"))
        visible = ",".join(map(str, range(count)))
    names = [name for name in visible.split(",") if name]
    if len(names) % processes:
        raise InputError(
            f"{len(names)} GPUs cannot be shared by {processes} processes: the processes must "
            "divide the GPUs. (--processes, CUDA_VISIBLE_DEVICES)"
        )
    each = len(names) // processes
    parts = [names[each * index : each * (index + 1)] for index in range(processes)]
    return [{"CUDA_VISIBLE_DEVICES": ",".join(part)} if part else {} for part in parts]


def _wait(running: Sequence[subprocess.Popen[bytes]]) -> int:
    """Wait for all processes; end the others once one fails. Return the code of the first."""
    first, limit = int(ExitCode.DONE), float("inf")
    while True:
        codes = [process.poll() for process in running]
        failed = [128 - code if code < 0 else code for code in codes if code]
        if failed and not first:
            first = min(failed, key=lambda code: code == ExitCode.RESUBMIT)  # the others' reason
            limit = time.monotonic() + END_S
            _end(running, signal.SIGTERM)
        if None not in codes or time.monotonic() > limit:
            break
        time.sleep(POLL_S)
    _end(running, signal.SIGKILL)
    for process in running:
        process.wait()
    return first


def _end(running: Sequence[subprocess.Popen[bytes]], number: int) -> None:
    """Send a signal to the processes that still run. SIGKILL also ends all that they started."""
    for process in running:
        with suppress(ProcessLookupError):
            if number == signal.SIGKILL:
                os.killpg(process.pid, number)
            else:
                process.send_signal(number)


def _copy(index: int, lines: IO[bytes]) -> None:
    """Print the lines of a process behind its number; close them if nobody reads them any more."""
    with lines, suppress(BrokenPipeError):
        for line in lines:
            sys.stdout.buffer.write(b"[%d] %s\n" % (index, line.rstrip(b"\n")))
            sys.stdout.buffer.flush()


def main(args: Sequence[str] | None = None) -> int:
    """Run `python -m egosim_jax.train.launch`."""
    return command.main(
        Launch,
        program="python -m egosim_jax.train.launch",
        description="Start the processes of a run on this machine.",
        args=args,
    )


if __name__ == "__main__":
    sys.exit(main())
