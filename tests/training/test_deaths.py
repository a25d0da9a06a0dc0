"""One of two processes dies or is stopped: the other ends, and the run resumes bit for bit.

    KILLS=10 pytest -m slow -s tests/training/test_deaths.py

kills ten times and prints how long the other took to end.
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from egosim_jax.io.atomic import lock_folder
from egosim_jax.runtime.command import ExitCode
from egosim_jax.train.peers import PEER_DIED
from tests.training.killing import Run, start_pair
from tests.training.line import write_points

pytestmark = pytest.mark.slow
KILLS, PROCESSES, BOUND_S = int(os.environ.get("KILLS", "2")), 2, 60
STEPS = 20 * (KILLS + 1)


class LineRun(Run):
    """A run of `tests.training.line` in several processes."""

    def __init__(self, data: Path, out: Path, *, pause: float = 0.01):
        super().__init__(data, out, steps=STEPS, save_every=5, processes=PROCESSES)
        program = [sys.executable, "-m", "tests.training.line", str(out), str(data)]
        settings = {"steps": STEPS, "save_every": 5, "pause": pause}
        settings |= {"validate_every": 10, "validates": True}
        self.command = [*program, json.dumps(settings)]

    def updates(self) -> int:
        """Return the number of finished updates, by the log."""
        return max((int(line["step"]) for line in self.lines()), default=0)

    def wait(self, processes: list[subprocess.Popen], ready: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 600
        while not ready():
            assert all(process.poll() is None for process in processes), self.output()
            assert time.monotonic() < deadline, self.output()
            time.sleep(0.002)


def child_of(process: subprocess.Popen) -> int:
    """Return the process that trains, whose parent only waits."""
    tasks = Path(f"/proc/{process.pid}/task").glob("*/children")
    (child,) = {int(pid) for path in tasks for pid in path.read_text().split()}
    return child


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_points(tmp_path_factory.mktemp("points"))


@pytest.fixture(scope="module")
def whole(data: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, float]]:
    """The log of a run that nothing interrupts."""
    run = LineRun(data, tmp_path_factory.mktemp("whole") / "run")
    run.finish()
    assert [line["step"] for line in run.lines() if "loss" in line] == [*range(1, STEPS + 1)]
    return run.lines()


def test_a_run_survives_random_deaths(data, whole, tmp_path):
    rng = random.Random(0)
    killed = LineRun(data, tmp_path / "killed")
    for number in range(KILLS):
        processes = killed.start()
        phase = ("updates", "save", "start")[number % 3]
        environment = killed.out / "environment.json"
        before = environment.stat().st_mtime_ns if environment.exists() else 0
        lines = len(killed.lines())
        more = rng.randint(3, 12)
        killed.wait(
            processes,
            lambda: environment.exists() and environment.stat().st_mtime_ns > before,  # noqa: B023
        )
        if phase == "start":
            time.sleep(rng.uniform(0, 2))
        else:
            killed.wait(processes, lambda: len(killed.lines()) > lines + more)  # noqa: B023
        if phase == "save":
            killed.wait(processes, killed.is_saving)
        victim, whom = number % PROCESSES, ("process", "child")[number // 2 % 2]
        pid = child_of(processes[victim]) if whom == "child" else processes[victim].pid
        os.kill(pid, signal.SIGKILL)
        began = time.monotonic()
        code = processes[1 - victim].wait(timeout=BOUND_S)
        seconds = time.monotonic() - began
        processes[victim].wait(timeout=BOUND_S)
        print(f"kill {number + 1} in {phase}: {whom} {victim}, the other after {seconds:.1f} s")
        assert code == ExitCode.RESUBMIT, killed.output()
        text = (tmp_path / f"killed_{1 - victim}.log").read_text()
        assert text.rstrip().endswith(PEER_DIED)
        assert "Check failure stack trace" not in text
    killed.finish()
    assert killed.lines() == whole


def test_two_processes_stop_together_and_resume_bit_for_bit(data, whole, tmp_path):
    stopped = LineRun(data, tmp_path / "stopped", pause=0.06)
    for step, receiver in ((9, 1), (16, 0)):  # after a save, and after a resume and a save
        processes = stopped.start()
        stopped.wait(processes, lambda: stopped.updates() >= step)  # noqa: B023
        processes[receiver].send_signal(signal.SIGTERM)
        before = stopped.updates()
        codes = [process.wait(timeout=BOUND_S) for process in processes]
        assert codes == [ExitCode.RESUBMIT, ExitCode.RESUBMIT], stopped.output()
        assert before <= stopped.updates() <= before + 2  # the signal is passed on first
    stopped.finish()
    assert stopped.lines() == whole


def run_two(out: Path, *given: tuple[Path, dict]) -> tuple[list[int], list[str]]:
    """Run two processes, each with its data and settings; return their exit codes and stderr."""
    processes = start_pair(out, *given)
    said = [process.communicate(timeout=300)[1] for process in processes]
    return [process.returncode for process in processes], said


@pytest.mark.parametrize("failing", [0, 1])
def test_the_error_of_one_process_ends_the_other(data, tmp_path, failing):
    given = [(data, {})] * 2
    given[failing] = tmp_path / "missing", {}
    codes, said = run_two(tmp_path / "run", *given)
    assert codes[failing] == ExitCode.USAGE
    assert "missing" in said[failing]
    assert codes[1 - failing] == ExitCode.RESUBMIT
    assert said[1 - failing].rstrip().endswith(PEER_DIED)
    assert "Traceback" not in "".join(said)


def test_an_error_of_all_processes_is_printed_by_each(tmp_path):
    missing = tmp_path / "missing", {}
    codes, said = run_two(tmp_path / "run", missing, missing)
    assert codes == [ExitCode.USAGE, ExitCode.USAGE]
    assert all("missing" in text and PEER_DIED not in text for text in said)


def test_processes_with_different_options_are_refused(data, tmp_path):
    codes, said = run_two(tmp_path / "run", (data, {"seed": 1}), (data, {"seed": 2}))
    assert codes == [ExitCode.RESUBMIT, ExitCode.USAGE]
    assert "training.seed: the folder has 1, this run has 2" in said[1]


def test_all_processes_refuse_a_folder_that_another_run_uses(data, tmp_path):
    with lock_folder(tmp_path / "run"):
        codes, said = run_two(tmp_path / "run", (data, {}), (data, {}))
    assert codes == [ExitCode.USAGE, ExitCode.USAGE]
    assert all(f"in use by another process (PID {os.getpid()})" in text for text in said)
