"""Guided trajectories of 50 steps: in float64 versus formulas, and of a network versus diffusers.

DWM's samplers are DDIM, its release's, and the SDE form of DPM-Solver++, the paper's, each with
guidance 6 away from the empty prompt.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import torch
from diffusers import CogVideoXDDIMScheduler, CogVideoXDPMScheduler, CogVideoXTransformer3DModel
from diffusers.models.embeddings import get_3d_rotary_pos_embed
from diffusers.pipelines.cogvideo.pipeline_cogvideox import get_resize_crop_region_for_grid
from diffusers.schedulers import scheduling_dpm_cogvideox

from egosim_jax import configs
from egosim_jax.convert.tables import cogvideox_dit
from egosim_jax.diffusion import DDIM, DPMSolver, integrate
from tests.parity.test_cogvideox import DIT, converted, randomize, relative_error

FLOAT64, FLOAT32 = 1e-9, 1e-4
"""Relative L2: sums in another order; and float32 over 50 guided steps of a network."""
SHAPE = (2, 3, 4, 6, 16)
MODEL = configs.get("dwm_cogvideox_5b")
SCALE, STEPS = MODEL.guidance.scale, MODEL.steps
SCHEDULER = {
    "prediction_type": "v_prediction",
    "snr_shift_scale": 1.0,
    "rescale_betas_zero_snr": True,
    "timestep_spacing": "trailing",
    "clip_sample": False,
}


def velocity(x, t, prompt):
    """Smooth output of a network, for NumPy and jax alike."""
    return 0.8 * x / (1 + 0.3 * x**2) - (0.3 + 0.1 * prompt) * (1 + t / 500) ** 0.5


def guided(x, t):
    without = velocity(x, t, 0.0)
    return without + 6.0 * (velocity(x, t, 1.0) - without)


def alphas_bar():
    """Signal of every timestep, as CogVideoX's betas and its rescaling define it."""
    betas = np.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2
    root = np.sqrt(np.cumprod(1 - betas))
    root = (root - root[-1]) * root[0] / (root[0] - root[-1])
    return root**2


def by_formula(solver, x, noises):
    """The steps of DDIM, and of the stochastic DPM-Solver++ (2M) with its limits, written out."""
    table, before, old = alphas_bar(), None, None
    timesteps = [round(1000 - 20 * i) - 1 for i in range(STEPS)]
    for i, t in enumerate(timesteps):
        previous = t - 20
        a, b = table[t], table[previous] if previous >= 0 else 1.0
        v = guided(x, t)
        data = np.sqrt(a) * x - np.sqrt(1 - a) * v
        if solver == "ddim":
            keep = np.sqrt((1 - b) / (1 - a))
            x = keep * x + (np.sqrt(b) - np.sqrt(a) * keep) * data
            continue
        half = lambda p: 0.5 * np.log(p / (1 - p))  # noqa: E731
        if previous < 0:
            x = data
        elif a == 0:
            x = np.sqrt(b) * data + np.sqrt(1 - b) * noises[i]
        else:
            h = half(b) - half(a)
            slope = data
            if before is not None and table[before] > 0:
                r = (half(a) - half(table[before])) / h
                slope = (1 + 1 / (2 * r)) * data - 1 / (2 * r) * old
            x = (
                np.sqrt((1 - b) / (1 - a)) * np.exp(-h) * x
                - (np.exp(-2 * h) - 1) * np.sqrt(b) * slope
                + np.sqrt(1 - b) * np.sqrt(1 - np.exp(-2 * h)) * noises[i]
            )
        before, old = t, data
    return x


def by_diffusers(solver, x, noises, monkeypatch, output):
    """The loop of diffusers' pipeline with its scheduler of either kind."""
    kind = CogVideoXDDIMScheduler if solver == "ddim" else CogVideoXDPMScheduler
    scheduler = kind(**SCHEDULER)
    scheduler.set_timesteps(STEPS)
    x, data, before = torch.from_numpy(x), None, None
    for i, t in enumerate(scheduler.timesteps):
        v = output(x, t)
        if solver == "ddim":
            x = scheduler.step(v, t, x, return_dict=False)[0]
            continue
        drawn = torch.from_numpy(noises[i])
        monkeypatch.setattr(
            scheduling_dpm_cogvideox, "randn_tensor", lambda *_, drawn=drawn, **__: drawn
        )
        x, data = scheduler.step(v, data, t, before, x)
        x, before = x.to(v.dtype), t
    return x.numpy()


