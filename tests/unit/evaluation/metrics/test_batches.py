"""Batches of frames over devices."""

import subprocess
import sys

import numpy as np
import pytest

from egosim_jax.evaluation.metrics.batches import Batches


@pytest.mark.parametrize(("count", "most"), [(7, 3), (6, 3), (1, 5), (5, 1)])
def test_every_frame_is_in_a_batch_of_one_size(count, most):
    frames = np.arange(count, dtype=np.uint8)[:, None, None, None]
    batches = Batches(count, most)
    found = [np.asarray(batch).ravel() for batch in batches.of(frames)]
    assert len({len(batch) for batch in found}) == 1
    assert max(map(len, found)) <= most
    np.testing.assert_array_equal(batches.join(found), np.arange(count))


@pytest.mark.slow
def test_measures_are_the_same_on_many_devices():
    code = """
import jax, numpy as np
from flax import nnx
from egosim_jax.evaluation.metrics.image import ssim
from egosim_jax.evaluation.metrics.lpips import CONFIGS, Lpips, frame_distances
rng = np.random.default_rng(0)
a, b = rng.integers(0, 256, (2, 7, 40, 48, 3)).astype(np.uint8)
network = Lpips(CONFIGS["alex"], rngs=nnx.Rngs(0))
print(jax.local_device_count(), *ssim(a, b), *frame_distances(network, a, b))
"""
    found = []
    for devices in (1, 4):
        flags = f"--xla_force_host_platform_device_count={devices}"
        env = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
        run = subprocess.run(
            ["env", *(f"{k}={v}" for k, v in env.items()), sys.executable, "-c", code],
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        count, *values = map(float, run.stdout.split())
        assert count == devices
        found.append(values)
    # Sums of float32 in other orders.
    np.testing.assert_allclose(found[1], found[0], atol=1e-6)
