"""Depth errors against hand-computed values."""

import numpy as np
import pytest

from egosim_jax.evaluation.metrics.depth import coverage, depth_error


def test_depth_error_is_the_mean_relative_difference_in_percent():
    truth = np.array([[[1.0, 2.0, 4.0, np.inf]]], np.float32)
    found = np.array([[[1.1, 1.0, np.inf, 3.0]]], np.float32)
    counted = np.ones_like(truth, bool)
    assert depth_error(found, truth, counted) == pytest.approx((10 + 50) / 2, rel=1e-6)
    counted[0, 0, 1] = False
    assert depth_error(found, truth, counted) == pytest.approx(10, rel=1e-6)
    assert np.isnan(depth_error(found, truth, np.zeros_like(counted)))


def test_coverage_is_the_share_that_is_known():
    found = np.array([[[1.0, np.inf, np.inf, 2.0]]], np.float32)
    assert coverage(found, np.ones_like(found, bool)) == 50
    assert np.isnan(coverage(found, np.zeros_like(found, bool)))
