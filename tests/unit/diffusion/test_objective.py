import math
import statistics

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from egosim_jax.diffusion import Objective, RectifiedFlow, VariancePreserving
from egosim_jax.types import InputError

PROCESS = RectifiedFlow()
TIMES = ["uniform", "logit-normal", "diffsynth"]
DRAWS = 4000
SHAPE = (3, 2, 4, 4, 16)


def velocity(x, t):
    return jnp.sin(x) + t[:, None, None, None, None] / 1000


@pytest.fixture(scope="module")
def x0():
    return jax.random.normal(jax.random.key(5), SHAPE)


def draw(objective, process=PROCESS, seed=0):
    return np.sort(objective.sample_times(process, jax.random.key(seed), DRAWS))


def test_the_error_is_the_mean_square_to_noise_minus_data(x0):
    noise = jax.random.normal(jax.random.key(6), SHAPE)
    sigma = np.array([0.0, 0.3, 1.0])
    errors = Objective().loss_at(PROCESS, velocity, x0, noise, jnp.asarray(sigma, jnp.float32))
    for b in range(SHAPE[0]):
        squares = []
        for x, e in zip(np.ravel(x0[b]).tolist(), np.ravel(noise[b]).tolist(), strict=True):
            noisy = (1 - sigma[b]) * x + sigma[b] * e
            squares.append((math.sin(noisy) + sigma[b] - (e - x)) ** 2)
        # float32 against float64.
        assert errors[b] == pytest.approx(statistics.fmean(squares), rel=1e-5)


def test_elements_far_from_their_target_do_not_count(x0):
    noise, levels = jax.random.normal(jax.random.key(6), SHAPE), jnp.array([0.1, 0.5, 0.9])
    away = jnp.full(SHAPE, 3.0).at[:, 0, 0, 0].set(50.01).at[0, 0, 0, 0, 0].set(jnp.nan)

    def errors(objective):
        return objective.loss_at(PROCESS, lambda x, t: noise - x0 + away, x0, noise, levels)

    kept = 1 - 16 / math.prod(SHAPE[1:])
    np.testing.assert_allclose(errors(Objective(max_difference=50.0)), 9 * kept, rtol=1e-5)
    assert (errors(Objective())[1:] > 50).all()


def test_the_network_is_given_the_rounded_timesteps(x0):
    process = RectifiedFlow(timestep_rounding="bfloat16")
    given = []

    def record(x, t):
        given.extend(t.tolist())
        return x

    Objective().loss_at(process, record, x0, x0, jnp.array([0.9375, 0.25, 0.0926]))
    assert given == [936, 250, 92.5]


@pytest.mark.parametrize("times", TIMES)
def test_the_loss_is_the_weighted_mean_of_the_errors(x0, times):
    objective = Objective(times=times)
    loss, sampled = objective.loss(PROCESS, velocity, x0, jax.random.key(1))
    weights = objective.weight(PROCESS, sampled.time)
    expected = sum(float(w) * float(e) for w, e in zip(weights, sampled.error, strict=True)) / 3
    assert float(loss) == pytest.approx(expected, rel=1e-6)  # float32 sums


def test_loss_weights_weight_the_error_of_each_sample(x0):
    noise, sigma = jax.random.normal(jax.random.key(6), SHAPE), jnp.array([0.1, 0.5, 0.9])
    objective = Objective()
    weights = jnp.zeros((*SHAPE[:-1], 1)).at[:, 0].set(2.0)
    half = objective.loss_at(PROCESS, velocity, x0, noise, sigma, loss_weights=weights)
    first = objective.loss_at(PROCESS, velocity, x0[:, :1], noise[:, :1], sigma)
    np.testing.assert_allclose(half, first, rtol=1e-6)
    key = jax.random.key(3)
    ones, _ = objective.loss(PROCESS, velocity, x0, key, loss_weights=jnp.ones((*SHAPE[:-1], 1)))
    assert ones == objective.loss(PROCESS, velocity, x0, key)[0]


@pytest.mark.parametrize("times", TIMES)
def test_a_batch_with_its_own_keys_equals_batches_of_one(x0, times):
    objective = Objective(times=times)
    keys = jax.random.split(jax.random.key(2), SHAPE[0])
    together = objective.loss(PROCESS, velocity, x0, keys)[1]
    for b in range(SHAPE[0]):
        alone = objective.loss(PROCESS, velocity, x0[b : b + 1], keys[b : b + 1])[1]
        assert alone.time[0] == together.time[b]
        # The same numbers, summed in another order.
        np.testing.assert_allclose(alone.error[0], together.error[b], rtol=1e-6)


@pytest.mark.parametrize("times", TIMES)
def test_chunks_have_their_own_levels_and_frames_their_errors(times):
    x0 = jax.random.normal(jax.random.key(8), (3, 4, 4, 4, 16))
    by_frame = lambda x, t: jnp.sin(x) + t[:, :, None, None, None] / 1000  # noqa: E731
    objective = Objective(times=times)
    loss, sampled = objective.loss(PROCESS, by_frame, x0, jax.random.key(3), chunks=(1, 2, 1))
    np.testing.assert_array_equal(sampled.time[:, 1], sampled.time[:, 2])
    assert len(set(sampled.time.ravel().tolist())) == 9
    assert sampled.error.shape == (3, 4)
    weighted = objective.weight(PROCESS, sampled.time) * sampled.error
    assert float(loss) == pytest.approx(float(weighted.mean()), rel=1e-6)


