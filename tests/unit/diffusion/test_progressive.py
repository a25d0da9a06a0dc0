"""Steps on half the latent grid: their noise, their path, and what they give in the end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.diffusion import (
    DPMSolver,
    Euler,
    Progressive,
    RectifiedFlow,
    Renoise,
    StepCache,
    UniPC,
    VariancePreserving,
    integrate,
)
from egosim_jax.diffusion.progressive import (
    half_times,
    integrate_progressively,
    means,
    refined,
)
from egosim_jax.types import InputError

PROCESS, STEPS = RectifiedFlow(shift=3.0), 20
SHAPE = (3, 2, 4, 8, 4)
SPREADS = jnp.array([0.2, 0.5, 0.9])


@pytest.fixture(scope="module")
def noise():
    return jax.random.normal(jax.random.key(0), SHAPE)


def block_means(x):
    """Means of 2 x 2 cells, by plain NumPy."""
    x = np.asarray(x)
    return (x[:, :, ::2, ::2] + x[:, :, 1::2, ::2] + x[:, :, ::2, 1::2] + x[:, :, 1::2, 1::2]) / 4


def each(x):
    return x[:, None, None, None, None]


def velocity_on_half(x, t, spreads=SPREADS):
    """Velocity on the half grid when its data are normal, with each sample's own spread."""
    sigma, variance = each(t / 1000), each(spreads[: len(x)]) ** 2
    data = (1 - sigma) * variance / ((1 - sigma) ** 2 * variance + sigma**2) * x
    return (x - data) / sigma


