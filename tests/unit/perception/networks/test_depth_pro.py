"""Depth Pro in its worker, versus the formulas of its paper and of transformers."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from egosim_jax.perception.networks.depth_pro import DepthPro, focal_of
from egosim_jax.perception.networks.worker import close_workers
from egosim_jax.types import InputError
from tests.scenes import pinhole
from tests.unit.perception.networks import tiny
from tests.unit.perception.posed import UNKNOWN_CAMERAS

pytestmark = pytest.mark.slow
HEIGHT, WIDTH = 40, 60
FRAMES = np.random.default_rng(0).integers(0, 256, (2, HEIGHT, WIDTH, 3)).astype(np.uint8)
STILL = np.zeros(FRAMES.shape[:3], bool)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    yield tiny.depth_pro(tmp_path_factory.mktemp("depth_pro"))
    close_workers()


@pytest.fixture(scope="module")
def expected(folder):
    """Return inverse depth for a focal length of one width, and fields of view in degrees."""
    import transformers as hf

    network = hf.DepthProForDepthEstimation.from_pretrained(folder).eval()
    x = torch.from_numpy(FRAMES).permute(0, 3, 1, 2) / 127.5 - 1
    x = torch.nn.functional.interpolate(x, (32, 32), mode="bilinear")
    with torch.inference_mode():
        output = network(pixel_values=x)
    maps = torch.nn.functional.interpolate(
        output.predicted_depth[:, None], (HEIGHT, WIDTH), mode="bilinear"
    )
    return maps[:, 0].numpy(), output.field_of_view.numpy()


def check_depth(depth_m, inverse):
    """Compare in 1/m, the network's output, because far depths amplify rounding errors."""
    inverse = np.clip(inverse, 1e-4, 1e4)
    np.testing.assert_allclose(1 / depth_m, inverse, rtol=1e-3, atol=1e-4 * inverse.max())


def test_depth_and_focal_length_follow_the_field_of_view(folder, expected):
    inverse, fields = expected
    network = DepthPro(folder)
    focal = 0.5 * WIDTH / np.tan(0.5 * np.radians(np.median(fields)))
    found = network(FRAMES, STILL, UNKNOWN_CAMERAS, [0, 1])
    assert found.metric
    assert np.ptp(inverse) > 1e-3
    check_depth(found.depth_m, inverse * WIDTH / focal)
    assert network.focal_px(FRAMES) == pytest.approx(focal, rel=1e-4)


def test_a_known_focal_length_replaces_the_estimated_one(folder, expected):
    given = replace(UNKNOWN_CAMERAS, cameras=pinhole(2, 90.0, HEIGHT, WIDTH))
    found = DepthPro(folder)(FRAMES, STILL, given, [1])
    check_depth(found.depth_m, expected[0][1:] * WIDTH / 90)


@pytest.mark.parametrize("degrees", [-3.0, 5.0, 170.0, np.nan])
def test_an_implausible_field_of_view_is_refused(degrees):
    with pytest.raises(InputError, match=r"field of view is .*--focal"):
        focal_of(np.array([degrees]), 60)
