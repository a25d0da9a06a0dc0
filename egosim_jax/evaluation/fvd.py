"""Fréchet video distance (FVD, Unterthiner et al. 2018) of each method and group.

The features of both sets of videos, by a given network, are modeled as Gaussians:

    |mu_a - mu_b|^2 + tr(S_a + S_b - 2 (S_a S_b)^(1/2))

With S = X^T X of centered features X (n x d, divided by sqrt(n - 1)), the trace of the root is the
sum of the singular values of X_a X_b^T. This needs no d x d matrix and is numerically stable for
few clips. It is still biased upward for small sets.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from egosim_jax.data.windows import Window
from egosim_jax.evaluation.measures import Column, GroundTruth, Scorer
from egosim_jax.perception.networks.video_mae import VideoMae

COLUMN = Column("FVD (VideoMAE)", "{:.2f}", "lower")
DEFINITION = (
    "Fréchet distance between the features of a group's videos and of their ground truth by the "
    "given VideoMAE: not comparable with the I3D of other papers, and biased upward for few clips"
)
_VIDEO, _TARGET = "fvd_video", "fvd_target"


@dataclass(frozen=True, eq=False)
class Features:
    """Features of each video and its ground truth, from which `fvd` is computed per group."""

    network: VideoMae
    """Feature network."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Headings by key."""
        return {"fvd": COLUMN}

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definitions by key."""
        return {"fvd": DEFINITION}

    def settings(self, window: Window) -> Any:
        """Return the network, whose fingerprint is the hash of its files."""
        return self.network

    def against(self, truth: GroundTruth) -> Scorer:
        """Return a function that computes the features of both videos."""
        target = self.network(truth.counted)

        def score(video: np.ndarray) -> Mapping[str, float]:
            found = self.network(video[truth.first :])
            return {
                f"{name}.{place}": float(value)
                for name, vector in ((_VIDEO, found), (_TARGET, target))
                for place, value in enumerate(vector)
            }

        return score


def is_feature(key: str) -> bool:
    """Return True for the key of a feature: it is not a score."""
    return key.startswith((f"{_VIDEO}.", f"{_TARGET}."))


def distance_of(scores: list[Mapping[str, float]]) -> float | None:
    """Return the FVD of a method's clips from their features; None without features."""
    found = [_vector(one, _VIDEO) for one in scores]
    targets = [_vector(one, _TARGET) for one in scores]
    if not found or not all(len(vector) for vector in found):
        return None
    return frechet_distance(np.stack(found), np.stack(targets))


def frechet_distance(a: Float[np.ndarray, "n d"], b: Float[np.ndarray, "m d"]) -> float:
    """Return the Fréchet distance of two sets of features; NaN if a set has fewer than two."""
    if min(len(a), len(b)) < 2:
        return float("nan")
    gap = np.square(a.mean(axis=0) - b.mean(axis=0)).sum()
    left, right = _centered(a), _centered(b)
    shared = np.linalg.svd(left @ right.T, compute_uv=False).sum()
    distance = gap + np.square(left).sum() + np.square(right).sum() - 2 * shared
    return float(max(distance, 0.0))


def _centered(x: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n d"]:
    return (x - x.mean(axis=0)).astype(float) / np.sqrt(len(x) - 1)


def _vector(scores: Mapping[str, float], name: str) -> np.ndarray:
    return np.array([value for key, value in scores.items() if key.startswith(f"{name}.")])
