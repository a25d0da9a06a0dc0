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

    The mean of no values is NaN, and so is the deviation of fewer than two values.
    """
    finite = [value for value in values if np.isfinite(value)]
    mean = float(np.mean(finite)) if finite else float("nan")
    return mean, float(np.std(finite, ddof=1)) if len(finite) > 1 else float("nan")


def summarize(
    scores: Sequence[Mapping[str, float]], measures: Iterable[str]
) -> dict[str, dict[str, float]]:
    """Return mean and spread over scores of each measure that any score has.

    A single value has no spread. If some scores are not finite, `known` counts the finite ones and
    `of` counts all: the mean alone would hide failures.
    """
    summary = {}
    for name in measures:
        if not any(name in score for score in scores):
            continue
        values = [score.get(name, float("nan")) for score in scores]
        mean, spread = mean_and_spread(values)
        valid = int(np.isfinite(values).sum())
        counts = {} if valid == len(values) else {"known": valid, "of": len(values)}
        spreads = {"spread": spread} if valid > 1 else {}
        summary[name] = {"mean": mean, **spreads, **counts}
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


def paired_difference(values: Sequence[float], reference: Sequence[float]) -> dict[str, float]:
    """Return the mean of `values - reference` over pairs and its 95 % confidence interval.

    The interval is Student's: mean ± t s / sqrt(n). A bootstrap of so few pairs is too narrow: at
    n = 5, its 95 % interval has the true mean in 84 % of the cases, Student's in 95 % (normal
    differences) or 88 % (exponential ones). Pairs with NaN are ignored, and then counted by `known`
    and `of`. Fewer than two pairs have no interval.
    """
    from scipy.special import stdtrit

    pairs = np.subtract(values, reference)
    valid = pairs[~np.isnan(pairs)]
    counts = {} if len(valid) == len(pairs) else {"known": len(valid), "of": len(pairs)}
    mean, spread = mean_and_spread(valid)
    if len(valid) < 2:
        return {"mean": mean, **counts}
    half = float(stdtrit(len(valid) - 1, 0.975)) * spread / len(valid) ** 0.5
    return {"mean": mean, "low": mean - half, "high": mean + half, **counts}


def print_table(
    corner: str,
    rows: Mapping[str, Summary],
    measures: Measures,
    *,
    title: str | None = None,
    caption: str | None = None,
) -> None:
    """Print a row for each summary as mean ± spread; `corner` is the heading of the row names.

    The cell of a missing measure is empty. A cell may also have `spread_over_seeds` in parentheses,
    an interval from `low` to `high` in brackets, and the number of `known` values if some are
    missing.
    """
    from rich.table import Table

    from egosim_jax.runtime.terminal import make_console

    table = Table(
        corner, *(heading for heading, _ in measures.values()), title=title, caption=caption
    )
    for row, summary in rows.items():
        cells = (cell_of(summary.get(name, {}), form) for name, (_, form) in measures.items())
        table.add_row(row, *cells)
    table.columns[0].overflow = "fold"  # a name is never cut
    make_console(width=1000).print(table)


def cell_of(value: Mapping[str, float], form: str) -> str:
    """Return a cell of a table, for instance "0.25 ± 0.04 (3 of 5)"."""
    if np.isnan(value.get("mean", 0.0)):
        return f"no clips (0 of {value['of']})" if value.get("known") == 0 else "undefined"
    shown = (value[key] for key in ("mean", "spread") if np.isfinite(value.get(key, np.nan)))
    text = " ± ".join(form.format(number) for number in shown)
    if np.isfinite(value.get("low", np.nan)):
        text = f"{text} [{form.format(value['low'])}, {form.format(value['high'])}]"
    if np.isfinite(value.get("spread_over_seeds", np.nan)):
        text = f"{text} (± {form.format(value['spread_over_seeds'])})"
    return f"{text} ({value['known']} of {value['of']})" if "known" in value else text
