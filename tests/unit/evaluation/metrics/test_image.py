"""PSNR and SSIM against scikit-image, and the color fit against a known map."""

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from egosim_jax.evaluation.metrics.image import (
    clip_psnr,
    color_drift,
    fit_colors,
    psnr,
    ssim,
)


@pytest.fixture(scope="module")
def pair():
    """A smooth video and a noisy copy."""
    rng = np.random.default_rng(0)
    f, y, x = np.meshgrid(np.arange(4), np.arange(40), np.arange(52), indexing="ij")
    video = np.stack([4 * y + f, 3 * x, 2 * (x + y)], axis=-1)
    noisy = video + rng.normal(0, 12, video.shape)
    return video.astype(np.uint8), np.clip(noisy, 0, 255).astype(np.uint8)


def reference_ssim(a, b):
    return structural_similarity(
        a,
        b,
        channel_axis=-1,
        data_range=255,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )


def test_psnr_is_that_of_scikit_image(pair):
    expected = [peak_signal_noise_ratio(b, a, data_range=255) for a, b in zip(*pair, strict=True)]
    # Squares of whole numbers are exact; float32 division leaves 1e-7 relative.
    np.testing.assert_allclose(psnr(*pair), expected, rtol=1e-6)


def test_ssim_is_that_of_scikit_image(pair):
    expected = [reference_ssim(a, b) for a, b in zip(*pair, strict=True)]
    # float32 moments of centerd values, against scikit-image's float64.
    np.testing.assert_allclose(ssim(*pair), expected, atol=1e-6)


def test_ssim_stays_exact_near_white():
    rng = np.random.default_rng(0)
    a, b = (rng.integers(252, 256, (1, 40, 52, 3)).astype(np.uint8) for _ in range(2))
    np.testing.assert_allclose(ssim(a, b), [reference_ssim(a[0], b[0])], atol=1e-6)


def test_the_color_fit_undoes_an_affine_change(pair):
    video = pair[0]
    matrix = np.array([[0.6, 0.1, 0.0], [0.1, 0.5, 0.1], [0.0, 0.1, 0.6]])
    changed = np.clip(np.rint(video @ matrix + 20), 0, 255).astype(np.uint8)
    # Both videos are rounded to whole levels, and the inverse matrix magnifies that.
    assert np.abs(fit_colors(changed, video).astype(int) - video).max() <= 3


def test_the_color_fit_is_least_squares(pair):
    video, reference = pair[1], pair[0]
    colors = np.concatenate([video.reshape(-1, 3), np.ones((video.size // 3, 1))], axis=1)
    solution = np.linalg.lstsq(colors, reference.reshape(-1, 3).astype(float))[0]
    expected = np.clip(np.rint(colors @ solution), 0, 255).reshape(video.shape)
    difference = np.abs(fit_colors(video, reference) - expected)
    # float32 sums may round a level the other way, rarely.
    assert difference.max() <= 1
    assert (difference > 0).mean() < 1e-3


def test_the_color_fit_of_a_black_video_is_the_mean_color(pair):
    reference = pair[0]
    fitted = fit_colors(np.zeros_like(reference), reference)
    mean = reference.reshape(-1, 3).mean(axis=0)
    assert np.abs(fitted - mean).max() <= 0.51


def test_the_psnr_of_a_clip_is_that_of_one_error_over_all_frames(pair):
    video, reference = pair
    video = np.concatenate([video, reference])  # half of the frames are equal
    reference = np.concatenate([reference, reference])
    expected = peak_signal_noise_ratio(reference, video, data_range=255)
    assert clip_psnr(psnr(video, reference)) == pytest.approx(expected, abs=1e-5)


def test_color_drift_is_the_difference_of_mean_colors(pair):
    video = np.full((2, 16, 16, 3), 100, np.uint8)
    drifted = video.copy()
    drifted[1, :, :8, 0] += 10
    np.testing.assert_allclose(color_drift(drifted, video), [[0, 0, 0], [5, 0, 0]])
