"""A known shift between videos is found, and undoing it raises the PSNR."""

import numpy as np
import pytest

from egosim_jax.evaluation.metrics.alignment import align
from egosim_jax.types import InputError


@pytest.fixture(scope="module")
def video():
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (3, 12, 16, 3))
    return coarse.repeat(4, axis=1).repeat(4, axis=2).astype(np.uint8)


def test_a_known_shift_is_found(video):
    shifted = np.roll(video, (2, -3), axis=(1, 2))  # 2 rows down, 3 columns to the left
    found = align(shifted, video, most_px=4)
    assert found.shift_px == (-3, 2)
    assert found.psnr_aligned > 90
    assert found.gain == pytest.approx(found.psnr_aligned - found.psnr_inside)
    squared = np.square(shifted.astype(float) - video).mean(axis=(1, 2, 3))
    assert found.psnr_full == pytest.approx(np.mean(10 * np.log10(255**2 / squared)), abs=1e-4)


def test_videos_of_other_shapes_are_refused(video):
    with pytest.raises(InputError, match="must be uint8"):
        align(video[:2], video)
    with pytest.raises(InputError, match="--most-px"):
        align(video, video, most_px=24)
