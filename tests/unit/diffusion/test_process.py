import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.diffusion import RectifiedFlow, VariancePreserving
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


def test_every_level_follows_the_formula_of_shift_and_range():
    steps, shift, low, high = 7, 3.0, 0.1, 0.9
    expected = []
    for i in range(steps):
        w = high - (high - low) * i / steps
        expected.append(shift * w / (1 + (shift - 1) * w))
    sigmas = RectifiedFlow(shift=shift, sigma_min=low, sigma_max=high).times(steps)
    # Two float64 formulas for the same numbers.
    np.testing.assert_allclose(sigmas, [*expected, 0], rtol=1e-14)


EVERY = [
    RectifiedFlow(),
    RectifiedFlow(prediction="x0"),
    RectifiedFlow(prediction="epsilon", sigma_max=0.999),
    VariancePreserving(),
    VariancePreserving(prediction="x0", snr_shift=3.0),
    VariancePreserving(prediction="epsilon", zero_terminal_snr=False, beta_schedule="linear"),
]


@pytest.mark.parametrize("process", EVERY)
def test_data_noise_and_velocity_come_back_from_a_perfect_prediction(process):
    x0, noise = np.random.default_rng(0).standard_normal((2, 5, 7))
    time = np.array([0.001, 0.2, 0.5, 0.8, 0.997])[:, None]
    scales = process.alpha(time), process.sigma(time)
    x, output = process.add_noise(x0, noise, time), process.target(x0, noise, time)
    # float64, divided by an alpha or sigma of 0.001 or more.
    np.testing.assert_allclose(process.to_x0(x, output, *scales), x0, atol=1e-10)
    np.testing.assert_allclose(process.to_epsilon(x, output, *scales), noise, atol=1e-10)
    np.testing.assert_allclose(process.to_velocity(x, output, *scales), noise - x0, atol=1e-10)


@pytest.mark.parametrize("process", EVERY)
def test_a_compiled_process_equals_numpy(process):
    time = process.times(25)[:-1].astype(np.float32)
    for function in (process.alpha, process.sigma, process.timesteps, process.warp):
        np.testing.assert_allclose(jax.jit(function)(time), function(time), rtol=1e-6)


@pytest.mark.parametrize("snr_shift", [1.0, 3.0])
def test_the_last_timestep_of_cogvideox_is_pure_noise_and_the_variance_one(snr_shift):
    process = VariancePreserving(snr_shift=snr_shift)
    times = np.linspace(0, 1, 1001)
    alpha, sigma = process.alpha(times), process.sigma(times)
    assert (alpha[0], alpha[-1], sigma[0], sigma[-1]) == (1, 0, 0, 1)
    assert (np.diff(alpha) < 0).all()
    np.testing.assert_allclose(alpha**2 + sigma**2, 1, rtol=1e-14)


@pytest.mark.parametrize("schedule", ["linear", "scaled_linear"])
@pytest.mark.parametrize("snr_shift", [1.0, 3.0])
def test_the_scales_are_those_of_betas_multiplied_one_by_one(schedule, snr_shift):
    fields = {"beta_schedule": schedule, "snr_shift": snr_shift}
    process, terminal = (
        VariancePreserving(zero_terminal_snr=zero, **fields) for zero in (False, True)
    )
    kept, roots = 1.0, []
    for n in range(1000):
        share = n / 999
        if schedule == "linear":
            beta = 0.00085 + share * (0.012 - 0.00085)
        else:
            beta = (0.00085**0.5 + share * (0.012**0.5 - 0.00085**0.5)) ** 2
        kept *= 1 - beta
        snr = kept / (1 - kept) / snr_shift
        roots.append((snr / (1 + snr)) ** 0.5)
    times = np.arange(1, 1001) / 1000
    np.testing.assert_allclose(process.alpha(times), roots, rtol=1e-10)
    first, last = roots[0], roots[-1]
    expected = [(root - last) * first / (first - last) for root in roots]
    np.testing.assert_allclose(terminal.alpha(times), expected, atol=1e-10)


