"""Killing `run_tiny` and starting it again."""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from egosim_jax.train.distributed import own_address
from tests.flags import QUICK

ROOT = Path(__file__).parents[2]


def logged(out: Path) -> list[dict[str, float]]:
    """The log of a run, without what is told by a clock; a line that is cut off is not one yet."""
    path = out / "metrics.jsonl"
    told = ("seconds", "waiting", "tflops", "mfu", "gigabytes", "minutes_left")
    text = path.read_text("utf-8") if path.exists() else ""
    return [
        {name: value for name, value in json.loads(line).items() if name not in told}
        for line in text.splitlines(keepends=True)
        if line.endswith("\n")
    ]


class Run:
    """The processes of a run of `run_tiny`, one after the other."""

    def __init__(self, data: Path, out: Path, *, steps: int, save_every: int, processes: int = 1):
        self.out, self.processes = out, processes
        self._left: set[tuple[str, int]] = set()
        program = [sys.executable, "-m", "tests.training.run_tiny"]
        self.command = [*program, str(data), str(out), str(steps), str(save_every)]

    def start(self) -> list[subprocess.Popen]:
        """Start it, or let it go on."""
        address = own_address()
        started, self._left = [], self._half_written()
        for index in range(self.processes):
            environment = os.environ | {"XLA_FLAGS": QUICK}
            if self.processes > 1:
                environment |= {
                    "JAX_COORDINATOR_ADDRESS": address,
                    "JAX_NUM_PROCESSES": str(self.processes),
                    "JAX_PROCESS_ID": str(index),
                }
            with (self.out.parent / f"{self.out.name}_{index}.log").open("a") as log:
                started.append(
                    subprocess.Popen(
                        self.command, cwd=ROOT, env=environment, stdout=log, stderr=log
                    )
                )
        return started

    def finish(self) -> None:
        """Let it run to its end."""
        codes = [process.wait(timeout=900) for process in self.start()]
        assert codes == [0] * self.processes, self.said()

    def kill_when(self, ready: Callable[[], bool]) -> bool:
        """Start it and kill all processes as soon as `ready`; whether it was before its end."""
        started = self.start()
        deadline = time.monotonic() + 900
        while not ready() and all(process.poll() is None for process in started):
            assert time.monotonic() < deadline, self.said()
            time.sleep(0.002)
        killed = all(process.poll() is None for process in started)
        for process in started:
            process.kill()
            process.wait()
        return killed

    def lines(self) -> list[dict[str, float]]:
        """The log (`logged`)."""
        return logged(self.out)

    def is_saving(self) -> bool:
        """Whether the processes that run now, or ran last, have a checkpoint half written."""
        return bool(self._half_written() - self._left)

    def _half_written(self) -> set[tuple[str, int]]:
        """Names and inodes: what an earlier kill left goes away only after the next start."""
        found = set()
        for path in (self.out / "checkpoints").glob("*tmp*"):
            with contextlib.suppress(FileNotFoundError):
                found.add((path.name, path.stat().st_ino))
        return found

    def said(self) -> str:
        """What the first process printed last."""
        return (self.out.parent / f"{self.out.name}_0.log").read_text("utf-8")[-3000:]
