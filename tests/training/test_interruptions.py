"""Runs that are killed, stopped, hung, or resumed on other devices, as separate programs."""

import json
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
from egosim_jax.train.distributed import free_local_address
from tests import flags
from tests.training.killing import logged
from tests.training.line import write_points

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
LONG = {"steps": 100, "save_every": 30, "pause": 0.03}
"""A run of several seconds: jax checks for SIGTERM once a second."""


@pytest.fixture(scope="module")
def points(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_points(tmp_path_factory.mktemp("points"))


def start(out: Path, data: Path, *, devices: int = 1, env: dict[str, str] | None = None, **changes):
    command = [sys.executable, "-m", "tests.training.line", str(out), str(data)]
    return subprocess.Popen(
        [*command, json.dumps(changes)],
        cwd=ROOT,
        env=os.environ | flags.devices(devices) | (env or {}),
        stderr=subprocess.PIPE,
        text=True,
    )


def run(out: Path, data: Path, **settings) -> str:
    process = start(out, data, **settings)
    said = process.communicate(timeout=300)[1]
    assert process.returncode == ExitCode.DONE, said
    return said


def wait_for(out: Path, step: int, *processes: subprocess.Popen) -> None:
    deadline = time.monotonic() + 300
    while not (out / "metrics.jsonl").is_file() or len(logged(out)) < step:
        ended = [process.communicate()[1] for process in processes if process.poll() is not None]
        assert not ended, f"it ended too early: {ended}"
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture(scope="module")
def straight(points: Path, tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, float]]:
    out = tmp_path_factory.mktemp("straight") / "run"
    run(out, points, **LONG)
    return logged(out)


def test_sigterm_saves_the_step_and_ends_with_75_and_the_rest_is_the_same(
    points, straight, tmp_path
):
    out = tmp_path / "run"
    process = start(out, points, **LONG)
    wait_for(out, 9, process)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == ExitCode.RESUBMIT, said
    done = len(logged(out))
    assert f"saved after step {done}" in said
    assert done < LONG["steps"]
    assert f"resuming at step {done} of" in run(out, points, **LONG)
    assert logged(out) == straight


def test_a_run_that_hangs_prints_its_stacks_and_ends_with_70(points, tmp_path):
    batches = make_loader(ShardReader(points), batch_size=8, seed=0)
    late = [next(batches)["record"] for _ in range(5)][-1]
    process = start(tmp_path / "run", points, hang=int(late[0]), hang_timeout_s=1.0)
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
        process = start(out, points, devices=devices, mesh=mesh, **schedule)
        wait_for(out, 10 * count + 3, process)
        process.kill()
        process.communicate()
    assert "resuming at step 2" in run(out, points, **schedule)
    alone, moved = logged(tmp_path / "one"), logged(out)
    assert [line["ids"] for line in moved] == [line["ids"] for line in alone]
    losses = [[line["loss"] for line in log] for log in (moved, alone)]
    np.testing.assert_allclose(*losses, rtol=1e-5)


def pair(out: Path, data: Path, **settings) -> list[subprocess.Popen]:
    """Two processes of one run."""
    shared = {"JAX_COORDINATOR_ADDRESS": free_local_address(), "JAX_NUM_PROCESSES": "2"}
    return [
        start(out, data, env={**shared, "JAX_PROCESS_ID": str(index)}, **settings)
        for index in range(2)
    ]


def finish(processes: list[subprocess.Popen]) -> list[int]:
    said = [process.communicate(timeout=300)[1] for process in processes]
    codes = [process.returncode for process in processes]
    assert set(codes) <= {ExitCode.DONE, ExitCode.RESUBMIT}, said
    return codes


def test_two_processes_stop_together_and_resume_bit_for_bit(points, tmp_path):
    schedule = LONG | {"pause": 0.06}
    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    assert finish(pair(whole, points, **schedule)) == [ExitCode.DONE, ExitCode.DONE]
    processes = pair(stopped, points, **schedule)
    wait_for(stopped, 9, *processes)
    processes[1].send_signal(signal.SIGTERM)
    assert finish(processes) == [ExitCode.RESUBMIT, ExitCode.RESUBMIT]
    processes = pair(stopped, points, **schedule)
    wait_for(stopped, len(logged(stopped)) + 9, *processes)
    for process in processes:
        process.kill()
        process.communicate()
    assert finish(pair(stopped, points, **schedule)) == [ExitCode.DONE, ExitCode.DONE]
    assert logged(stopped) == logged(whole)
    assert [line["step"] for line in logged(whole)] == list(range(1, schedule["steps"] + 1))


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
    process = start(tmp_path / "run", points, env=given)
    assert said in process.communicate(timeout=120)[1]
    assert process.returncode == 2


def test_sigterm_ends_the_making_of_clips_with_75(tmp_path):
    out = tmp_path / "run"
    command = [sys.executable, "-m", "egosim_jax.train", "tabletop", "--scenes", "400"]
    process = subprocess.Popen(
        [*command, "--out", str(out)], cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    parts, deadline = out / "frames" / "train" / "parts", time.monotonic() + 120
    while len(list(parts.glob("*.record"))) < 2:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=120)[1]
    assert process.returncode == ExitCode.RESUBMIT, said
    assert "run the same command again" in said
    assert len(list(parts.glob("*.record"))) < 400
