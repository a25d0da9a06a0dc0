"""The time sinusoid against float64."""

import math

import jax
import numpy as np
import pytest

from egosim_jax.models.sinusoid import time_sinusoid

ROUNDING = 3e-7
"""Three float32 roundings of numbers up to 1, where naive float32 angles err by 3e-5."""


@pytest.mark.parametrize("time", [0, 0.25, 92.6, 499.5, 500, 871.23, 999.97, 1000])
def test_time_sinusoid_is_exact_to_float32_rounding(time):
    t = np.float32(time)
    have = np.asarray(jax.jit(time_sinusoid, static_argnums=1)(t[None], 256))[0]
    angles = [float(t) * 10000 ** (-i / 128) for i in range(128)]
    want = [math.cos(a) for a in angles] + [math.sin(a) for a in angles]
    np.testing.assert_allclose(have, want, rtol=0, atol=ROUNDING)
