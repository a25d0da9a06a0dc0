"""Measures of a table: each computes some columns together from a pair of videos."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.windows import Window
from egosim_jax.evaluation.methods import WHOLE, Edges
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.evaluation.metrics.dreamsim import DEFINITION, DreamSim
from egosim_jax.evaluation.metrics.image import clip_psnr, color_drift, psnr, ssim
from egosim_jax.evaluation.metrics.report import DEFINITIONS
from egosim_jax.runtime.registry import Registry

VERSION = 1
"""Version of all measures; a change invalidates cached scores."""


class Column(NamedTuple):
    """Heading, number format, direction and definition of a measure."""

    heading: str
    form: str
    better: Literal["higher", "lower"]
    definition: str = ""


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


def _no_settings(_window: Window) -> None:
    """Return None: the values depend only on both videos."""


@dataclass(frozen=True, kw_only=True)
class Measure:
    """Columns of a table that are computed together."""

    name: str
    """Name of the measure, for the cache of scores."""
    columns: Mapping[str, Column]
    """Columns by key."""
    against: Callable[[GroundTruth], Scorer]
    """Function that makes a scorer for a ground truth, which is processed only once."""
    settings: Callable[[Window], Any] = _no_settings
    """Function that returns other inputs of the values, such as hashes of weights, for the cache.
    """


METRICS: Registry[Measure] = Registry("metric", "--metrics", "egosim_jax.metrics")
"""Measures of other packages, by name; each of our measures has its option."""


def pixels() -> Measure:
    """Return PSNR in both papers' definitions, SSIM and color drift."""

    def against(truth: GroundTruth) -> Scorer:
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

    columns = {
        "psnr": Column("PSNR dB", "{:.2f}", "higher", DEFINITIONS["psnr"]),
        "ssim": Column("SSIM", "{:.4f}", "higher", DEFINITIONS["ssim"]),
        "psnr_clip": Column(
            "PSNR of the clip dB",
            "{:.2f}",
            "higher",
            "dB; one mean squared error over all frames, pixels and channels of a clip, as "
            "torchmetrics computes PSNR and DWM reports it",
        ),
        "color_drift": Column(
            "color drift",
            "{:.2f}",
            "lower",
            "levels of 255; |mean RGB of the last frame - mean RGB of the ground truth there|, "
            "mean over channels",
        ),
    }
    return Measure(name="Pixels", columns=columns, against=against)


def lpips_distance(network: lpips.Lpips, name: Literal["alex", "vgg"] = "alex") -> Measure:
    """Return the mean LPIPS of one network over frames."""
    key, heading = f"lpips_{name}", {"alex": "LPIPS-Alex", "vgg": "LPIPS-VGG"}[name]

    def against(truth: GroundTruth) -> Scorer:
        reference = lpips.Reference(network, truth.counted)
        return lambda video: {key: float(reference.distances(video[truth.first :]).mean())}

    return Measure(
        name="LpipsDistance",
        columns={key: Column(heading, "{:.4f}", "lower", lpips.definition(name))},
        against=against,
        settings=lambda _: network.config,  # has the hash of the weights
    )


def dreamsim_distance(network: DreamSim) -> Measure:
    """Return the mean DreamSim distance over frames."""

    def against(truth: GroundTruth) -> Scorer:
        reference = network.embed(truth.counted)

        def score(video: np.ndarray) -> Mapping[str, float]:
            embedded = network.embed(video[truth.first :])
            return {"dreamsim": float(network.distances(embedded, reference).mean())}

        return score

    return Measure(
        name="DreamSimDistance",
        columns={"dreamsim": Column("DreamSim", "{:.4f}", "lower", DEFINITION)},
        against=against,
        settings=lambda _: network.hashes,
    )


def standard() -> Sequence[Measure]:
    """Return the default measures: pixels and, if its package is installed, LPIPS (AlexNet)."""
    alex = lpips.load_if_installed("alex")
    return [pixels()] if alex is None else [pixels(), lpips_distance(alex)]


def columns_of(measures: Sequence[Measure]) -> dict[str, Column]:
    """Return the columns of all measures."""
    return {key: column for measure in measures for key, column in measure.columns.items()}
