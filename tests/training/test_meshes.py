"""Updates on meshes of devices, compared with updates on one device."""

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from egosim_jax.testing import write_latents
from tests.flags import devices
from tests.training.killing import logged
from tests.training.run_tiny import TASKS

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]
MESHES = [(1, 4, 2, 2), (2, 2, 2, 1)]
"""Sizes of data, fsdp and context, and number of gradient accumulation steps."""


def run(
    mesh: tuple[int, int, int, int], out: Path, task: str = "egosim"
) -> tuple[dict[str, np.ndarray], str]:
    """Return the numbers of a mesh, and the output of the compiler."""
    command = [sys.executable, "-m", "tests.training.run_mesh", *map(str, mesh), str(out), task]
    environment = os.environ | devices(math.prod(mesh[:3]))
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return dict(np.load(out)), done.stderr


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    return run((1, 1, 1, 1), tmp_path_factory.mktemp("mesh") / "alone.npz")[0]


def test_dwm_trains_on_a_mesh_as_on_one_device(tmp_path):
    """Batch, weights and tokens are sharded; the sums are taken in another order."""
    alone, _ = run((1, 1, 1, 1), tmp_path / "alone.npz", "dwm")
    shared, _ = run((1, 4, 2, 1), tmp_path / "shared.npz", "dwm")
    np.testing.assert_allclose(shared["loss"], alone["loss"], rtol=1e-6)
    np.testing.assert_allclose(shared["curve"], alone["curve"], rtol=1e-5)


def test_self_forcing_trains_on_a_mesh_as_on_one_device(tmp_path):
    """Two devices share a clip: its chunks, their cached keys and values, and the critic's clip."""
    data = tmp_path / "data"
    write_latents(data, TASKS["student_dmd"].model)
    losses = []
    for count, context in ((1, 1), (4, 2)):
        out = tmp_path / str(count)
        command = [sys.executable, "-m", "tests.training.run_tiny", str(data), str(out), "3", "100"]
        done = subprocess.run(
            [*command, "student_dmd", str(context)],
            cwd=ROOT,
            env=os.environ | devices(count),
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        losses.append([[line["loss"], line["critic_loss"]] for line in logged(out)])
    assert np.shape(losses) == (2, 3, 2)
    np.testing.assert_allclose(losses[1], losses[0], rtol=1e-6)


@pytest.mark.parametrize("mesh", MESHES, ids=str)
def test_loss_gradients_and_losses_of_20_updates_are_those_of_one_device(alone, mesh, tmp_path):
    """In float32: sums are taken in another order."""
    shared, said = run(mesh, tmp_path / "shared.npz")
    assert "full rematerialization" not in said
    np.testing.assert_allclose(shared["loss"], alone["loss"], rtol=1e-6)
    np.testing.assert_allclose(shared["curve"], alone["curve"], rtol=1e-5)
    leaves = alone.keys() - {"loss", "curve"}
    assert len(leaves) > 40
    square = {name: np.square(alone[name], dtype=float).sum() for name in leaves}
    apart = {name: np.square(shared[name].astype(float) - alone[name]).sum() for name in leaves}
    assert np.sqrt(sum(apart.values()) / sum(square.values())) <= 1e-6
    worst = max(leaves, key=lambda name: apart[name] / square[name])
    assert np.sqrt(apart[worst] / square[worst]) <= 1e-5, worst
