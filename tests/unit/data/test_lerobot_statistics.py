"""Statistics of LeRobot datasets, against a direct computation."""

import numpy as np
import pytest

from egosim_jax.data.lerobot_writer import (
    QUANTILES,
    aggregate,
    image_statistics,
    levels,
    vector_statistics,
)

NAMES = {"min", "max", "mean", "std", "count", *QUANTILES}


@pytest.mark.parametrize("count", [1, 2, 17, 500])
def test_vectors_have_the_quantiles_of_numpy(count):
    values = np.random.default_rng(0).normal(size=(count, 3))
    found = aggregate([vector_statistics(values)])
    assert found.keys() == NAMES
    assert found["count"] == [count]
    for name, share in QUANTILES.items():
        np.testing.assert_allclose(found[name], np.quantile(values, share, axis=0))
    np.testing.assert_allclose(found["std"], values.std(axis=0), atol=1e-12)


def test_episodes_are_weighted_by_their_frames():
    rng = np.random.default_rng(0)
    parts = [rng.normal(size=(n, 2)) + n for n in (5, 20)]
    found, whole = aggregate([vector_statistics(part) for part in parts]), np.concatenate(parts)
    assert found["count"] == [25]
    for name, value in (("mean", whole.mean(0)), ("std", whole.std(0)), ("max", whole.max(0))):
        np.testing.assert_allclose(found[name], value)
    medians = [np.median(part, axis=0) for part in parts]
    np.testing.assert_allclose(found["q50"], np.average(medians, axis=0, weights=[5, 20]))


def test_a_missing_hand_does_not_hide_the_others():
    values = np.arange(12.0).reshape(6, 2)
    values[:3, 0] = np.nan
    empty = np.full((4, 2), np.nan)
    found = aggregate([vector_statistics(values), vector_statistics(empty)])
    np.testing.assert_allclose(found["q50"], [8, 6])
    np.testing.assert_allclose(found["mean"], [8, 6])
    assert np.isnan(aggregate([vector_statistics(empty)])["q01"]).all()


@pytest.mark.parametrize(
    ("frames", "size", "sampled"), [(1, (4, 6), 1), (50, (4, 6), 50), (1000, (2, 3), 177)]
)
def test_images_are_sampled_as_lerobot_does(frames, size, sampled):
    images = np.random.default_rng(0).integers(0, 256, (frames, *size, 3)).astype(np.uint8)
    found = image_statistics([levels(image) for image in images])
    assert found["count"] == [sampled]
    chosen = images[np.round(np.linspace(0, frames - 1, sampled)).astype(int)] / 255
    for name, share in QUANTILES.items():
        assert found[name].shape == (3, 1, 1)
        exact = np.quantile(chosen, share, axis=(0, 1, 2), method="inverted_cdf")
        np.testing.assert_allclose(found[name].ravel(), exact)
    np.testing.assert_allclose(found["mean"].ravel(), chosen.mean(axis=(0, 1, 2)))
    np.testing.assert_allclose(found["std"].ravel(), chosen.std(axis=(0, 1, 2)))
    np.testing.assert_allclose(found["min"].ravel(), chosen.min(axis=(0, 1, 2)))
    np.testing.assert_allclose(found["max"].ravel(), chosen.max(axis=(0, 1, 2)))


def test_large_images_are_sampled_at_every_few_pixels():
    image = np.random.default_rng(0).integers(0, 256, (200, 600, 3)).astype(np.uint8)
    counted = levels(image)
    assert counted.sum() == 3 * 50 * 150
    np.testing.assert_array_equal(
        counted[1], np.bincount(image[::4, ::4, 1].ravel(), minlength=256)
    )
