"""Pixel ranges, and the CLIP image against torch's resize and against plain loops."""

import jax.numpy as jnp
import numpy as np
import pytest
import torch

from egosim_jax.conditioning import clip_pixels, to_model, to_uint8

LEVELS = np.arange(256, dtype=np.uint8)

# float32 sums of 16 products of numbers below 1, divided by a deviation near 1/4.
TOLERANCE = 5e-6
MEAN = (0.48145466, 0.4578275, 0.40821073)
STD = (0.26862954, 0.26130258, 0.27577711)
SIZES = [((48, 80), 28), ((480, 832), 224), ((16, 16), 28)]


def image(height, width):
    return np.random.default_rng(1).integers(0, 256, (2, height, width, 3), np.uint8)


@pytest.mark.parametrize(("shape", "size"), SIZES)
@pytest.mark.parametrize("image_range", ["unit", "signed"])
def test_pixels_equal_torchs_bicubic_resize(shape, size, image_range):
    frames = image(*shape)
    x = torch.from_numpy(frames).permute(0, 3, 1, 2).double() / 255
    if image_range == "signed":
        x = 2 * x - 1
    x = torch.nn.functional.interpolate(
        x, size=(size, size), mode="bicubic", align_corners=False, antialias=False
    )
    mean, std = (torch.tensor(v, dtype=torch.float64).view(1, 3, 1, 1) for v in (MEAN, STD))
    expected = ((x * 0.5 + 0.5 - mean) / std).permute(0, 2, 3, 1).numpy()
    actual = clip_pixels(frames, image_size=size, image_range=image_range)
    assert actual.dtype == np.float32
    np.testing.assert_allclose(actual, expected, atol=TOLERANCE, rtol=0)


@pytest.mark.parametrize("asarray", [np.asarray, jnp.asarray])
def test_levels_map_to_minus_one_to_one(asarray):
    x = to_model(asarray(LEVELS))
    assert x.dtype == np.float32
    assert (x[0], x[255]) == (-1, 1)
    for level in range(256):
        # Two roundings of float32 near 1.
        assert float(x[level]) == pytest.approx(level / 255 * 2 - 1, abs=2.5e-7)


@pytest.mark.parametrize("asarray", [np.asarray, jnp.asarray])
def test_values_are_truncated_not_rounded(asarray):
    # The middle of each step, where rounding would go up.
    middles = (LEVELS[:-1] + 0.75) / 255 * 2 - 1
    levels = to_uint8(asarray(middles.astype(np.float32)))
    assert levels.dtype == np.uint8
    np.testing.assert_array_equal(levels, LEVELS[:-1])


@pytest.mark.parametrize("asarray", [np.asarray, jnp.asarray])
def test_values_out_of_range_are_clipped(asarray):
    values = asarray(np.array([-3.0, -1.0, 1.0, 1.5], np.float32))
    assert to_uint8(values).tolist() == [0, 0, 255, 255]
