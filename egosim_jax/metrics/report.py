"""A table of methods: means and spreads over clips, split by split."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from egosim_jax.metrics.image import psnr, ssim

DEFINITIONS = {
    "psnr": "dB; uint8 RGB, per frame over all pixels and channels, at most 100; mean over frames",
    "ssim": "11x11 Gaussian window of sigma 1.5 within the frame, K1 0.01, K2 0.03; mean over "
    "windows, channels and frames",
    "spread": "standard deviation over clips (n - 1)",
}


@dataclass(frozen=True, kw_only=True)
class Score:
    """One method on one clip."""

    psnr: float
    """dB."""
    ssim: float


@dataclass(frozen=True, kw_only=True)
class Summary:
    """One method over the clips of one split."""

    clips: int
    psnr: float
    psnr_spread: float
    ssim: float
    ssim_spread: float


def score(video: UInt8[np.ndarray, "f h w 3"], truth: UInt8[np.ndarray, "f h w 3"]) -> Score:
    """PSNR and SSIM, each a mean over frames."""
    return Score(psnr=float(psnr(video, truth).mean()), ssim=float(ssim(video, truth).mean()))


def summarize(scores: Sequence[Score]) -> Summary:
    """Means over clips, and standard deviations (0 for a single clip)."""
    psnrs, ssims = [s.psnr for s in scores], [s.ssim for s in scores]
    return Summary(
        clips=len(scores),
        psnr=math.fsum(psnrs) / len(psnrs),
        psnr_spread=_deviation(psnrs),
        ssim=math.fsum(ssims) / len(ssims),
        ssim_spread=_deviation(ssims),
    )


def summarize_splits(
    clips: Sequence[tuple[str, Mapping[str, Score]]],
) -> dict[str, dict[str, Summary]]:
    """Sorted splits, and of each method its summary, from every clip's split and scores."""
    gathered: dict[str, dict[str, list[Score]]] = {}
    for split, scores in clips:
        for method, value in scores.items():
            gathered.setdefault(split, {}).setdefault(method, []).append(value)
    return {
        split: {method: summarize(values) for method, values in methods.items()}
        for split, methods in sorted(gathered.items())
    }


def _deviation(values: Sequence[float]) -> float:
    return float(np.std(values, ddof=1)) if len(values) > 1 else 0.0
