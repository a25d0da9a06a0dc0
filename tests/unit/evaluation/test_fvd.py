"""Fréchet distances of known Gaussians, and against scipy's matrix root."""

import numpy as np
import pytest
from scipy.linalg import sqrtm

from egosim_jax.evaluation.fvd import frechet_distance


def test_a_shift_costs_its_square():
    x = np.random.default_rng(0).normal(size=(9, 40))  # fewer clips than features
    assert frechet_distance(x, x) == pytest.approx(0, abs=1e-9)
    assert frechet_distance(x + 0.5, x) == pytest.approx(40 * 0.25)


def test_a_scale_costs_the_difference_of_deviations():
    x = np.random.default_rng(0).normal(size=(50, 3))
    variance = np.trace(np.cov(x, rowvar=False))
    centered = x - x.mean(axis=0)
    assert frechet_distance(3 * centered, centered) == pytest.approx(4 * variance)


def test_the_trace_is_that_of_the_matrix_root():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(60, 5)) @ rng.normal(size=(5, 5)), rng.normal(size=(40, 5)) + 1
    one, other = np.cov(a, rowvar=False), np.cov(b, rowvar=False)
    gap = np.square(a.mean(axis=0) - b.mean(axis=0)).sum()
    expected = gap + np.trace(one + other - 2 * np.real(sqrtm(one @ other)))
    assert frechet_distance(a, b) == pytest.approx(expected)


def test_a_single_clip_has_no_distance():
    assert np.isnan(frechet_distance(np.zeros((1, 3)), np.zeros((4, 3))))
