"""Agreement of rankings against SciPy, the definition of MMRV, and cases known by hand."""

import numpy as np
import pytest
import scipy.stats

from egosim_jax.evaluation.metrics.rank_correlation import agreement, mmrv, pearson, spearman


@pytest.mark.parametrize("seed", range(5))
def test_correlations_equal_scipys_with_ties(seed):
    rng = np.random.default_rng(seed)
    values, reference = rng.integers(0, 6, (2, 9)) / 5
    assert pearson(values, reference) == pytest.approx(scipy.stats.pearsonr(values, reference)[0])
    assert spearman(values, reference) == pytest.approx(scipy.stats.spearmanr(values, reference)[0])


@pytest.mark.parametrize("seed", range(5))
def test_mmrv_equals_its_definition(seed):
    s, r = np.random.default_rng(seed).integers(0, 6, (2, 7)) / 5
    violations = [
        max(abs(r[i] - r[j]) * ((s[i] < s[j]) != (r[i] < r[j])) for j in range(7)) for i in range(7)
    ]
    assert mmrv(s, r) == pytest.approx(np.mean(violations))


def test_constant_success_has_no_correlation():
    assert np.isnan(pearson(np.ones(4), np.arange(4.0)))
    assert np.isnan(pearson(np.full(7, 0.1), np.arange(7.0)))  # whose mean is not exactly 0.1
    assert np.isnan(pearson(np.arange(7.0), np.full(7, 1 / 3)))
    assert np.isnan(spearman(np.ones(4), np.arange(4.0)))


@pytest.mark.parametrize(
    ("policies", "scenes", "case"), [(8, 12, "far apart"), (8, 24, "alike"), (5, 48, "one noise")]
)
def test_intervals_have_the_value_over_all_scenes_as_often_as_they_say(policies, scenes, case):
    rng = np.random.default_rng(policies * scenes)
    wobble = np.sin(3 * np.arange(policies))
    chance = np.linspace(*((0.3, 0.7) if case == "alike" else (0.1, 0.9)), policies)
    expected = np.clip(0.5 + 0.6 * (chance - 0.5) + 0.15 * wobble, 0.03, 0.97)
    shared = 0.6 if case == "one noise" else 0.0
    value = pearson(shared * chance + (1 - shared) * expected, chance)
    hits, repetitions = 0, 300
    for _ in range(repetitions):
        true = (rng.random((policies, scenes)) < chance[:, None]).astype(float)
        own = (rng.random((policies, scenes)) < expected[:, None]).astype(float)
        generated = np.where(rng.random((policies, scenes)) < shared, true, own)
        found = agreement(generated, true, resamples=1)["pearson"]
        hits += found["low"] <= value <= found["high"]
    assert hits / repetitions >= 0.9


def test_two_scenes_give_no_interval():
    found = agreement(np.eye(3)[:, :2], np.eye(3)[:, :2])
    assert all(value.keys() == {"mean"} for value in found.values())
