"""Pixel ranges, and the CLIP image against torch's resize and against plain loops."""

import math

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


def kernel(d):
    """Keys' cubic with a = -3/4."""
    d = abs(d)
    if d <= 1:
        return 1.25 * d**3 - 2.25 * d**2 + 1
    if d < 2:
        return -0.75 * d**3 + 3.75 * d**2 - 6 * d + 3
    return 0.0


def resized(image, size, row, column, channel):
    """One pixel of a bicubic resize."""
    height, width, _ = image.shape
    y, x = (row + 0.5) * height / size - 0.5, (column + 0.5) * width / size - 0.5
    total = 0.0
    for i in range(math.floor(y) - 1, math.floor(y) + 3):
        for j in range(math.floor(x) - 1, math.floor(x) + 3):
            cell = image[min(max(i, 0), height - 1), min(max(j, 0), width - 1), channel]
            total += kernel(y - i) * kernel(x - j) * float(cell)
    return total


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


def test_pixels_equal_the_kernel_summed_by_hand():
    frames = image(24, 40)
    actual = clip_pixels(frames, image_size=14, image_range="unit")
    for row, column, channel in np.ndindex(14, 14, 3):
        value = resized(frames[1] / 255, 14, row, column, channel)
        expected = (value * 0.5 + 0.5 - MEAN[channel]) / STD[channel]
        assert actual[1, row, column, channel] == pytest.approx(expected, abs=TOLERANCE)


@pytest.mark.parametrize(
    ("image_range", "black", "white"), [("unit", 0.5, 1.0), ("signed", 0.0, 1.0)]
)
def test_the_range_decides_what_black_looks_like(image_range, black, white):
    for level, seen in ((0, black), (255, white)):
        frames = np.full((1, 32, 32, 3), level, np.uint8)
        actual = clip_pixels(frames, image_size=14, image_range=image_range)
        for channel in range(3):
            expected = (seen - MEAN[channel]) / STD[channel]
            np.testing.assert_allclose(actual[..., channel], expected, atol=TOLERANCE)


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
