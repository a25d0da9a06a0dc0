"""A clip does not depend on the devices that made it."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.flags import devices

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, np.ndarray]:
    """Everything that `run_generator` computes, in one program that imports jax once."""
    folder = tmp_path_factory.mktemp("meshes")
    command = [sys.executable, "-m", "tests.unit.generation.run_generator", str(folder)]
    environment = os.environ | devices(8)
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "full rematerialization" not in done.stderr
    return dict(np.load(folder / "found.npz"))


def test_clips_of_a_mesh_are_those_of_one_device(found):
    """In float32: sums are taken in another order."""
    for mesh in ("(4, 2, 1)", "(1, 1, 8)"):
        frames = found[f"{mesh} frames"].astype(int)
        for name in ("latents", "reused", "int8", "progressive"):
            latents = found[f"{mesh} {name}"]
            alone = found[f"None {name}"][: len(latents)]
            assert np.linalg.norm(latents - alone) / np.linalg.norm(alone) <= 1e-5
        assert np.abs(frames - found["None frames"][: len(frames)]).max() <= 1


def test_a_batch_that_the_mesh_does_not_divide_is_refused(found):
    assert "A batch of 6 cannot be shared by a mesh of data 4 x fsdp 2" in str(found["refusal"])


def test_kernels_and_scales_in_8_bits_are_split_over_the_same_axis(found):
    assert np.linalg.norm(found["None int8"] - found["None latents"]) > 0
    for name, whole in {"kernel": (2, 96, 64), "scale": (2, 64)}.items():
        assert tuple(found[f"None shard of {name}"]) == whole
        for mesh, parts in {"(4, 2, 1)": 2, "(1, 1, 8)": 8}.items():
            shard = (*whole[:-1], whole[-1] // parts)
            assert tuple(found[f"{mesh} shard of {name}"]) == shard