def test_the_levels_of_wans_unipc_start_below_pure_noise():
    process = RectifiedFlow.wan_unipc(3.0)
    assert process.times(1)[0] == pytest.approx(3 * 0.999 / (1 + 2 * 0.999), rel=1e-12)
    assert process.timesteps(process.times(1))[0] == 999


def test_trailing_timesteps_start_at_the_last_and_leading_ones_end_at_the_first():
    trailing, leading = VariancePreserving(), VariancePreserving(spacing="leading")
    assert trailing.timesteps(trailing.times(4)[:-1]).tolist() == [999, 749, 499, 249]
    assert leading.timesteps(leading.times(4)[:-1]).tolist() == [750, 500, 250, 0]


def test_training_draws_every_timestep_alike():
    process = VariancePreserving(train_timesteps=10)
    u = np.linspace(0, 1, 1001)[:-1]
    assert np.bincount(process.timesteps(process.warp(u)).astype(int)).tolist() == [100] * 10
    assert process.timesteps(process.warp(np.array([1.0]))).tolist() == [9]


def test_given_timesteps_are_what_the_network_is_given():
    steps = [1000, 750, 500, 250]
    process = RectifiedFlow(shift=5.0, timestep_rounding="down")
    assert process.timesteps(process.times(steps)).tolist() == [*steps, 0]
    process = VariancePreserving()
    for steps in ((999, 749, 499, 249), (998, 0), range(999, -1, -1)):
        assert process.timesteps(process.times(steps))[:-1].tolist() == [*steps]
    assert process.timesteps(process.times(1000))[:-1].tolist() == [*range(999, -1, -1)]


@pytest.mark.parametrize(
    ("process", "steps", "rule"),
    [
        (RectifiedFlow(), [], "must fall"),
        (RectifiedFlow(), [500, 500], "must fall"),
        (RectifiedFlow(), [1001, 500], "at most 1000"),
        (RectifiedFlow(), [500, 0], "above 0"),
        (RectifiedFlow(sigma_max=0.999, prediction="epsilon"), (1000, 500), "needs signal"),
        (VariancePreserving(), [1000, 500], "at most 999"),
        (VariancePreserving(), [500, -1], "above -1"),
        (VariancePreserving(), [998.5, 500], "integers"),
        (VariancePreserving(), 1001, "more than the 1000"),
        (VariancePreserving(), 0, "at least 1"),
    ],
)
def test_impossible_steps_are_refused(process, steps, rule):
    with pytest.raises(InputError, match=rule):
        process.times(steps)


@pytest.mark.parametrize("process", EVERY)
@pytest.mark.parametrize("kind", [np.int64, np.int8, np.uint16, np.array], ids=lambda k: k.__name__)
def test_a_number_of_steps_may_have_any_integer_type(process, kind):
    np.testing.assert_array_equal(process.times(kind(10)), process.times(10))
    with pytest.raises(InputError, match="at least 1"):
        process.times(kind(0))


@pytest.mark.parametrize(
    ("kind", "fields", "rule"),
    [
        (RectifiedFlow, {"shift": 0.0}, "above 0"),
        (RectifiedFlow, {"sigma_min": 0.5, "sigma_max": 0.5}, "sigma_min < sigma_max"),
        (RectifiedFlow, {"sigma_max": 1.5}, "sigma_max <= 1"),
        (RectifiedFlow, {"prediction": "v"}, "must be one of velocity"),
        (RectifiedFlow, {"prediction": "epsilon"}, "sigma_max"),
        (VariancePreserving, {"beta_start": 0.5, "beta_end": 0.1}, "beta_start <= beta_end"),
        (VariancePreserving, {"snr_shift": 0.0}, "snr_shift must be above 0"),
        (VariancePreserving, {"train_timesteps": 0}, "train_timesteps must be above 0"),
        (VariancePreserving, {"prediction": "epsilon"}, "zero_terminal_snr must be False"),
        (VariancePreserving, {"prediction": "velocity"}, "must be one of v, epsilon, x0"),
    ],
)
def test_an_impossible_process_is_refused(kind, fields, rule):
    with pytest.raises(InputError, match=rule):
        kind(**fields)
