"""Solvers against diffusers' schedulers, along a velocity that is not linear in the latents."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import FlowMatchEulerDiscreteScheduler, UniPCMultistepScheduler

from egosim_jax.diffusion import Euler, RectifiedFlow, UniPC, integrate

# Both round to float32: ours the latents, diffusers its coefficients.
TOLERANCE = 1e-6
SHAPE = (2, 3, 4, 5, 16)


def velocity(x, t):
    """A smooth velocity field, for NumPy and jax alike."""
    return 1.2 * x / (1 + 0.3 * x**2) + 0.5 * (1 + t / 500) ** 0.5 * x - 0.2 * t / 1000


def relative(actual, expected):
    return np.linalg.norm(np.asarray(actual) - expected) / np.linalg.norm(expected)


@pytest.fixture(scope="module")
def noise():
    return np.random.default_rng(0).standard_normal(SHAPE)


def unipc_latents(noise, scheduler):
    """diffusers' latents after each step."""
    x, latents = torch.from_numpy(noise), []
    for t, sigma in zip(scheduler.timesteps, scheduler.sigmas[:-1], strict=True):
        v = torch.from_numpy(velocity(x.numpy(), 1000 * sigma.item()))
        x = scheduler.step(v, t, x, return_dict=False)[0]
        latents.append(x.numpy())
    return latents


@pytest.mark.parametrize("steps", [10, 50])
def test_euler_ends_where_diffusers_ends(noise, steps):
    scheduler = FlowMatchEulerDiscreteScheduler(shift=5.0)
    scheduler.set_timesteps(sigmas=np.linspace(1, 0, steps + 1)[:-1])
    expected = torch.from_numpy(noise)
    for t, sigma in zip(scheduler.timesteps, scheduler.sigmas[:-1], strict=True):
        v = torch.from_numpy(velocity(expected.numpy(), 1000 * sigma.item()))
        # The scheduler returns the velocity's dtype.
        expected = scheduler.step(v, t, expected, return_dict=False)[0].double()
    actual = integrate(
        lambda x, t: velocity(x, t[:, None, None, None, None]),
        jnp.asarray(noise, jnp.float32),
        process=RectifiedFlow(shift=5.0),
        solver=Euler(),
        steps=steps,
    )
    assert relative(actual, expected.numpy()) < TOLERANCE


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("steps", [10, 50])
def test_unipc_follows_diffusers_step_by_step(noise, steps, order):
    scheduler = UniPCMultistepScheduler(
        prediction_type="flow_prediction", use_flow_sigmas=True, flow_shift=5.0, solver_order=order
    )
    scheduler.set_timesteps(steps)
    sigmas = scheduler.sigmas.double().numpy()
    expected = unipc_latents(noise, scheduler)

    solver, process = UniPC(order=order), RectifiedFlow()
    rows = solver.coefficients(process, sigmas)
    step = jax.jit(solver.step, static_argnums=0)
    state = solver.start(jnp.asarray(noise, jnp.float32))
    errors = []
    for i in range(steps):
        v = jnp.asarray(velocity(np.asarray(state.x, np.float64), 1000 * sigmas[i]), jnp.float32)
        state = step(process, state, v, jax.tree.map(lambda column, i=i: column[i], rows))
        errors.append(relative(state.x, expected[i]))
    assert max(errors) < TOLERANCE


@pytest.mark.parametrize("steps", [10, 50])
def test_unipc_takes_wans_noise_levels_and_whole_timesteps(noise, steps):
    """Wan shifts 0.999 ... 0 and gives the network int64 timesteps."""
    uniform = np.linspace(0.999, 0, steps + 1)[:-1]
    sigmas = 5.0 * uniform / (1 + 4.0 * uniform)
    scheduler = UniPCMultistepScheduler(prediction_type="flow_prediction", use_flow_sigmas=True)
    scheduler.set_timesteps(steps)
    scheduler.sigmas = torch.from_numpy(np.append(sigmas, 0.0))
    timesteps = torch.from_numpy(1000 * sigmas).to(torch.int64)
    expected = torch.from_numpy(noise)
    for given, t in zip(timesteps, scheduler.timesteps, strict=True):
        v = torch.from_numpy(velocity(expected.numpy(), given.item()))
        expected = scheduler.step(v, t, expected, return_dict=False)[0]
    actual = integrate(
        lambda x, t: velocity(x, t[:, None, None, None, None]),
        jnp.asarray(noise, jnp.float32),
        process=RectifiedFlow.wan_unipc(5.0),
        solver=UniPC(),
        steps=steps,
    )
    assert relative(actual, expected.numpy()) < TOLERANCE
