"""Interrupted runs continue as if nothing had happened."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest
from flax import nnx

from egosim_jax.train.script import train
from egosim_jax.types import InputError
from tests.training.run_tiny import TASK, training, write_latents

ROOT = Path(__file__).parents[2]
STEPS = 14
KILL_AFTER = 6


def losses(out: Path) -> dict[int, float]:
    lines = (out / "metrics.jsonl").read_text("utf-8").splitlines()
    return {line["step"]: line["loss"] for line in map(json.loads, lines)}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("latents")
    write_latents(folder)
    return folder


@pytest.fixture(scope="module")
def uninterrupted(data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, nnx.Module]:
    out = tmp_path_factory.mktemp("run") / "whole"
    return out, train(TASK, training(STEPS), data=data, validation=None, out=out)


def test_a_killed_run_repeats_the_losses_bit_for_bit(data, uninterrupted, tmp_path):
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "tests.training.run_tiny", str(data), str(out), str(STEPS)]
    process = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL)
    metrics = out / "metrics.jsonl"
    deadline = time.monotonic() + 300
    while not (metrics.is_file() and len(metrics.read_text("utf-8").splitlines()) >= KILL_AFTER):
        assert process.poll() is None, "the run ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()

    resumed = train(TASK, training(STEPS), data=data, validation=None, out=out)

    whole, networks = uninterrupted
    assert losses(out) == losses(whole)
    assert list(losses(out)) == list(range(1, STEPS + 1))
    for ours, theirs in zip(
        jax.tree.leaves(nnx.state(resumed)), jax.tree.leaves(nnx.state(networks)), strict=True
    ):
        np.testing.assert_array_equal(np.asarray(ours), np.asarray(theirs))


def test_two_devices_give_the_losses_of_one(data, uninterrupted, tmp_path):
    """Relative, in float32: gradients are summed in another order, and every step feeds on it."""
    out = tmp_path / "sharded"
    command = [sys.executable, "-m", "tests.training.run_tiny", str(data), str(out), str(STEPS)]
    environment = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=2"}
    subprocess.run(command, check=True, cwd=ROOT, env=environment, stderr=subprocess.DEVNULL)
    whole, sharded = losses(uninterrupted[0]), losses(out)
    assert list(sharded) == list(whole)
    np.testing.assert_allclose(list(sharded.values()), list(whole.values()), rtol=1e-4)


def test_a_finished_run_trains_no_further(data, uninterrupted):
    out, _ = uninterrupted
    before = losses(out)
    train(TASK, training(STEPS), data=data, validation=None, out=out)
    assert losses(out) == before


def test_a_run_of_another_config_is_refused_with_what_differs(data, uninterrupted):
    out, _ = uninterrupted
    with pytest.raises(InputError, match=r"training\.seed: the folder has 0, this run has 1"):
        train(TASK, training(STEPS, seed=1), data=data, validation=None, out=out)