def velocity_on_whole(x, t, spreads=SPREADS):
    """Velocity on the whole grid, where each block of 2 x 2 cells has one such value."""
    sigma, variance = each(t / 1000), each(spreads[: len(x)]) ** 2
    average = x.reshape(*x.shape[:2], x.shape[2] // 2, 2, x.shape[3] // 2, 2, -1).mean((3, 5))
    # The mean of four cells has a quarter of the noise's variance.
    data = (1 - sigma) * variance / ((1 - sigma) ** 2 * variance + sigma**2 / 4) * average
    return (x - data.repeat(2, axis=2).repeat(2, axis=3)) / sigma


def sampled(noise, share=0.5, solver=None, *, spreads=SPREADS, cache=None, steps=STEPS, runs=None):
    def counted(velocity, name):
        def predict(x, t):
            if runs is not None:
                jax.debug.callback(lambda _: runs.append(name), t[0])
            return velocity(x, t, spreads)

        return predict

    return integrate_progressively(
        counted(velocity_on_half, "half"),
        counted(velocity_on_whole, "whole"),
        noise,
        noise,
        progressive=Progressive(share=share),
        process=PROCESS,
        solver=solver or Euler(),
        steps=steps,
        cache=cache,
    )


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_data_that_the_half_grid_can_show_come_out_as_on_the_whole_grid(noise, share):
    """Euler's step is exact on the straight path, so both grids take the same one."""
    whole = integrate(velocity_on_whole, noise, process=PROCESS, solver=Euler(), steps=STEPS)
    np.testing.assert_allclose(sampled(noise, share), whole, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("solver", [UniPC(), DPMSolver()])
def test_multistep_solvers_start_again_on_the_whole_grid(noise, solver):
    sampler = {"process": PROCESS, "solver": solver}
    exact = integrate(velocity_on_whole, noise, steps=400, **sampler)
    for_steps = [
        float(jnp.linalg.norm(sampled(noise, 0.5, solver, steps=n) - exact)) for n in (10, 20, 40)
    ]
    assert for_steps == sorted(for_steps, reverse=True)
    assert for_steps[-1] < 0.02 * float(jnp.linalg.norm(exact))


def test_the_share_of_the_steps_runs_on_half_the_grid(noise):
    runs = []
    sampled(noise, 0.6, runs=runs).block_until_ready()
    jax.effects_barrier()
    assert runs == 12 * ["half"] + 8 * ["whole"]


def test_the_noise_of_the_half_grid_is_standard_and_shared():
    """A million cells: the standard errors are about 0.002 for half the grid, less for all."""
    whole = jax.random.normal(jax.random.key(1), (1, 4, 256, 256, 4))
    half = np.asarray(2 * means(whole))
    np.testing.assert_allclose(half, 2 * block_means(whole), atol=1e-6)
    assert half.mean() == pytest.approx(0, abs=0.01)
    assert half.var() == pytest.approx(1, abs=0.01)
    assert (half[:, :, 1:] * half[:, :, :-1]).mean() == pytest.approx(0, abs=0.01)
    # Its own noise gives back the whole noise, any other as much noise.
    np.testing.assert_allclose(refined(jnp.asarray(half), whole, 1.0), whole, atol=1e-6)
    foreign = jax.random.normal(jax.random.key(2), half.shape)
    (time,) = half_times(np.array([0.6]))
    for epsilon in (jnp.asarray(half), foreign):
        x = np.asarray(refined(time * epsilon, whole, 0.6))
        assert x.var() == pytest.approx(0.36, abs=0.004)
        assert (x[:, :, :, 1:] * x[:, :, :, :-1]).mean() == pytest.approx(0, abs=0.004)
        assert (x[:, :, 1:] * x[:, :, :-1]).mean() == pytest.approx(0, abs=0.004)


def test_the_refined_latents_have_the_half_grids_as_their_means(noise):
    data = jax.random.normal(jax.random.key(3), (3, 2, 2, 4, 4))
    t = 0.7
    (after,) = half_times(np.array([t]))
    on_half = (1 - after) * data + after * 2 * means(noise)
    x = refined(on_half, noise, t)
    # The path of the half grid is the whole grid's, divided by 1 - t / 2.
    np.testing.assert_allclose(block_means(x) / (1 - t / 2), on_half, atol=1e-5)
    # Data that are equal within blocks lie on the whole grid's path, too.
    blocks = np.asarray(data).repeat(2, axis=2).repeat(2, axis=3)
    np.testing.assert_allclose(x, (1 - t) * blocks + t * noise, atol=1e-5)


def test_noise_levels_are_shifted_as_for_a_quarter_of_the_cells():
    times = PROCESS.times(10)[:-1]
    shifted = 2 * half_times(times) / (1 + half_times(times))
    np.testing.assert_allclose(shifted, times, rtol=1e-12)


@pytest.mark.parametrize("cache", [None, StepCache(threshold=0.05, first=2)])
def test_a_batch_gives_what_its_samples_give_alone(noise, cache):
    together = sampled(noise, cache=cache)
    for index in range(3):
        here = slice(index, index + 1)
        alone = sampled(noise[here], spreads=SPREADS[here], cache=cache)
        np.testing.assert_allclose(together[index], alone[0], rtol=1e-5, atol=1e-6)


def test_a_cache_skips_passes_on_both_grids(noise):
    runs = []
    sampled(noise, 0.5, cache=StepCache(threshold=0.2, first=2), runs=runs).block_until_ready()
    jax.effects_barrier()
    assert 2 <= runs.count("half") < 10
    assert 2 <= runs.count("whole") < 10


@pytest.mark.parametrize("share", [0.0, 1.0, -0.5, float("nan")])
def test_shares_out_of_range_are_refused(share):
    with pytest.raises(InputError, match="--progressive"):
        Progressive(share=share)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"process": VariancePreserving()}, "rectified flow"),
        ({"solver": Renoise()}, "Renoise adds noise"),
        ({"steps": 1}, "at least one step"),
        ({"cells": (4, 6)}, "4 x 6 cells have no half grid: .* multiples of 4"),
        ({"cells": (5, 8)}, "5 x 8 cells have no half grid"),
    ],
)
def test_samplers_and_grids_without_such_steps_are_refused(given, message):
    usual = {"process": PROCESS, "solver": Euler(), "steps": 4, "cells": (4, 8), "patch": 2}
    progressive = Progressive(share=0.5)
    progressive.check(**usual)
    with pytest.raises(InputError, match=message):
        progressive.check(**usual | given)
