"""Scores of videos, their means, spreads and paired differences, and printed tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import UInt8

from egosim_jax.evaluation.metrics.image import psnr, ssim

DEFINITIONS = {
    "psnr": "dB; uint8 RGB, per frame over all pixels and channels, at most 100; mean over frames",
    "ssim": "11x11 Gaussian window of sigma 1.5 within the frame, K1 0.01, K2 0.03; mean over "
    "windows, channels and frames",
    "spread": "standard deviation over clips (n - 1)",
}

Measures = Mapping[str, tuple[str, str]]
"""Column title and number format of each measure, by name."""
Summary = Mapping[str, Mapping[str, float]]
"""`mean` and `spread` of each measure, by name; a measure without repetitions has no `spread`.

If scores are missing, `known` of `of` scores are valid."""


def score(
    video: UInt8[np.ndarray, "f h w 3"], target: UInt8[np.ndarray, "f h w 3"]
) -> dict[str, float]:
    """Return PSNR in dB and SSIM of a video, each a mean over frames."""
    return {"psnr": float(psnr(video, target).mean()), "ssim": float(ssim(video, target).mean())}


def mean_and_spread(values: Iterable[float]) -> tuple[float, float]:
    """Return mean and standard deviation (n - 1) of the finite values.

    The mean of no values is NaN; the deviation of fewer than two values is 0.
    """
    known = [value for value in values if np.isfinite(value)]
    mean = float(np.mean(known)) if known else float("nan")
    return mean, float(np.std(known, ddof=1)) if len(known) > 1 else 0.0


def summarize(
    scores: Sequence[Mapping[str, float]], measures: Iterable[str]
) -> dict[str, dict[str, float]]:
    """Return mean and spread over scores of each measure that any score has.

    If some scores are not finite, `known` counts the finite ones and `of` counts all: the mean
    alone would hide failures.
    """
    summary = {}
    for name in measures:
        if not any(name in score for score in scores):
            continue
        values = [score.get(name, float("nan")) for score in scores]
        mean, spread = mean_and_spread(values)
        known = int(np.isfinite(values).sum())
        counts = {} if known == len(values) else {"known": known, "of": len(values)}
        summary[name] = {"mean": mean, "spread": spread, **counts}
    return summary


def paired_differences(
    scores: Sequence[Mapping[str, float]],
    reference: Sequence[Mapping[str, float]],
    measures: Iterable[str],
) -> dict[str, dict[str, float]]:
    """Return the paired difference of each measure between two methods on the same scenes."""
    return {
        measure: paired_difference(
            [found[measure] for found in scores], [found[measure] for found in reference]
        )
        for measure in measures
    }


def paired_difference(
    values: Sequence[float],
    reference: Sequence[float],
    level: float = 0.95,
    *,
    resamples: int = 10_000,
) -> dict[str, float]:
    """Return the mean of `values - reference` over pairs and its bootstrap confidence interval.

    The bootstrap resamples pairs with a fixed seed; the interval is between percentiles of their
    means. Pairs with NaN are ignored, and then counted by `known` and `of`. Fewer than two pairs
    have an infinite interval. Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993,
    section 13.3.
    """
    pairs = np.subtract(values, reference)
    known = pairs[~np.isnan(pairs)]
    counts = {} if len(known) == len(pairs) else {"known": len(known), "of": len(pairs)}
    if len(known) < 2:
        mean = float(known.mean()) if len(known) else float("nan")
        return {"mean": mean, "low": -np.inf, "high": np.inf, **counts}
    draws = np.random.default_rng(0).integers(len(known), size=(resamples, len(known)))
    low, high = np.quantile(known[draws].mean(axis=1), [(1 - level) / 2, (1 + level) / 2])
    return {"mean": float(known.mean()), "low": float(low), "high": float(high), **counts}


def print_table(
    corner: str, rows: Mapping[str, Summary], measures: Measures, *, title: str | None = None
) -> None:
    """Print a row for each summary as mean ± spread; `corner` is the heading of the row names.

    The cell of a missing measure is empty. A cell may also have `spread_over_seeds` in parentheses,
    an interval from `low` to `high` in brackets, and the number of `known` values if some are
    missing.
    """
    from rich.table import Table

    from egosim_jax.runtime.terminal import make_console

    table = Table(corner, *(heading for heading, _ in measures.values()), title=title)
    for row, summary in rows.items():
        cells = (cell_of(summary.get(name, {}), form) for name, (_, form) in measures.items())
        table.add_row(row, *cells)
    make_console(width=160).print(table)


def cell_of(value: Mapping[str, float], form: str) -> str:
    """Return a cell of a table, for instance "0.25 ± 0.04 (3 of 5)"."""
    text = " ± ".join(form.format(value[key]) for key in ("mean", "spread") if key in value)
    if "low" in value:
        text = f"{text} [{form.format(value['low'])}, {form.format(value['high'])}]"
    if "spread_over_seeds" in value:
        text = f"{text} (± {form.format(value['spread_over_seeds'])})"
    return f"{text} ({value['known']} of {value['of']})" if "known" in value else text