def ours(solver, denoise, x, keys):
    return integrate(
        MODEL.guidance.guide(*denoise),
        x,
        process=MODEL.process,
        solver={"ddim": DDIM(), "dpm": DPMSolver(stochastic=True)}[solver],
        steps=STEPS,
        keys=keys if solver == "dpm" else None,
    )


def step_noises(keys, shape, dtype):
    """Return the noise that `integrate` draws at each step."""
    fold = jax.vmap(jax.random.fold_in, in_axes=(0, None))
    draw = jax.vmap(lambda key: jax.random.normal(key, shape[1:], dtype))
    return [np.array(draw(fold(keys, i))) for i in range(STEPS)]


@pytest.mark.parametrize("solver", ["ddim", "dpm"])
def test_a_guided_trajectory_in_float64_is_that_of_the_formulas_and_of_diffusers(
    monkeypatch, solver
):
    start = np.random.default_rng(0).standard_normal(SHAPE)
    with jax.enable_x64(True):
        keys = jax.random.split(jax.random.key(1), SHAPE[0])
        noises = step_noises(keys, SHAPE, jnp.float64)
        branches = [
            lambda x, t, p=p: velocity(x, t[:, None, None, None, None].astype(x.dtype), p)
            for p in (1.0, 0.0)
        ]
        have = np.asarray(ours(solver, branches, jnp.asarray(start), keys))
    assert have.dtype == np.float64
    assert relative_error(have, by_formula(solver, start, noises)) <= FLOAT64
    theirs = by_diffusers(
        solver,
        start,
        noises,
        monkeypatch,
        lambda x, t: torch.from_numpy(guided(x.numpy(), t.item())),
    )
    assert relative_error(have, theirs) <= FLOAT64


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["ddim", "dpm"])
def test_a_guided_trajectory_of_a_network_is_that_of_diffusers(monkeypatch, solver):
    config = replace(DIT, in_channels=49, dim=32, heads=2, layers=1, text_dim=8, time_dim=16)
    module = randomize(CogVideoXTransformer3DModel(**cogvideox_dit.arguments(config)))
    network = converted(config, module, cogvideox_dit.diffusers(config))
    draw = np.random.default_rng(0).standard_normal
    shape = (1, 3, 4, 6, 16)
    start, condition = draw(shape, np.float32), draw((*shape[:-1], 33), np.float32)
    texts = draw((2, 1, 5, config.text_dim), np.float32)
    keys = jax.random.split(jax.random.key(1), 1)
    noises = step_noises(keys, shape, jnp.float32)
    grid = shape[2] // 2, shape[3] // 2
    region = get_resize_crop_region_for_grid(grid, config.base_columns, config.base_rows)
    rotary = get_3d_rotary_pos_embed(config.head_dim, region, grid, shape[1])

    def theirs(x, t):
        latents = torch.cat([x.float(), torch.from_numpy(condition)], dim=-1).permute(0, 1, 4, 2, 3)
        with torch.no_grad():
            conditional, without = (
                module(latents, torch.from_numpy(text), t[None], image_rotary_emb=rotary).sample
                for text in texts
            )
        v = without + SCALE * (conditional - without)
        return v.permute(0, 1, 3, 4, 2)

    def trajectory(x, keys):
        branches = []
        for text in texts:
            context = network.prepare(jnp.asarray(condition), jnp.asarray(text))
            branches.append(lambda x, t, context=context: network.denoise(x, t, context))
        return ours(solver, branches, x, keys)

    with jax.default_matmul_precision("highest"):
        have = np.asarray(jax.jit(trajectory)(jnp.asarray(start), keys))
    want = by_diffusers(solver, start, noises, monkeypatch, theirs)
    assert relative_error(have, want) <= FLOAT32
