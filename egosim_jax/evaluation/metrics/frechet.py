"""Fréchet distance between the features of two sets of videos (FVD, Unterthiner et al. 2018).

Both sets are taken as Gaussian:

    |mu_a - mu_b|^2 + tr(S_a + S_b - 2 (S_a S_b)^(1/2))

With S = X^T X of centered features X (n x d, divided by sqrt(n - 1)), the trace of the root is the
sum of the singular values of X_a X_b^T, so that no d x d matrix is made and few clips are no
numerical problem. They are a statistical one: the distance of small sets is biased upward.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float


def frechet_distance(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m d"]) -> float:
    """Return the Fréchet distance of two sets of features; NaN with fewer than two in a set."""
    if min(len(a), len(b)) < 2:
        return float("nan")
    gap = np.square(a.mean(axis=0) - b.mean(axis=0)).sum()
    left, right = _centered(a), _centered(b)
    shared = np.linalg.svd(left @ right.T, compute_uv=False).sum()
    distance = gap + np.square(left).sum() + np.square(right).sum() - 2 * shared
    return float(max(distance, 0.0))


def _centered(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    return (x - x.mean(axis=0)).astype(float) / np.sqrt(len(x) - 1)
