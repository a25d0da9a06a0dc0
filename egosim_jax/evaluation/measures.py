"""Measures of a table: each computes some columns together from a pair of videos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.windows import Window
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.evaluation.metrics.dreamsim import DEFINITION, DreamSim
from egosim_jax.evaluation.metrics.image import clip_psnr, color_drift, psnr, ssim
from egosim_jax.evaluation.metrics.report import DEFINITIONS
from egosim_jax.evaluation.registration import WHOLE, Edges

VERSION = 1
"""Version of all measures; a change invalidates cached scores."""


class Column(NamedTuple):
    """Heading, number format and direction of a measure."""

    heading: str
    form: str
    better: Literal["higher", "lower"]


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """Ground truth of a window, the reference of all methods."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """All frames of the window, including the first."""
    first: int
    """First frame that is compared."""
    window: Window
    """Clip and window."""
    crop: Edges = WHOLE
    """Part of the recorded image that the frames show."""

    @property
    def counted(self) -> UInt8[np.ndarray, "g h w 3"]:
        """Frames that are compared."""
        return self.frames[self.first :]


Scorer = Callable[[np.ndarray], Mapping[str, float]]
"""Function from a video, as long as the ground truth, to its values by key."""


@runtime_checkable
class Measure(Protocol):
    """Columns of a table that are computed together."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Headings by key."""
        ...

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definitions by key or keys."""
        ...

    def settings(self, window: Window) -> Any:
        """Return other inputs of the values, such as hashes of weights, for the cache key."""
        ...

    def against(self, truth: GroundTruth) -> Scorer:
        """Return a scorer for this ground truth, which is processed only once."""
        ...


@dataclass(frozen=True)
class Pixels:
    """PSNR in both papers' definitions, SSIM and color drift."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Headings by key."""
        return {
            "psnr": Column("PSNR dB", "{:.2f}", "higher"),
            "ssim": Column("SSIM", "{:.4f}", "higher"),
            "psnr_clip": Column("PSNR of the clip dB", "{:.2f}", "higher"),
            "color_drift": Column("color drift", "{:.2f}", "lower"),
        }

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definitions by key."""
        return {
            **{key: DEFINITIONS[key] for key in ("psnr", "ssim")},
            "psnr_clip": "dB; one mean squared error over all frames, pixels and channels of a "
            "clip, as torchmetrics computes PSNR and DWM reports it",
            "color_drift": "levels of 255; |mean RGB of the last frame - mean RGB of the ground "
            "truth there|, mean over channels",
        }

    def settings(self, window: Window) -> Any:
        """Return None: the values depend only on both videos."""

    def against(self, truth: GroundTruth) -> Scorer:
        """Return a function that computes all four measures."""

        def score(video: np.ndarray) -> Mapping[str, float]:
            pair = video[truth.first :], truth.counted
            frames = psnr(*pair)
            drift = color_drift(video[-1:], truth.frames[-1:])
            return {
                "psnr": float(frames.mean()),
                "ssim": float(ssim(*pair).mean()),
                "psnr_clip": clip_psnr(frames),
                "color_drift": float(np.abs(drift).mean()),
            }

        return score


@dataclass(frozen=True, eq=False)
class LpipsDistance:
    """LPIPS of one network."""

    network: lpips.Lpips
    """Loaded network."""
    name: Literal["alex", "vgg"] = "alex"
    """Name of the network."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Heading of the network's column."""
        heading = {"alex": "LPIPS-Alex", "vgg": "LPIPS-VGG"}[self.name]
        return {f"lpips_{self.name}": Column(heading, "{:.4f}", "lower")}

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definition of the network's column."""
        return {f"lpips_{self.name}": lpips.definition(self.name)}

    def settings(self, window: Window) -> Any:
        """Return the config, which includes the hash of the weights."""
        return self.network.config

    def against(self, truth: GroundTruth) -> Scorer:
        """Return a function that computes the mean distance over frames."""
        reference = lpips.Reference(self.network, truth.counted)
        return lambda video: {
            f"lpips_{self.name}": float(reference.distances(video[truth.first :]).mean())
        }


@dataclass(frozen=True, eq=False)
class DreamSimDistance:
    """DreamSim distance."""

    network: DreamSim
    """Loaded network."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Heading of the column."""
        return {"dreamsim": Column("DreamSim", "{:.4f}", "lower")}

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definition of the column."""
        return {"dreamsim": DEFINITION.format(self.network.size)}

    def settings(self, window: Window) -> Any:
        """Return the hashes of the weights."""
        return self.network.hashes

    def against(self, truth: GroundTruth) -> Scorer:
        """Return a function that computes the mean distance over frames."""
        reference = self.network.embed(truth.counted)

        def score(video: np.ndarray) -> Mapping[str, float]:
            found = self.network.embed(video[truth.first :])
            return {"dreamsim": float(self.network.distances(found, reference).mean())}

        return score


def standard() -> Sequence[Measure]:
    """Return the default measures: pixels and, if its package is installed, LPIPS (AlexNet)."""
    alex = lpips.load_if_installed("alex")
    return [Pixels()] if alex is None else [Pixels(), LpipsDistance(alex)]


def columns_of(measures: Sequence[Measure]) -> dict[str, Column]:
    """Return the columns of all measures."""
    return {key: column for measure in measures for key, column in measure.columns.items()}
