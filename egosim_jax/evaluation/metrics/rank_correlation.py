"""Agreement of two evaluations of the same policies: correlation, and violations of the ranking.

Policy i has success s_i in the generated world and r_i in the true world. A pair is ranked wrongly
if s_i < s_j but not r_i < r_j, or vice versa. The mean maximum rank violation is

    MMRV = mean_i max_j |r_i - r_j| [(s_i < s_j) != (r_i < r_j)]

It is in units of success, and 0 for equal rankings. Source: Li et al.,
Evaluating Real-World Robot Manipulation Policies in Simulation (SIMPLER), 2024, section III.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

MEASURES = {
    "pearson": ("Pearson", "{:.3f}"),
    "spearman": ("Spearman", "{:.3f}"),
    "mmrv": ("MMRV", "{:.3f}"),
}
DEFINITIONS = {
    "pearson, spearman": "correlation over policies of the share of scenes with success in the "
    "generated world and in the true one; of the shares, and of their ranks",
    "mmrv": "mean over policies of the largest difference in true success to a policy that the "
    "generated world ranks wrongly against it",
    "low, high": "95 % intervals over scenes, which all policies share: of Pearson's correlation "
    "by the jackknife, without the spread by chance of few scenes; of the MMRV by the bootstrap",
}


def pearson(values: Float[np.ndarray, " n"], reference: Float[np.ndarray, " n"]) -> float:
    """Return Pearson's correlation; NaN if an input is constant, also up to rounding."""
    if _is_constant(values) or _is_constant(reference):
        return float("nan")
    a, b = values - values.mean(), reference - reference.mean()
    return float(a @ b / np.sqrt((a @ a) * (b @ b)))


def _is_constant(values: Float[np.ndarray, " n"]) -> bool:
    """Return True if the values differ by rounding at most."""
    return bool(np.ptp(values) <= 1e-12 * np.abs(values).max(initial=0))


def spearman(values: Float[np.ndarray, " n"], reference: Float[np.ndarray, " n"]) -> float:
    """Return Spearman's rank correlation (ties: mean rank); NaN if an input is constant."""
    from scipy.stats import rankdata

    return pearson(rankdata(values), rankdata(reference))


def mmrv(values: Float[np.ndarray, " n"], reference: Float[np.ndarray, " n"]) -> float:
    """Return the mean maximum rank violation of values against a reference."""
    wrong = (values[:, None] < values) != (reference[:, None] < reference)
    gaps = np.abs(reference[:, None] - reference)
    return float((gaps * wrong).max(axis=1).mean())


def agreement(
    generated: Float[np.ndarray, "p s"],
    true: Float[np.ndarray, "p s"],
    *,
    resamples: int = 2000,
) -> dict[str, dict[str, float]]:
    """Return each measure of the success of p policies in s scenes.

    Pearson's correlation and the MMRV have intervals for their values over all scenes of the
    world. Spearman's correlation has none: resampled scenes tie and swap the policies' ranks.
    """
    means = generated.mean(axis=1), true.mean(axis=1)
    return {
        "pearson": {"mean": pearson(*means), **_pearson_interval(generated, true)},
        "spearman": {"mean": spearman(*means)},
        "mmrv": {"mean": mmrv(*means), **_mmrv_interval(generated, true, resamples)},
    }


def _pearson_interval(
    generated: Float[np.ndarray, "p s"], true: Float[np.ndarray, "p s"]
) -> dict[str, float]:
    """Return the 95 % interval of the correlation of success over all scenes, by the jackknife.

    The chance of a few scenes spreads the policies' shares and so lowers the correlation. Products
    of different scenes alone have the covariance of the expected shares as mean. If the scenes do
    not show that policies differ, nothing is excluded.
    """
    from scipy.special import stdtrit

    scenes = generated.shape[1]
    if scenes < 3:
        return {}
    a, b = generated - generated.mean(axis=0), true - true.mean(axis=0)
    above, *squares = (_covariances(*pair) for pair in ((a, b), (a, a), (b, b)))
    if min(map(np.min, squares)) <= 0:
        return {"low": -1.0, "high": 1.0}
    all_scenes, *without_one = above / np.sqrt(squares[0] * squares[1])
    half = stdtrit(scenes - 1, 0.975) * (scenes - 1) * np.std(without_one)
    half /= np.sqrt(scenes - 1)
    low, high = np.clip([all_scenes - half, all_scenes + half], -1, 1)
    return {"low": float(low), "high": float(high)}


def _covariances(
    a: Float[np.ndarray, "p s"], b: Float[np.ndarray, "p s"]
) -> Float[np.ndarray, " s1"]:
    """Return the mean product of different scenes, over all scenes and without each one."""
    scenes, same = a.shape[1], (a * b).sum(axis=0)
    sums = a.sum(axis=1, keepdims=True), b.sum(axis=1, keepdims=True)
    whole = ((sums[0] * sums[1]).sum() - same.sum()) / (scenes * (scenes - 1))
    rest = ((sums[0] - a) * (sums[1] - b)).sum(axis=0) - (same.sum() - same)
    return np.concatenate([[whole], rest / ((scenes - 1) * (scenes - 2))])


def _mmrv_interval(
    generated: Float[np.ndarray, "p s"],
    true: Float[np.ndarray, "p s"],
    resamples: int,
) -> dict[str, float]:
    """Return the interval by Student's t around the value less its bias, both by the bootstrap.

    The bootstrap resamples the scenes, which all policies share, with a fixed seed.
    """
    from scipy.special import stdtrit

    scenes = generated.shape[1]
    if scenes < 3:
        return {}
    draws = np.random.default_rng(0).integers(scenes, size=(resamples, scenes))
    again = [mmrv(generated[:, d].mean(axis=1), true[:, d].mean(axis=1)) for d in draws]
    center = 2 * mmrv(generated.mean(axis=1), true.mean(axis=1)) - np.mean(again)
    half = stdtrit(scenes - 1, 0.975) * np.std(again)
    low, high = np.clip([center - half, center + half], 0, 1)
    return {"low": float(low), "high": float(high)}
