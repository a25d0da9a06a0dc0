"""Success rates of few trials, and their paired differences."""

from itertools import product
from math import comb, factorial

import numpy as np
import pytest

from egosim_jax.evaluation.metrics.rates import difference, rate


def coverage_of_rate(n, p):
    inside = [
        r["low"] - 1e-9 <= 100 * p <= r["high"] + 1e-9 for r in (rate(k, n) for k in range(n + 1))
    ]
    chance = [comb(n, k) * p**k * (1 - p) ** (n - k) for k in range(n + 1)]
    return float(np.dot(inside, chance))


@pytest.mark.parametrize("n", [1, 5, 20])
def test_the_interval_of_a_rate_has_the_true_rate_as_often_as_it_says(n):
    assert min(coverage_of_rate(n, p) for p in np.linspace(0.02, 0.98, 25)) >= 0.95


def outcomes(both, ours, theirs, neither):
    counts = {
        (True, True): both,
        (True, False): ours,
        (False, True): theirs,
        (False, False): neither,
    }
    pairs = [pair for pair, count in counts.items() for _ in range(count)]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def coverage_of_difference(n, chances):
    """Exact probability, over all outcomes of n pairs, that the interval has the true value."""
    gap, total = 100 * (chances[1] - chances[2]), 0.0
    for both, ours, theirs in product(range(n + 1), repeat=3):
        neither = n - both - ours - theirs
        if neither < 0:
            continue
        counts = both, ours, theirs, neither
        weight = factorial(n) / np.prod([factorial(k) for k in counts])
        found = difference(*outcomes(*counts))
        if found["low"] <= gap <= found["high"]:
            total += weight * np.prod([p**k for p, k in zip(chances, counts, strict=True)])
    return float(total)


@pytest.mark.parametrize(
    "chances", [(0.4, 0.1, 0.1, 0.4), (0.3, 0.4, 0.05, 0.25), (0.05, 0.8, 0.05, 0.1)]
)
def test_the_interval_of_a_difference_has_the_true_one_as_often_as_it_says(chances):
    assert coverage_of_difference(7, chances) >= 0.95


def test_a_difference_counts_the_pairs_that_differ():
    found = difference(*outcomes(3, 6, 0, 1))
    assert (found["mean"], found["better"], found["worse"]) == (60, 6, 0)
    assert found["p"] == pytest.approx(2 / 2**6)
    assert 0 < found["low"] < 60 < found["high"] < 100


@pytest.mark.parametrize(("better", "worse"), [(5, 0), (6, 0), (9, 1), (8, 2), (2, 8), (0, 6)])
def test_the_interval_excludes_0_if_the_test_does(better, worse):
    found = difference(*outcomes(3, better, worse, 4))
    assert (found["p"] < 0.05) == (found["low"] > 0 or found["high"] < 0)


def test_a_difference_changes_its_sign_with_the_order():
    one, other = outcomes(2, 6, 1, 3)
    there, back = difference(one, other), difference(other, one)
    assert there["low"] == pytest.approx(-back["high"])
    assert there["p"] == back["p"]


def test_equal_policies_do_not_differ():
    found = difference([True] * 5, [True] * 5)
    assert (found["mean"], found["p"]) == (0, 1)
    assert found["low"] < -30
    assert found["high"] > 30


def test_no_trials_have_no_rate():
    assert rate(0, 0) == difference([], []) == {}
