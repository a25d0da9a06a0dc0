"""DDIM, DPM-Solver++ and the variance-preserving process against diffusers in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import (
    CogVideoXDDIMScheduler,
    CogVideoXDPMScheduler,
    DDIMScheduler,
    DPMSolverMultistepScheduler,
)
from diffusers.schedulers import scheduling_dpm_cogvideox

from egosim_jax.diffusion import DDIM, DPMSolver, RectifiedFlow, VariancePreserving, integrate

# float32 latents and coefficients against float64.
TOLERANCE = 1e-6
SHAPE = (2, 3, 4, 5, 16)
KINDS = {"v": "v_prediction", "epsilon": "epsilon", "x0": "sample"}
COGVIDEOX_5B = VariancePreserving()
COGVIDEOX_2B = VariancePreserving(snr_shift=3.0)
KEPT_SIGNAL = VariancePreserving(snr_shift=3.0, zero_terminal_snr=False, spacing="leading")
PROCESSES = [COGVIDEOX_5B, COGVIDEOX_2B, KEPT_SIGNAL]


def output(x, t):
    """A smooth network output, for NumPy and jax alike."""
    return 0.8 * x / (1 + 0.3 * x**2) - 0.3 * (1 + t / 500) ** 0.5 - 0.2 * t / 1000


def relative(actual, expected):
    return np.linalg.norm(np.asarray(actual) - expected) / np.linalg.norm(expected)


def arguments(process):
    """The arguments of a CogVideoX scheduler of diffusers."""
    return {
        "snr_shift_scale": process.snr_shift,
        "rescale_betas_zero_snr": process.zero_terminal_snr,
        "timestep_spacing": process.spacing,
        "prediction_type": KINDS[process.prediction],
        "clip_sample": False,
    }


@pytest.fixture(scope="module")
def noise():
    return np.random.default_rng(0).standard_normal(SHAPE)


@pytest.fixture(scope="module")
def keys():
    return jax.random.split(jax.random.key(1), SHAPE[0])


def step_noise(keys, step):
    """The noise that `integrate` draws at a step."""
    drawn = [jax.random.normal(jax.random.fold_in(key, step), SHAPE[1:]) for key in keys]
    return torch.from_numpy(np.stack(drawn)).double()


def sample(process, solver, noise, steps, keys=None):
    return integrate(
        lambda x, t: output(x, t[:, None, None, None, None]),
        jnp.asarray(noise, jnp.float32),
        process=process,
        solver=solver,
        steps=steps,
        keys=keys,
    )


@pytest.mark.parametrize("process", PROCESSES)
@pytest.mark.parametrize("steps", [10, 50])
def test_the_process_visits_diffusers_timesteps_at_its_noise_levels(process, steps):
    scheduler = CogVideoXDDIMScheduler(**arguments(process))
    scheduler.set_timesteps(steps)
    times = process.times(steps)
    np.testing.assert_array_equal(process.timesteps(times[:-1]), scheduler.timesteps)
    expected = scheduler.alphas_cumprod[scheduler.timesteps].numpy()
    # Sums and products of float64 numbers in another order.
    np.testing.assert_allclose(process.alpha(times[:-1]) ** 2, expected, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(process.sigma(times[:-1]) ** 2, 1 - expected, rtol=1e-9)
    assert (process.alpha(times)[-1], process.sigma(times)[-1]) == (1, 0)


@pytest.mark.parametrize("process", PROCESSES)
def test_noisy_latents_and_v_targets_are_diffusers(process, noise):
    scheduler = CogVideoXDDIMScheduler(**arguments(process))
    x0 = torch.from_numpy(np.roll(noise, 1))
    timesteps = torch.tensor([999, 250])
    time = jnp.asarray((timesteps.numpy() + 1) / 1000, jnp.float32)[:, None, None, None, None]
    given = jnp.asarray(x0, jnp.float32), jnp.asarray(noise, jnp.float32)
    expected = scheduler.add_noise(x0, torch.from_numpy(noise), timesteps)
    assert relative(process.add_noise(*given, time), expected.numpy()) < TOLERANCE
    expected = scheduler.get_velocity(x0, torch.from_numpy(noise), timesteps)
    assert relative(process.target(*given, time), expected.numpy()) < TOLERANCE


@pytest.mark.parametrize(
    ("process", "steps"),
    [
        (COGVIDEOX_5B, 50),
        (COGVIDEOX_2B, 10),
        (KEPT_SIGNAL, 50),
        (VariancePreserving(prediction="epsilon", zero_terminal_snr=False), 10),
    ],
)
def test_ddim_ends_where_cogvideox_ends(process, noise, steps):
    scheduler = CogVideoXDDIMScheduler(**arguments(process))
    scheduler.set_timesteps(steps)
    x = torch.from_numpy(noise)
    for t in scheduler.timesteps:
        x = scheduler.step(torch.from_numpy(output(x.numpy(), t.item())), t, x, return_dict=False)[
            0
        ]
    assert relative(sample(process, DDIM(), noise, steps), x.numpy()) < TOLERANCE


@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("process", [COGVIDEOX_5B, KEPT_SIGNAL])
def test_ddim_of_any_eta_ends_where_diffusers_ends(process, noise, keys, eta):
    scheduler = DDIMScheduler(
        timestep_spacing=process.spacing, prediction_type="v_prediction", clip_sample=False
    )
    # diffusers has these betas in float32.
    scheduler.alphas_cumprod = torch.from_numpy(
        process.alpha(np.arange(1, 1001, dtype=np.float64) / 1000) ** 2
    )
    scheduler.set_timesteps(20)
    x = torch.from_numpy(noise)
    for i, t in enumerate(scheduler.timesteps):
        v = torch.from_numpy(output(x.numpy(), t.item()))
        given = {"eta": eta, "variance_noise": step_noise(keys, i) if eta else None}
        x = scheduler.step(v, t, x, return_dict=False, **given)[0]
    actual = sample(process, DDIM(eta=eta), noise, 20, keys)
    assert relative(actual, x.numpy()) < TOLERANCE


@pytest.mark.parametrize(
    ("process", "steps"), [(COGVIDEOX_5B, 50), (COGVIDEOX_2B, 10), (KEPT_SIGNAL, 50)]
)
def test_dpm_sde_ends_where_cogvideox_ends(monkeypatch, process, noise, keys, steps):
    scheduler = CogVideoXDPMScheduler(**arguments(process))
    scheduler.set_timesteps(steps)
    x, data, before = torch.from_numpy(noise), None, None
    for i, t in enumerate(scheduler.timesteps):
        drawn = step_noise(keys, i)
        monkeypatch.setattr(
            scheduling_dpm_cogvideox, "randn_tensor", lambda *_, drawn=drawn, **__: drawn
        )
        v = torch.from_numpy(output(x.numpy(), t.item()))
        x, data = scheduler.step(v, data, t, before, x)
        before = t
    actual = sample(process, DPMSolver(stochastic=True), noise, steps, keys)
    assert relative(actual, x.numpy()) < TOLERANCE


@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # diffusers
@pytest.mark.parametrize(
    ("process", "steps", "stochastic"),
    [
        (RectifiedFlow(), 10, False),
        (RectifiedFlow(), 50, True),
        (COGVIDEOX_2B, 50, False),
        (COGVIDEOX_2B, 10, True),
        (KEPT_SIGNAL, 10, False),
        (KEPT_SIGNAL, 50, True),
    ],
)
def test_dpm_ends_where_diffusers_ends(process, noise, keys, steps, stochastic):
    flow = isinstance(process, RectifiedFlow)
    scheduler = DPMSolverMultistepScheduler(
        algorithm_type="sde-dpmsolver++" if stochastic else "dpmsolver++",
        prediction_type="flow_prediction" if flow else "v_prediction",
        use_flow_sigmas=flow,
        lower_order_final=False,
    )
    scheduler.set_timesteps(steps)
    times = process.times(steps)
    alpha, sigma = process.alpha(times), process.sigma(times)
    with np.errstate(divide="ignore"):  # diffusers' noise level is sigma / alpha off the flow
        scheduler.sigmas = torch.from_numpy(sigma if flow else sigma / alpha)
    timesteps = process.timesteps(times[:-1])
    # diffusers' own variance-preserving scales are 0 / 0 at pure noise.
    scheduler._sigma_to_alpha_sigma_t = lambda level: scales(level, flow)
    x = torch.from_numpy(noise)
    for i, t in enumerate(scheduler.timesteps):
        v = torch.from_numpy(output(x.numpy(), timesteps[i]))
        x = scheduler.step(v, t, x, variance_noise=step_noise(keys, i), return_dict=False)[0]
    actual = sample(process, DPMSolver(stochastic=stochastic), noise, steps, keys)
    assert relative(actual, x.numpy()) < TOLERANCE


def scales(level, flow):
    """Scale of data and noise at diffusers' noise level."""
    if flow:
        return 1 - level, level
    alpha = 1 / (level**2 + 1) ** 0.5
    return alpha, torch.ones_like(level) if level.isinf() else level * alpha
