import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.diffusion import RectifiedFlow
from egosim_jax.types import InputError


def test_the_default_levels_are_those_of_the_egosim_release():
    sigmas = RectifiedFlow().times(50)
    first = [1, 0.99593, 0.99174, 0.98739, 0.98291, 0.97826]
    last = [0.40541, 0.35714, 0.30303, 0.24194, 0.17241, 0.09259, 0]
    # The published levels have five decimals.
    np.testing.assert_allclose(sigmas[:6], first, atol=5.1e-6, rtol=0)
    np.testing.assert_allclose(sigmas[-7:], last, atol=5.1e-6, rtol=0)


def test_bfloat16_timesteps_are_those_of_the_egosim_release():
    process = RectifiedFlow(timestep_rounding="bfloat16")
    timesteps = process.timesteps(process.times(50))
    assert timesteps[:10].tolist() == [1000, 996, 992, 988, 984, 980, 972, 968, 964, 956]
    assert timesteps[-7:].tolist() == [406, 358, 304, 242, 172, 92.5, 0]


@pytest.mark.parametrize("rounding", ["none", "bfloat16"])
def test_a_compiled_program_rounds_timesteps_as_numpy_does(rounding):
    process = RectifiedFlow(timestep_rounding=rounding)
    sigmas = np.linspace(0, 1, 1001, dtype=np.float32)
    compiled = jax.jit(process.timesteps)(jnp.asarray(sigmas))
    np.testing.assert_array_equal(compiled, process.timesteps(sigmas))


def test_unrounded_timesteps_are_a_thousand_sigma():
    process = RectifiedFlow()
    np.testing.assert_array_equal(process.timesteps(np.array([1.0, 0.25])), [1000, 250])


def test_every_level_follows_the_formula_of_shift_and_range():
    steps, shift, low, high = 7, 3.0, 0.1, 0.9
    expected = []
    for i in range(steps):
        w = high - (high - low) * i / steps
        expected.append(shift * w / (1 + (shift - 1) * w))
    sigmas = RectifiedFlow(shift=shift, sigma_min=low, sigma_max=high).times(steps)
    # Two float64 formulas for the same numbers.
    np.testing.assert_allclose(sigmas, [*expected, 0], rtol=1e-14)


@pytest.mark.parametrize(
    ("fields", "rule"),
    [
        ({"shift": 0.0}, "above 0"),
        ({"sigma_min": 0.5, "sigma_max": 0.5}, "sigma_min < sigma_max"),
        ({"sigma_max": 1.5}, "sigma_max <= 1"),
    ],
)
def test_an_impossible_process_is_refused(fields, rule):
    with pytest.raises(InputError, match=rule):
        RectifiedFlow(**fields)


def test_no_steps_are_refused():
    with pytest.raises(InputError, match="at least 1"):
        RectifiedFlow().times(0)
