"""Results of the experiments: scores by method, report, tables, plots, and cached values."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from egosim_jax.evaluation.metrics.report import (
    Measures,
    Summary,
    paired_differences,
    print_table,
    summarize,
)
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import read_json
from egosim_jax.io.run import write_json
from egosim_jax.runtime.progress import track

Scores = Sequence[Mapping[str, float]]
"""Scores of the scenes, or of the clips of a sequence."""
Table = dict[str, dict[str, dict[str, float]]]
"""Summary of each method, by name."""


def summaries(scores: Mapping[str, Scores], measures: Iterable[str]) -> Table:
    """Return the means and spreads of each method."""
    return {name: summarize(values, measures) for name, values in scores.items()}


def differences(
    scores: Mapping[str, Scores],
    reference: str,
    measures: Iterable[str],
    *,
    minus: Literal["reference", "row"] = "reference",
) -> Table:
    """Return the paired differences of each row and a reference, for the reference's measures."""
    start = scores[reference]
    shared = [measure for measure in measures if measure in start[0]]
    pairs = {
        name: (values, start) if minus == "reference" else (start, values)
        for name, values in scores.items()
        if name != reference
    }
    return {name: paired_differences(*pair, shared) for name, pair in pairs.items()}


def over_seeds(runs: Sequence[Scores], measures: Iterable[str]) -> list[dict[str, float]]:
    """Return the scores of each scene, averaged over seeds."""
    return [_means(scores, measures) for scores in zip(*runs, strict=True)]


def summarize_runs(runs: Sequence[Scores], measures: Iterable[str]) -> dict[str, dict[str, float]]:
    """Return mean and spreads of each measure; `runs` has the scores of all scenes for each seed.

    NaN, the score of a scene with nothing to measure, is ignored.
    """
    seeds = summarize([_means(scores, measures) for scores in runs], measures)
    table = summarize(over_seeds(runs, measures), measures)
    for name, summary in table.items():
        if "spread" in seeds[name]:
            summary["spread_over_seeds"] = seeds[name]["spread"]
    return table


def _means(scores: Scores, measures: Iterable[str]) -> dict[str, float]:
    return {name: summary["mean"] for name, summary in summarize(scores, measures).items()}


def show(title: str | None, rows: Mapping[str, Summary], measures: Measures) -> None:
    """Print a table of methods."""
    print_table("", rows, measures, title=title)


def show_by_clip(title: str, rows: Sequence[Summary], measures: Measures) -> None:
    """Print a table with a row for each clip of a sequence."""
    numbered = {str(number): row for number, row in enumerate(rows, start=1)}
    print_table("clip", numbered, measures, title=title)


def write_report(out: Path, **content: Any) -> None:
    """Write report.json."""
    write_json(out / "report.json", content)


@contextmanager
def plot(path: Path, width: int | float, height: int | float) -> Iterator[Figure]:
    """Give a figure, with a size in inches, and write it."""
    matplotlib.use("agg")
    figure = Figure(figsize=(width, height), layout="constrained")
    yield figure
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)


def cached(path: Path, make: Callable[[], Any]) -> Any:
    """Return the JSON value of a file, made and written if the file is missing."""
    if not path.exists():
        write_json(path, make())
    return read_json(path)


def cached_videos(
    path: Path, make: Callable[[], Iterable[np.ndarray]], *, total: int
) -> list[np.ndarray]:
    """Load the videos of a method from an .npy file, or make and save them."""
    if not path.exists():
        videos = list(track(make(), f"generating {path.stem}", total=total))
        with atomic_write(path) as temporary:
            np.save(temporary, np.stack(videos))
    return list(np.load(path))
