"""Agreement of two evaluations of the same policies: correlation, and violations of the ranking.

Policy i has success s_i in the generated world and r_i in the true world. A pair is ranked wrongly
if s_i < s_j but not r_i < r_j, or vice versa. The mean maximum rank violation is

    MMRV = mean_i max_j |r_i - r_j| [(s_i < s_j) != (r_i < r_j)]

It is in units of success, and 0 for equal rankings. Source: Li et al.,
Evaluating Real-World Robot Manipulation Policies in Simulation (SIMPLER), 2024, section III.
"""

from __future__ import annotations

from collections.abc import Callable

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
    "low, high": "95 % interval of the bootstrap over scenes, which all policies share",
}


def pearson(values: Float[np.ndarray, " n"], reference: Float[np.ndarray, " n"]) -> float:
    """Return Pearson's correlation; NaN if an input is constant."""
    a, b = values - values.mean(), reference - reference.mean()
    strength = np.sqrt((a @ a) * (b @ b))
    return float(a @ b / strength) if strength > 0 else float("nan")


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
    level: float = 0.95,
    resamples: int = 2000,
) -> dict[str, dict[str, float]]:
    """Return each measure of the success of p policies in s scenes, with its bootstrap interval.

    The bootstrap resamples scenes with a fixed seed; undefined values of a measure are ignored.
    """
    scenes = generated.shape[1]
    draws = np.random.default_rng(0).integers(scenes, size=(resamples, scenes))
    measures: dict[str, Callable[[np.ndarray, np.ndarray], float]] = {
        "pearson": pearson,
        "spearman": spearman,
        "mmrv": mmrv,
    }
    found = {}
    for name, measure in measures.items():
        again = np.array(
            [measure(generated[:, d].mean(axis=1), true[:, d].mean(axis=1)) for d in draws]
        )
        known = again[~np.isnan(again)]
        low, high = np.quantile(known, [(1 - level) / 2, (1 + level) / 2]) if len(known) else (
            np.nan, np.nan,
        )  # fmt: skip
        value = measure(generated.mean(axis=1), true.mean(axis=1))
        found[name] = {"mean": value, "low": float(low), "high": float(high)}
    return found
