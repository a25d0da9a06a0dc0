"""Statistics of a LeRobot dataset (meta/stats.json), as `lerobot` 0.4.4 computes them.

Each episode has its own minimum, maximum, mean, standard deviation and quantiles. The dataset's
quantiles are their means, weighted by the number of frames; the other statistics are exact. Images
are sampled. Followed: `datasets/compute_stats.py`, which estimates the quantiles by histograms of
5000 bins; ours are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
"""Quantiles by name."""
SAMPLES, POWER = (100, 10_000), 0.75
"""Minimum and maximum number of sampled images of an episode, and the power of its length."""
SMALL_PX, SAMPLED_PX = 300, 150
"""Side from which images are sampled, and about the side to which, in pixels."""


def vector_statistics(values: Float[np.ndarray, "n d"]) -> dict[str, np.ndarray]:
    """Return the statistics of an episode's vectors, without NaN; NaN where there is no number."""
    figures = {name: np.full(values.shape[1], np.nan) for name in ("min", "max", "mean", "std")}
    figures |= {name: np.full(values.shape[1], np.nan) for name in QUANTILES}
    for number, column in enumerate(values.T):
        numbers = column[~np.isnan(column)]
        if len(numbers):
            figures["min"][number], figures["max"][number] = numbers.min(), numbers.max()
            figures["mean"][number], figures["std"][number] = numbers.mean(), numbers.std()
            for name, value in zip(
                QUANTILES, np.quantile(numbers, [*QUANTILES.values()]), strict=True
            ):
                figures[name][number] = value
    return {**figures, "count": np.array([len(values)])}


def levels(image: UInt8[np.ndarray, "h w 3"]) -> Int[np.ndarray, "3 256"]:
    """Return how many pixels of an image have each value, by channel; large images are sampled."""
    height, width = image.shape[:2]
    step = max(height, width) // SAMPLED_PX if max(height, width) >= SMALL_PX else 1
    pixels = image[::step, ::step].reshape(-1, 3)
    return np.stack([np.bincount(channel, minlength=256) for channel in pixels.T])


def image_statistics(images: Sequence[Int[np.ndarray, "3 256"]]) -> dict[str, np.ndarray]:
    """Return the statistics of an episode's images from 0 to 1, from the `levels` of each image."""
    least, most = SAMPLES
    count = max(min(least, len(images)), min(int(len(images) ** POWER), most))
    chosen = np.round(np.linspace(0, len(images) - 1, count)).astype(int)
    counts = np.sum([images[n] for n in chosen.tolist()], axis=0)
    values, total = np.arange(256) / 255, counts.sum(axis=1)
    mean = counts @ values / total
    variance = np.maximum(counts @ values**2 / total - mean**2, 0)
    ranks = np.cumsum(counts, axis=1)
    at = {"min": 0.0, **QUANTILES, "max": 1.0}
    figures = {
        name: np.array([values[_rank(row, share)] for row in ranks]) for name, share in at.items()
    }
    figures |= {"mean": mean, "std": np.sqrt(variance)}
    return {name: value.reshape(3, 1, 1) for name, value in figures.items()} | {
        "count": np.array([count])
    }


def _rank(ranks: Int[np.ndarray, " v"], share: float) -> int:
    """Return the index of the value below which a share of the pixels is."""
    return int(np.searchsorted(ranks, max(share * ranks[-1], 1)))


def aggregate(episodes: Sequence[dict[str, np.ndarray]]) -> dict[str, Any]:
    """Return the statistics of a dataset from its episodes, as JSON."""
    stacked = {name: np.stack([e[name] for e in episodes]) for name in episodes[0]}
    counts = stacked.pop("count")
    mean, deviation = stacked.pop("mean"), stacked.pop("std")
    weights = counts.reshape(-1, *[1] * (mean.ndim - 1)) * ~np.isnan(mean)
    total = np.where(weights.sum(axis=0) > 0, weights.sum(axis=0), np.nan)

    def average(values: np.ndarray) -> np.ndarray:
        return np.nansum(weights * np.nan_to_num(values), axis=0) / total

    center = average(mean)
    figures = {
        "min": np.fmin.reduce(stacked.pop("min")),
        "max": np.fmax.reduce(stacked.pop("max")),
        "mean": center,
        "std": np.sqrt(average(deviation**2 + (mean - center) ** 2)),
        **{name: average(values) for name, values in stacked.items()},
    }
    return {name: value.tolist() for name, value in figures.items()} | {
        "count": counts.sum(axis=0).tolist()
    }
