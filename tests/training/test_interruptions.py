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
from tests.training.killing import logged, start_line, start_pair
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


@pytest.mark.parametrize("workers", [0, 2])
def test_sigterm_is_heard_at_the_next_update_and_the_rest_is_the_same(
    points, straight, tmp_path, workers
):
    """At first, after a save, at a validation, and as Slurm: to all processes."""
    out, settings = tmp_path / "run", LONG | {"workers": workers}
    for step in (1, 7, 10) if not workers else (9,):
        process = start_line(out, points, new_group=True, **settings)
        wait_for(out, step, process)
        os.killpg(process.pid, signal.SIGTERM)
        before = updates(out)
        said = process.communicate(timeout=120)[1]
        assert process.returncode == ExitCode.RESUBMIT, said
        assert before <= updates(out) <= before + 1
        assert f"saved after step {updates(out)}" in said
    assert f"resuming at step {updates(out)} of" in run(out, points, **settings)
    assert logged(out) == straight


def test_sigterm_before_the_first_update_ends_with_75_and_leaves_nothing(
    points, straight, tmp_path
):
    out = tmp_path / "run"
    process = start_line(out, points, **LONG)
    while not (out / "config.json").exists():  # then it reads a batch and compiles
        assert process.poll() is None
        time.sleep(0.001)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == ExitCode.RESUBMIT, said
    assert said.endswith("stopped; run the same command again\n")
    assert logged(out) == []
    run(out, points, **LONG)
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


def test_a_run_resumes_on_other_numbers_of_devices(points, tmp_path):
    """Relative, in float32: sums are taken in another order. The data is the same, in order."""
    run(tmp_path / "one", points, steps=40)
    out = tmp_path / "run"
    schedule = {"steps": 40, "save_every": 10, "pause": 0.06}
    meshes = [(8, {"fsdp": 8}), (8, {"data": 4, "fsdp": 2})]
    for count, (devices, mesh) in enumerate(meshes, start=1):
        process = start_line(out, points, devices=devices, mesh=mesh, **schedule)
        wait_for(out, 10 * count + 3, process)
        process.kill()
        process.communicate()
    assert "resuming at step 2" in run(out, points, **schedule)
    alone, moved = logged(tmp_path / "one"), logged(out)
    assert [line["ids"] for line in moved] == [line["ids"] for line in alone]
    losses = [[line["loss"] for line in log] for log in (moved, alone)]
    np.testing.assert_allclose(*losses, rtol=1e-5)


def finish(processes: list[subprocess.Popen]) -> list[int]:
    said = [process.communicate(timeout=300)[1] for process in processes]
    codes = [process.returncode for process in processes]
    assert set(codes) <= {ExitCode.DONE, ExitCode.RESUBMIT}, said
    return codes


def test_two_processes_stop_together_and_resume_bit_for_bit(points, tmp_path):
    both = [(points, LONG | {"pause": 0.06})] * 2
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert finish(start_pair(whole, *both)) == [ExitCode.DONE, ExitCode.DONE]
    for step, receiver in ((9, 1), (16, 0)):  # after a save, and after a resume and a save
        processes = start_pair(stopped, *both)
        wait_for(stopped, step, *processes)
        processes[receiver].send_signal(signal.SIGTERM)
        before = updates(stopped)
        assert finish(processes) == [ExitCode.RESUBMIT, ExitCode.RESUBMIT]
        assert before <= updates(stopped) <= before + 2  # the signal is passed on first
    processes = start_pair(stopped, *both)
    wait_for(stopped, updates(stopped) + 9, *processes)
    for process in processes:
        process.kill()
        process.communicate()
    assert finish(start_pair(stopped, *both)) == [ExitCode.DONE, ExitCode.DONE]
    assert logged(stopped) == logged(whole)
    steps = [line["step"] for line in logged(whole) if "loss" in line]
    assert steps == list(range(1, STEPS + 1))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"JAX_NUM_PROCESSES": "2"}, "JAX_COORDINATOR_ADDRESS, JAX_PROCESS_ID is not"),
        (
            {
                "JAX_COORDINATOR_ADDRESS": "127.0.0.1:1",
                "JAX_NUM_PROCESSES": "2",
                "JAX_PROCESS_ID": "2",
            },
            "JAX_PROCESS_ID=2",
        ),
    ],
)
def test_an_incomplete_or_invalid_process_environment_is_refused(points, tmp_path, given, said):
    process = start_line(tmp_path / "run", points, env=given)
    assert said in process.communicate(timeout=120)[1]
    assert process.returncode == 2


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
