"""Fréchet video distance (FVD, Unterthiner et al. 2018) of each method and group.

The features of both sets of videos, by a given network, are modeled as Gaussians:

    |mu_a - mu_b|^2 + tr(S_a + S_b - 2 (S_a S_b)^(1/2))

With S = X^T X of centered features X (n x d, divided by sqrt(n - 1)), the trace of the root is the
sum of the singular values of X_a X_b^T. This needs no d x d matrix and is numerically stable for
few clips. It is still biased upward for small sets.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from egosim_jax.evaluation.measures import Column, GroundTruth, Measure, Scorer
from egosim_jax.perception.networks.video_mae import VideoMae

COLUMN = Column(
    "FVD (VideoMAE)",
    "{:.2f}",
    "lower",
    "Fréchet distance between the features of a group's videos and of their ground truth by the "
    "given VideoMAE: not comparable with the I3D of other papers, and biased upward for few clips",
)
_VIDEO, _TARGET = "fvd_video", "fvd_target"


def features(network: VideoMae) -> Measure:
    """Return the features of each video and its ground truth: `distance_of` has their distance."""

    def against(truth: GroundTruth) -> Scorer:
        target = network(truth.counted)
        return lambda video: {
            f"{name}.{place}": float(value)
            for name, vector in ((_VIDEO, network(video[truth.first :])), (_TARGET, target))
            for place, value in enumerate(vector)
        }

    # The fingerprint of the network is the hash of its files.
    return Measure(
        name="Features", columns={"fvd": COLUMN}, against=against, settings=lambda _: network
    )


def is_feature(key: str) -> bool:
    """Return True for the key of a feature: it is not a score."""
    return key.startswith((f"{_VIDEO}.", f"{_TARGET}."))


def distance_of(scores: list[Mapping[str, float]]) -> float | None:
    """Return the FVD of a method's clips from their features; None without features."""
    videos = [_vector(one, _VIDEO) for one in scores]
    targets = [_vector(one, _TARGET) for one in scores]
    if not videos or not all(len(vector) for vector in videos):
        return None
    return frechet_distance(np.stack(videos), np.stack(targets))


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
