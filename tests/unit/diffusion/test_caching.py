"""Steps that reuse predictions: what they cost, how far they are from all steps, and batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.diffusion import DDIM, Euler, RectifiedFlow, StepCache, UniPC, integrate
from egosim_jax.types import InputError

PROCESS, STEPS = RectifiedFlow(shift=3.0), 40
SPREADS = jnp.array([0.2, 0.5, 0.9])


@pytest.fixture(scope="module")
def noise():
    return jax.random.normal(jax.random.key(0), (3, 2, 2, 2, 4))


def velocity(x, t, spreads=SPREADS):
    """Velocity when the data of each sample are normal, with its own spread."""
    sigma, std = (v[:, None, None, None, None] for v in (t / 1000, spreads[: len(x)]))
    return x * (sigma - (1 - sigma) * std**2) / ((1 - sigma) ** 2 * std**2 + sigma**2)


def sampled(noise, cache, solver=None, spreads=SPREADS):
    """Latents, and the number of forward passes of the batch."""
    runs = []

    def counted(x, t):
        jax.debug.callback(lambda _: runs.append(1), t[0])
        return velocity(x, t, spreads)

    x = integrate(
        counted, noise, process=PROCESS, solver=solver or Euler(), steps=STEPS, cache=cache
    )
    jax.effects_barrier()
    return x, len(runs)


@pytest.mark.parametrize("solver", [Euler(), UniPC(), DDIM()])
def test_a_threshold_that_no_step_passes_runs_them_all(noise, solver):
    x, passes = sampled(noise, StepCache(threshold=1e-9), solver)
    given = {"process": PROCESS, "solver": solver, "steps": STEPS}
    np.testing.assert_allclose(x, integrate(velocity, noise, **given), rtol=1e-5, atol=1e-6)
    assert passes == STEPS


def test_a_higher_threshold_takes_fewer_passes_and_ends_farther_away(noise):
    exact = integrate(velocity, noise, process=PROCESS, solver=Euler(), steps=STEPS)
    counts, errors = [], []
    for threshold in (0.01, 0.05, 0.2):
        x, passes = sampled(noise, StepCache(threshold=threshold))
        counts.append(passes)
        errors.append(float(jnp.linalg.norm(x - exact) / jnp.linalg.norm(exact)))
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < counts[0] < STEPS
    assert errors == sorted(errors)
    assert errors[0] < 0.01


def test_a_batch_gives_what_its_samples_give_alone(noise):
    cache = StepCache(threshold=0.05)
    together, passes = sampled(noise, cache)
    counts = []
    for index in range(3):
        here = slice(index, index + 1)
        alone, count = sampled(noise[here], cache, spreads=SPREADS[here])
        np.testing.assert_allclose(together[index], alone[0], rtol=1e-5, atol=1e-6)
        counts.append(count)
    assert len(set(counts)) > 1  # they differ in the steps that they reuse
    assert max(counts) <= passes < STEPS  # a pass is made if one of them needs it


def test_first_and_last_steps_are_always_computed():
    due = StepCache(threshold=0.1, first=3).due(6)
    assert due.tolist() == [True, True, True, False, False, True]


@pytest.mark.parametrize("threshold", [0.0, -0.1, 1.0, float("nan")])
def test_thresholds_out_of_range_are_refused(threshold):
    with pytest.raises(InputError, match=r"--cache"):
        StepCache(threshold=threshold)
