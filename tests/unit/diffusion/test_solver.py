"""Solvers on equations with known solutions; `tests/parity/test_solvers.py` has the rest."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.diffusion import Euler, RectifiedFlow, UniPC, integrate
from egosim_jax.types import InputError

PROCESS = RectifiedFlow(shift=2.0)
SOLVERS = [Euler(), UniPC(order=1), UniPC(order=2), UniPC(order=3)]


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


@pytest.mark.parametrize("steps", [1, 2, 5])
@pytest.mark.parametrize("solver", SOLVERS)
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


@pytest.mark.parametrize(("solver", "order"), [(Euler(), 1), (UniPC(order=2), 2)])
def test_half_the_step_divides_the_error_by_two_to_the_order(noise, solver, order):
    ratio = end_error(solver, noise, 16) / end_error(solver, noise, 32)
    # The steps are not yet infinitely small: within a quarter of an order.
    assert np.log2(ratio) == pytest.approx(order, abs=0.25)


def test_unipc_of_8_steps_beats_euler_of_32(noise):
    assert end_error(UniPC(), noise, 8) < end_error(Euler(), noise, 32)


@pytest.mark.parametrize("solver", SOLVERS)
def test_the_velocity_is_traced_once_for_all_steps(noise, solver):
    calls = []

    def velocity(x, t):
        calls.append(t.shape)
        return x

    jax.jit(lambda x: integrate(velocity, x, process=PROCESS, solver=solver, steps=20))(noise)
    assert calls == [(2,)]


@pytest.mark.parametrize("solver", SOLVERS)
def test_latents_stay_float32_when_the_network_computes_in_bfloat16(noise, solver):
    seen = []

    def velocity(x, t):
        seen.append(x.dtype)
        return x.astype(jnp.bfloat16)

    x = integrate(velocity, noise.astype(jnp.bfloat16), process=PROCESS, solver=solver, steps=2)
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


def test_an_order_below_one_is_refused():
    with pytest.raises(InputError, match="order"):
        UniPC(order=0)
