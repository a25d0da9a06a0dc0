"""Measures of a table: groups of columns that are computed together from a pair of videos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from egosim_jax.metrics import lpips
from egosim_jax.metrics.image import clip_psnr, color_drift, psnr, ssim
from egosim_jax.metrics.report import DEFINITIONS

VERSION = 1
"""Version of all measures; another one makes cached scores invalid."""


class Column(NamedTuple):
    """Heading, number format and direction of a measure."""

    heading: str
    form: str
    better: Literal["higher", "lower"]


class Pair(NamedTuple):
    """Videos that are compared."""

    video: UInt8[np.ndarray, "f h w 3"]
    """Frames of a method that count."""
    target: UInt8[np.ndarray, "f h w 3"]
    """Ground truth of the same frames."""


@runtime_checkable
class Measure(Protocol):
    """Columns of a table that are computed together."""

    columns: Mapping[str, Column]
    """Headings by key."""
    definitions: Mapping[str, str]
    """Definitions by key or keys."""

    def settings(self) -> Any:
        """Return what else the values depend on, such as the hash of weights."""
        ...

    def __call__(self, pair: Pair) -> Mapping[str, float]:
        """Return the values of one clip by key."""
        ...


@dataclass(frozen=True)
class Pixels:
    """PSNR in both papers' definitions, SSIM and color drift."""

    columns: ClassVar[Mapping[str, Column]] = {
        "psnr": Column("PSNR dB", "{:.2f}", "higher"),
        "ssim": Column("SSIM", "{:.4f}", "higher"),
        "psnr_clip": Column("PSNR of the clip dB", "{:.2f}", "higher"),
        "color_drift": Column("color drift", "{:.2f}", "lower"),
    }
    definitions: ClassVar[Mapping[str, str]] = {
        **{key: DEFINITIONS[key] for key in ("psnr", "ssim")},
        "psnr_clip": "dB; one mean squared error over all frames, pixels and channels of a clip, "
        "as torchmetrics computes PSNR and DWM reports it",
        "color_drift": "levels of 255; |mean RGB of the last frame - that of the ground truth|, "
        "mean over channels",
    }

    def settings(self) -> Any:
        """Return nothing."""

    def __call__(self, pair: Pair) -> Mapping[str, float]:
        """Return all four."""
        frames = psnr(*pair)
        drift = color_drift(pair.video[-1:], pair.target[-1:])
        return {
            "psnr": float(frames.mean()),
            "ssim": float(ssim(*pair).mean()),
            "psnr_clip": clip_psnr(frames),
            "color_drift": float(np.abs(drift).mean()),
        }


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

    def settings(self) -> Any:
        """Return the config, which has the hash of the weights."""
        return self.network.config

    def __call__(self, pair: Pair) -> Mapping[str, float]:
        """Return the mean distance over frames."""
        distances = lpips.frame_distances(self.network, *pair)
        return {f"lpips_{self.name}": float(distances.mean())}


def standard() -> Sequence[Measure]:
    """Return PSNR, SSIM and, if its package is installed, LPIPS with AlexNet."""
    alex = lpips.load_if_installed("alex")
    return [Pixels()] if alex is None else [Pixels(), LpipsDistance(alex)]


def columns_of(measures: Sequence[Measure]) -> dict[str, Column]:
    """Return the columns of all measures."""
    return {key: column for measure in measures for key, column in measure.columns.items()}
