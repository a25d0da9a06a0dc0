"""Fréchet video distance of each method and group, by the features of a given network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from egosim_jax.data.windows import Window
from egosim_jax.evaluation.measures import Column, GroundTruth, Scorer
from egosim_jax.evaluation.metrics.frechet import frechet_distance
from egosim_jax.perception.networks.video_mae import VideoMae

COLUMN = Column("FVD (VideoMAE)", "{:.2f}", "lower")
DEFINITION = (
    "Fréchet distance between the features of a group's videos and of their ground truth by the "
    "given VideoMAE: not comparable with the I3D of other papers, and biased upward for few clips"
)
_VIDEO, _TARGET = "fvd_video", "fvd_target"


@dataclass(frozen=True, eq=False)
class Features:
    """Features of each video and of its ground truth; they are no scores but make `fvd`."""

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
        """Return the network, which counts by the hash of its files."""
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
    """Return True for the key of a feature, which is not a score of a clip."""
    return key.startswith((f"{_VIDEO}.", f"{_TARGET}."))


def distance_of(scores: list[Mapping[str, float]]) -> float | None:
    """Return the distance of a method's clips, given their features; None without features."""
    found = [_vector(one, _VIDEO) for one in scores]
    targets = [_vector(one, _TARGET) for one in scores]
    if not found or not all(len(vector) for vector in found):
        return None
    return frechet_distance(np.stack(found), np.stack(targets))


def _vector(scores: Mapping[str, float], name: str) -> np.ndarray:
    return np.array([value for key, value in scores.items() if key.startswith(f"{name}.")])
