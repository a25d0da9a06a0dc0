"""Sinusoids of the diffusion time, against other formulas."""

import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.models.sinusoid import float32_sinusoid, time_sinusoid

TIMES = [0.0, 1.0, 19.0, 333.0, 761.5, 980.0, 999.0]


def in_float32(times, dim):
    """Return cosines and sines of angles; every step of the angles is rounded to float32."""
    rows = []
    for time in times:
        angles = []
        for place in range(dim // 2):
            exponent = np.float32(np.float32(-np.log(10000.0)) * np.float32(place))
            frequency = np.float32(np.exp(np.float64(np.float32(exponent / np.float32(dim // 2)))))
            angles.append(np.float32(np.float32(time) * frequency))
        angles = np.array(angles, np.float64)
        rows.append(np.concatenate([np.cos(angles), np.sin(angles)]))
    return np.array(rows)


@pytest.mark.parametrize("dim", [64, 256, 3072])
def test_float32_angles_are_rounded_as_in_diffusers(dim):
    found = np.asarray(float32_sinusoid(jnp.asarray(TIMES), dim))
    # A frequency may be rounded up or down, then the angle: two units of 6.1e-5 near 999.
    np.testing.assert_allclose(found, in_float32(TIMES, dim), atol=1.3e-4)
    assert np.mean(np.abs(found - in_float32(TIMES, dim))) < 2e-6


def test_exact_angles_differ_from_float32_ones():
    exact = np.asarray(time_sinusoid(jnp.asarray([999.0]), 3072))
    frequency = 10000.0 ** (-np.arange(1536) / 1536)
    true = np.concatenate([np.cos(999 * frequency), np.sin(999 * frequency)])
    np.testing.assert_allclose(exact[0], true, atol=3e-7)
    rounded = np.asarray(float32_sinusoid(jnp.asarray([999.0]), 3072))[0]
    assert 1e-5 < np.abs(rounded - true).max() < 1e-4
