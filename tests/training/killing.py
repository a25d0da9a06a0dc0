"""Killing `run_tiny` and starting it again."""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from egosim_jax.train.distributed import free_local_address
from tests import flags

ROOT = Path(__file__).parents[2]


def logged(out: Path) -> list[dict[str, float]]:
    """Return the log of a run without timings; an incomplete last line is omitted."""
    path = out / "metrics.jsonl"
    timings = ("step_time_s", "data_wait_frac", "tflops", "mfu", "peak_mem_gb", "eta_min")
    text = path.read_text("utf-8") if path.exists() else ""
    return [
        {name: value for name, value in json.loads(line).items() if name not in timings}
        for line in text.splitlines(keepends=True)
        if line.endswith("\n")
    ]


def start_line(
    out: Path,
    data: Path,
    *,
    devices: int = 1,
    env: dict[str, str] | None = None,
    new_group: bool = False,
    **changes,
) -> subprocess.Popen:
    """Start `tests.training.line` with `TrainConfig` fields; its stderr is a pipe."""
    command = [sys.executable, "-m", "tests.training.line", str(out), str(data)]
    return subprocess.Popen(
        [*command, json.dumps(changes)],
        cwd=ROOT,
        env=os.environ | flags.devices(devices) | (env or {}),
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=new_group,
    )


def start_pair(out: Path, *given: tuple[Path, dict]) -> list[subprocess.Popen]:
    """Start the two processes of a run, each with its data and settings (`start_line`)."""
    shared = {"JAX_COORDINATOR_ADDRESS": free_local_address(), "JAX_NUM_PROCESSES": "2"}
    return [
        start_line(out, data, env={**shared, "JAX_PROCESS_ID": str(index)}, **settings)
        for index, (data, settings) in enumerate(given)
    ]


class Run:
    """The processes of a run of `run_tiny`, one after the other."""

    def __init__(
        self,
        data: Path,
        out: Path,
        *,
        steps: int,
        save_every: int,
        processes: int = 1,
        task: str = "egosim",
    ):
        self.out, self.processes = out, processes
        self._left: set[tuple[str, int]] = set()
        program = [sys.executable, "-m", "tests.training.run_tiny"]
        self.command = [*program, str(data), str(out), str(steps), str(save_every), task]

    def start(self) -> list[subprocess.Popen]:
        """Start or resume it."""
        address = free_local_address()
        started, self._left = [], self._incomplete()
        for index in range(self.processes):
            environment = os.environ | {"XLA_FLAGS": flags.QUICK}
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
        """Run to the end."""
        codes = [process.wait(timeout=900) for process in self.start()]
        assert codes == [0] * self.processes, self.output()

    def kill_when(self, ready: Callable[[], bool]) -> bool:
        """Kill all processes as soon as `ready`; return whether they were still running."""
        started = self.start()
        deadline = time.monotonic() + 900
        while not ready() and all(process.poll() is None for process in started):
            assert time.monotonic() < deadline, self.output()
            time.sleep(0.002)
        killed = all(process.poll() is None for process in started)
        for process in started:
            process.kill()
            process.wait()
        return killed

    def lines(self) -> list[dict[str, float]]:
        """Return the log (`logged`)."""
        return logged(self.out)

    def is_saving(self) -> bool:
        """Return True if the current or last processes have an incomplete checkpoint."""
        return bool(self._incomplete() - self._left)

    def _incomplete(self) -> set[tuple[str, int]]:
        """Return names and inodes; files of an earlier kill disappear after the next start."""
        found = set()
        for path in (self.out / "checkpoints").glob("*tmp*"):
            with contextlib.suppress(FileNotFoundError):
                found.add((path.name, path.stat().st_ino))
        return found

    def output(self) -> str:
        """Return the end of the first process's output."""
        return (self.out.parent / f"{self.out.name}_0.log").read_text("utf-8")[-3000:]
