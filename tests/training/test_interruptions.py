"""Runs that are killed, stopped, hung, or resumed on other devices, as separate programs."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.data.loader import make_loader
from egosim_jax.data.shards import ShardReader
from egosim_jax.runtime.command import ExitCode
from tests.training.killing import logged, start_line
from tests.training.line import write_points

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
STEPS = 40
LONG = {"steps": STEPS, "save_every": 7, "validate_every": 10, "validates": True, "pause": 0.03}
"""A run of several seconds."""


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_points(tmp_path_factory.mktemp("points"))


def run(out: Path, data: Path, **settings) -> str:
    process = start_line(out, data, **settings)
    said = process.communicate(timeout=300)[1]
    assert process.returncode == ExitCode.DONE, said
    return said


def updates(out: Path) -> int:
    """Finished updates, by the log."""
    return max((int(line["step"]) for line in logged(out)), default=0)


def wait_for(out: Path, step: int, *processes: subprocess.Popen) -> None:
    deadline = time.monotonic() + 300
    while updates(out) < step:
        ended = [process.communicate()[1] for process in processes if process.poll() is not None]
        assert not ended, f"it ended too early: {ended}"
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture(scope="module")
def straight(points: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, float]]:
    out = tmp_path_factory.mktemp("straight") / "run"
    run(out, points, **LONG)
    return logged(out)


def stop(process: subprocess.Popen, out: Path) -> tuple[int, str]:
    """Send SIGTERM as Slurm does, to all processes; return finished updates, and what it said."""
    os.killpg(process.pid, signal.SIGTERM)
    before = updates(out)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == ExitCode.RESUBMIT, said
    return before, said


def test_sigterm_is_heard_at_the_next_update_and_the_rest_is_the_same(points, straight, tmp_path):
    """Before the first update, at it, after a save, and at a validation."""
    out = tmp_path / "run"
    process = start_line(out, points, new_group=True, **LONG)
    while not (out / "config.json").exists():  # then it reads a batch and compiles
        assert process.poll() is None
        time.sleep(0.001)
    _, said = stop(process, out)
    assert said.endswith("stopped; run the same command again\n")
    assert logged(out) == []
    for step, workers in ((1, 0), (7, 2), (10, 0)):
        process = start_line(out, points, new_group=True, **LONG, workers=workers)
        wait_for(out, step, process)
        before, said = stop(process, out)
        assert before <= updates(out) <= before + 1
        assert f"saved after step {updates(out)}" in said
    assert f"resuming at step {updates(out)} of" in run(out, points, **LONG)
    assert logged(out) == straight


@pytest.mark.parametrize("command", [["train", "debug"], ["data", "encode"]])
def test_sigterm_during_imports_ends_with_75(command):
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", "-m", "egosim_jax.cli", *command],
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    while "numpy" not in process.stderr.readline():
        pass
    process.send_signal(signal.SIGTERM)
    assert "run the same command again" in process.communicate(timeout=120)[1]
    assert process.returncode == ExitCode.RESUBMIT


def test_a_run_that_hangs_prints_its_stacks_and_ends_with_70(points, tmp_path):
    batches = make_loader(ShardReader(points), batch_size=8, seed=0)
    late = [next(batches)["record"] for _ in range(5)][-1]
    process = start_line(tmp_path / "run", points, hang=int(late[0]), hang_timeout_s=1.0)
    said = process.communicate(timeout=300)[1]
    assert process.returncode == ExitCode.HUNG, said
    assert "no update finished" in said
    assert "train/loop.py" in said


def test_a_run_resumes_on_other_numbers_of_devices(points, straight, tmp_path):
    """Relative, in float32: sums are taken in another order. The data is the same, in order."""
    out = tmp_path / "run"
    schedule = {"steps": STEPS, "save_every": 10, "pause": 0.06}
    meshes = [(8, {"fsdp": 8}), (8, {"data": 4, "fsdp": 2})]
    for count, (devices, mesh) in enumerate(meshes, start=1):
        process = start_line(out, points, devices=devices, mesh=mesh, **schedule)
        wait_for(out, 10 * count + 3, process)
        process.kill()
        process.communicate()
    assert "resuming at step 2" in run(out, points, **schedule)
    alone, moved = [line for line in straight if "loss" in line], logged(out)
    assert [line["ids"] for line in moved] == [line["ids"] for line in alone]
    losses = [[line["loss"] for line in log] for log in (moved, alone)]
    np.testing.assert_allclose(*losses, rtol=1e-5)


def test_sigterm_ends_the_making_of_clips_with_75(tmp_path):
    out = tmp_path / "run"
    command = [sys.executable, "-m", "egosim_jax.train", "tabletop", "--scenes", "400"]
    process = subprocess.Popen(
        [*command, "--out", str(out)], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    parts, deadline = out / "frames" / "train" / "parts", time.monotonic() + 300
    while len(list(parts.glob("*.record"))) < 2:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == ExitCode.RESUBMIT, said
    assert "run the same command again" in said
    assert len(list(parts.glob("*.record"))) < 400