def test_uniform_levels_have_the_quantiles_of_the_shifted_uniform():
    sigma = draw(Objective(times="uniform"), RectifiedFlow(shift=5.0))
    for quantile in (0.1, 0.5, 0.9):
        expected = 5 * quantile / (1 + 4 * quantile)
        # Five standard errors of the quantile at its flattest, sqrt(q (1-q) / n) d sigma / du.
        assert sigma[int(quantile * DRAWS)] == pytest.approx(expected, abs=0.06)


def test_logit_normal_levels_have_the_quantiles_of_the_shifted_sigmoid():
    objective = Objective(times="logit-normal", logit_mean=-0.5, logit_std=0.8)
    sigma = draw(objective, RectifiedFlow(shift=3.0))
    for quantile in (0.1, 0.5, 0.9):
        z = statistics.NormalDist(-0.5, 0.8).inv_cdf(quantile)
        u = 1 / (1 + math.exp(-z))
        # Five standard errors of the quantile, as above.
        assert sigma[int(quantile * DRAWS)] == pytest.approx(3 * u / (1 + 2 * u), abs=0.04)


def test_half_of_the_levels_may_be_those_of_a_sampler():
    process = RectifiedFlow()
    drawn = np.asarray(Objective(sampler_steps=3).sample_times(process, jax.random.key(0), DRAWS))
    levels = process.times(3)[:-1].astype(np.float32)
    counts = [(drawn == level).sum() for level in levels]
    # Five standard deviations of a binomial count; 0 at the end is never drawn.
    np.testing.assert_allclose(counts, DRAWS / 6, atol=5 * math.sqrt(DRAWS * 5 / 36))
    assert drawn.min() > 0
    others = np.sort(drawn[~np.isin(drawn, levels)])
    for quantile in (0.1, 0.5, 0.9):  # as below
        expected = 5 * quantile / (1 + 4 * quantile)
        assert others[int(quantile * len(others))] == pytest.approx(expected, abs=0.085)


def test_diffsynth_levels_are_those_of_a_thousand_step_sampler_each_as_likely():
    sigma = draw(Objective(times="diffsynth"))
    table = [5 * u / (1 + 4 * u) for u in (1 - i / 1000 for i in range(1000))]
    nearest = np.abs(sigma[:, None] - np.array(table)).argmin(axis=1)
    np.testing.assert_allclose(sigma, np.array(table)[nearest], rtol=1e-6)  # float32
    counts = np.bincount(nearest // 100, minlength=10)
    # Five standard deviations of a binomial count with mean 400.
    assert np.abs(counts - DRAWS / 10).max() < 5 * math.sqrt(DRAWS * 0.1 * 0.9)


def test_diffsynth_weights_are_a_shifted_bell_of_mean_one():
    timesteps = [1000 * 5 * u / (1 + 4 * u) for u in (1 - i / 1000 for i in range(1000))]
    bell = [math.exp(-2 * ((t - 500) / 1000) ** 2) for t in timesteps]
    shifted = [g - min(bell) for g in bell]
    expected = np.array([1000 * g / sum(shifted) for g in shifted])
    weights = Objective(times="diffsynth").weight(PROCESS, jnp.array(timesteps, jnp.float32) / 1000)
    # float32 differences of numbers near 0.6, divided by a mean of 0.15.
    np.testing.assert_allclose(weights, expected, atol=2e-6)
    assert np.mean(weights) == pytest.approx(1, rel=1e-6)
    assert weights[0] == pytest.approx(0, abs=2e-6)


@pytest.mark.parametrize("prediction", ["v", "x0"])
@pytest.mark.parametrize("times", TIMES)
def test_a_perfect_prediction_of_a_variance_preserving_process_has_no_error(x0, times, prediction):
    process = VariancePreserving(prediction=prediction)

    def perfect(x, t):
        """The prediction from the known data and the noise that makes `x` of them."""
        time = (t[:, None, None, None, None] + 1) / 1000
        noise = (x - process.alpha(time) * x0) / process.sigma(time)
        return process.target(x0, noise, time)

    loss, sampled = Objective(times=times).loss(process, perfect, x0, jax.random.key(4))
    assert len(set(sampled.time.tolist())) == 3
    # float32 noise, from a division by a sigma of 0.03 or more.
    np.testing.assert_allclose([loss, *sampled.error], 0, atol=1e-9)


@pytest.mark.parametrize(
    ("fields", "rule"),
    [
        ({"logit_std": 0.0}, "logit_std"),
        ({"max_difference": 0.0}, "max_difference must be above 0, not 0"),
        ({"times": "diffsynth", "sampler_steps": 2}, "sampler_steps"),
    ],
)
def test_an_objective_that_cannot_be_is_refused(fields, rule):
    with pytest.raises(InputError, match=rule):
        Objective(**fields)
