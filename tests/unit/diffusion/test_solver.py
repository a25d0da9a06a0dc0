"""Solvers on equations with known solutions; `tests/parity` compares them with diffusers."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.diffusion import (
    DDIM,
    SOLVERS,
    DPMSolver,
    Euler,
    RectifiedFlow,
    Renoise,
    UniPC,
    VariancePreserving,
    integrate,
)
from egosim_jax.diffusion.solver import integrate_keeping, integrate_visiting
from egosim_jax.types import InputError

PROCESS = RectifiedFlow(shift=2.0)
DETERMINISTIC = [Euler(), UniPC(order=1), UniPC(order=2), UniPC(order=3), DDIM(), DPMSolver()]
STOCHASTIC = [DDIM(eta=1.0), DPMSolver(stochastic=True)]


def test_solvers_have_the_names_of_other_programs():
    assert {name: SOLVERS.parse(name) for name in SOLVERS.built_in} == {
        "euler": Euler(),
        "unipc": UniPC(),
        "wan": UniPC(),
        "ddim": DDIM(),
        "renoise": Renoise(),
        "dpmpp_2m": DPMSolver(),
        "dpmpp_2m_sde": DPMSolver(stochastic=True),
    }
    assert SOLVERS.parse("unipc --order 3") == UniPC(order=3)


@pytest.fixture(scope="module")
def noise():
    return jax.random.normal(jax.random.key(0), (2, 3, 2, 2, 16))


def per_sample(t):
    return t[:, None, None, None, None]


def gaussian_velocity(x, t, std=0.5):
    """Velocity when the data are N(0, std^2)."""
    sigma = per_sample(t) / 1000
    return x * (sigma - (1 - sigma) * std**2) / ((1 - sigma) ** 2 * std**2 + sigma**2)


def spread(sigma, std=0.5):
    """Standard deviation of noisy Gaussian data, to which solutions are proportional."""
    return ((1 - sigma) ** 2 * std**2 + sigma**2) ** 0.5


def end_error(solver, x, steps):
    """Relative error between levels 0.9 and 0.1, even in log SNR so that no step is a large one."""
    sigmas = 1 / (1 + np.exp(np.linspace(np.log(1 / 9), np.log(9), steps + 1)))
    t = jnp.asarray(1000 * sigmas[:-1], jnp.float32)

    def body(state, row):
        velocity = gaussian_velocity(state.x, jnp.broadcast_to(row[0], x.shape[:1]))
        return solver.step(PROCESS, state, velocity, row[1]), None

    state, _ = jax.lax.scan(body, solver.start(x), (t, solver.coefficients(PROCESS, sigmas)))
    expected = x * (spread(sigmas[-1]) / spread(sigmas[0]))
    return float(jnp.linalg.norm(state.x - expected) / jnp.linalg.norm(expected))


@pytest.mark.parametrize("steps", [1, 5])
@pytest.mark.parametrize("solver", DETERMINISTIC)
def test_a_straight_path_ends_at_the_data(noise, solver, steps):
    data = jnp.roll(noise, 1)
    x = integrate(
        # The velocity at x that leads straight to the data.
        lambda x, t: (x - data) / (per_sample(t) / 1000),
        noise,
        process=PROCESS,
        solver=solver,
        steps=steps,
    )
    # Rounding of a few float32 operations on numbers of size 1; and UniPC starts 1e-6 off noise.
    np.testing.assert_allclose(x, data, atol=1e-5)


@pytest.mark.parametrize(
    ("solver", "order"),
    [(Euler(), 1), (UniPC(order=2), 2), (DDIM(), 1), (DPMSolver(), 2)],
)
def test_half_the_step_divides_the_error_by_two_to_the_order(noise, solver, order):
    ratio = end_error(solver, noise, 16) / end_error(solver, noise, 32)
    # The steps are not yet infinitely small: within a quarter of an order.
    assert np.log2(ratio) == pytest.approx(order, abs=0.25)


@pytest.mark.parametrize("solver", DETERMINISTIC)
def test_the_velocity_is_traced_once_for_all_steps(noise, solver):
    calls = []

    def velocity(x, t):
        calls.append(t.shape)
        return x

    jax.eval_shape(
        lambda x: integrate(velocity, x, process=PROCESS, solver=solver, steps=20), noise
    )
    assert calls == [(2,)]


@pytest.mark.parametrize("solver", DETERMINISTIC)
def test_latents_stay_float32_when_the_network_computes_in_bfloat16(noise, solver):
    seen = []

    def velocity(x, t):
        seen.append(x.dtype)
        return x.astype(jnp.bfloat16)

    x = jax.eval_shape(
        lambda x: integrate(velocity, x, process=PROCESS, solver=solver, steps=2),
        noise.astype(jnp.bfloat16),
    )
    assert {x.dtype, *seen} == {jnp.dtype("float32")}


def test_the_network_is_given_the_rounded_timesteps(noise):
    process = RectifiedFlow(timestep_rounding="bfloat16")
    # The timesteps add up in the latents: x_N = sum_i (sigma_{i+1} - sigma_i) t_i.
    x = integrate(
        lambda x, t: jnp.broadcast_to(per_sample(t), x.shape),
        jnp.zeros_like(noise),
        process=process,
        solver=Euler(),
        steps=4,
    )
    sigmas = [5 * u / (1 + 4 * u) for u in (1, 0.75, 0.5, 0.25)] + [0]
    given = [1000, 936, 832, 624]  # 1000, 937.5, 833.33, 625 in steps of 4
    expected = sum((sigmas[i + 1] - sigmas[i]) * given[i] for i in range(4))
    np.testing.assert_allclose(x, np.full(x.shape, expected), rtol=1e-6)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_coefficients_are_finite_from_pure_noise_to_data(order):
    process = RectifiedFlow()
    for column in UniPC(order=order).coefficients(process, process.times(50)):
        assert column.dtype == np.float32
        assert np.isfinite(column).all()


@pytest.mark.parametrize("process", [PROCESS, VariancePreserving(snr_shift=3.0)])
def test_a_step_from_true_data_and_noise_ends_at_the_scales_of_its_end(process):
    times = process.times(8)
    alpha, sigma = process.alpha(times), process.sigma(times)
    for eta in (0.0, 0.5, 1.0):
        row = DDIM(eta=eta).coefficients(process, times)
        np.testing.assert_allclose(row.data, alpha[1:], rtol=1e-12)
        np.testing.assert_allclose(row.epsilon**2 + row.noise**2, sigma[1:] ** 2, atol=1e-12)
        # The ancestral sampler draws from the posterior of the data and the latents.
        ratio = alpha[:-1] * sigma[1:] / (sigma[:-1] * alpha[1:])
        expected = eta * sigma[1:] * np.sqrt(1 - ratio**2)
        np.testing.assert_allclose(row.noise, expected, atol=1e-12)
    for stochastic in (False, True):
        row = DPMSolver(stochastic=stochastic).coefficients(process, times)
        total = row.keep * alpha[:-1] + row.data + row.before
        np.testing.assert_allclose(total, alpha[1:], atol=1e-12)
        left = (row.keep * sigma[:-1]) ** 2 + row.noise**2
        np.testing.assert_allclose(left, sigma[1:] ** 2, atol=1e-12)
        assert bool(row.noise[:-1].all()) == stochastic


def test_only_the_first_steps_are_taken(noise):
    x = integrate(
        lambda x, t: jnp.ones_like(x), noise, process=PROCESS, solver=Euler(), steps=4, count=2
    )
    np.testing.assert_allclose(x, noise + PROCESS.times(4)[2] - 1, atol=1e-6)


@pytest.mark.parametrize("keys", [None, jax.random.split(jax.random.key(1), 2)])
def test_what_a_network_also_returns_is_kept_from_the_last_step(noise, keys):
    solver = DDIM(eta=0.0 if keys is None else 1.0)
    given = {"process": PROCESS, "solver": solver, "steps": 4, "keys": keys}
    also = lambda x, t: (gaussian_velocity(x, t), (x, t))  # noqa: E731
    x, (before, t) = integrate_keeping(also, noise, **given)
    other, (also_before, _), visited = integrate_visiting(also, noise, **given)
    np.testing.assert_allclose(x, integrate(gaussian_velocity, noise, **given), atol=1e-6)
    np.testing.assert_allclose(other, x, atol=1e-6)
    timesteps = PROCESS.timesteps(PROCESS.times(4)[:-1])
    np.testing.assert_allclose(t, np.repeat(timesteps[-1], 2), rtol=1e-6)
    np.testing.assert_allclose(visited.timesteps, timesteps, rtol=1e-6)
    np.testing.assert_allclose(visited.latents[-1], before, atol=1e-6)
    np.testing.assert_allclose(also_before, before, atol=1e-6)
    for latents, output, time in zip(visited.latents, visited.outputs, timesteps, strict=True):
        expected = gaussian_velocity(latents, jnp.full(2, time))
        np.testing.assert_allclose(output, expected, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("solver", STOCHASTIC)
@pytest.mark.parametrize("process", [PROCESS, VariancePreserving(snr_shift=3.0)])
def test_stochastic_solvers_end_with_the_deviation_of_the_data(process, solver):
    std = 0.5

    def denoise(x, t):
        """The expected data, noise and from them the prediction when the data are N(0, std^2)."""
        time = per_sample(t + (process is not PROCESS)) / 1000
        alpha, sigma = process.alpha(time), process.sigma(time)
        gain = 1 / (alpha**2 * std**2 + sigma**2)
        return process.target(gain * alpha * std**2 * x, gain * sigma * x, time)

    noise = jax.random.normal(jax.random.key(0), (4, 4, 16, 16, 16))
    keys = jax.random.split(jax.random.key(1), 4)
    x = integrate(denoise, noise, process=process, solver=solver, steps=1000, keys=keys)
    # 5 standard errors of the deviation of 65536 samples are 0.007; the rest is discretization.
    assert float(jnp.std(x)) == pytest.approx(std, abs=0.015)
    # It forgets its starting noise, which a deterministic solver only rescales.
    assert abs(np.corrcoef(np.ravel(x), np.ravel(noise))[0, 1]) < 0.1


@pytest.mark.parametrize("solver", STOCHASTIC)
def test_a_sample_of_a_stochastic_solver_does_not_depend_on_its_batch(noise, solver):
    keys = jax.random.split(jax.random.key(1), 2)
    sample = lambda x, keys: integrate(  # noqa: E731
        gaussian_velocity, x, process=PROCESS, solver=solver, steps=5, keys=keys
    )
    together, alone = sample(noise, keys), sample(noise[1:], keys[1:])
    np.testing.assert_allclose(together[1:], alone, rtol=1e-6, atol=1e-6)
    assert not np.allclose(sample(noise, keys[::-1]), together)


@pytest.mark.parametrize("solver", DETERMINISTIC)
def test_given_timesteps_are_visited(noise, solver):
    seen = []

    def velocity(x, t):
        jax.debug.callback(lambda t: seen.append(float(t[0])), t, ordered=True)
        return x

    steps = (1000, 750, 500, 250)
    integrate(velocity, noise, process=PROCESS, solver=solver, steps=steps).block_until_ready()
    jax.effects_barrier()
    assert seen == list(steps)


@pytest.mark.parametrize("prediction", ["v", "epsilon"])
@pytest.mark.parametrize("solver", [DDIM(), DPMSolver(), UniPC()])
def test_a_solver_ends_alike_whatever_the_network_predicts(noise, solver, prediction):
    process = VariancePreserving(prediction=prediction, zero_terminal_snr=False)

    def denoise(x, t):
        time = per_sample(t + 1) / 1000
        data = jnp.tanh(x)
        epsilon = (x - process.alpha(time) * data) / process.sigma(time)
        return process.target(data, epsilon, time)

    x = integrate(denoise, noise, process=process, solver=solver, steps=10)
    reference = VariancePreserving(prediction="x0", zero_terminal_snr=False)
    data = lambda x, t: jnp.tanh(x)  # noqa: E731
    expected = integrate(data, noise, process=reference, solver=solver, steps=10)
    # epsilon is divided by alpha = 0.07 at the start.
    np.testing.assert_allclose(x, expected, atol=2e-5)


def test_renoise_begins_each_step_from_the_data_with_new_noise(noise):
    process, keys = RectifiedFlow(shift=5.0), jax.random.split(jax.random.key(1), 2)
    got = integrate(gaussian_velocity, noise, process=process, solver=Renoise(), steps=4, keys=keys)
    x = noise
    levels = [5 * u / (1 + 4 * u) for u in (1, 0.75, 0.5, 0.25, 0)]
    for step, (level, following) in enumerate(pairwise(levels)):
        data = x - level * gaussian_velocity(x, jnp.full(2, 1000 * level))
        new = [jax.random.normal(jax.random.fold_in(key, step), x.shape[1:]) for key in keys]
        x = (1 - following) * data + following * jnp.stack(new)
    np.testing.assert_allclose(got, x, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    ("process", "solver", "rule"),
    [
        (PROCESS, DDIM(eta=1.0), "keys"),
        (VariancePreserving(), Euler(), "DDIM"),
        (VariancePreserving(), UniPC(), "zero_terminal_snr"),
    ],
)
def test_a_solver_that_does_not_fit_is_refused(noise, process, solver, rule):
    with pytest.raises(InputError, match=rule):
        integrate(gaussian_velocity, noise, process=process, solver=solver, steps=2)
    with pytest.raises(InputError, match="order"):
        UniPC(order=0)
