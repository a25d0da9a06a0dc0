"""Means and spreads of measures, for reports and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

Measures = Mapping[str, tuple[str, str]]
"""By name: what a table calls it, and its format."""
Line = Mapping[str, Mapping[str, float]]
"""Mean and spread of each measure; what was measured once has no spread."""


def mean_and_spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean and standard deviation (n - 1) of values; NaN, where nothing was measured, not counted.

    The mean of nothing is NaN, the deviation of fewer than two values 0.
    """
    import numpy as np

    known = [value for value in values if not np.isnan(value)]
    mean = float(np.mean(known)) if known else float("nan")
    return mean, float(np.std(known, ddof=1)) if len(known) > 1 else 0.0


def summarize(found: Sequence[Mapping[str, float]], measures: Measures) -> Line:
    """Mean and spread of each measure."""
    line = {}
    for name in measures:
        mean, spread = mean_and_spread([one[name] for one in found])
        line[name] = {"mean": mean, "spread": spread}
    return line


def print_table(
    first: str, rows: Mapping[str, Line], measures: Measures, *, title: str | None = None
) -> None:
    """Print a row for each line, mean ± spread; `first` heads the column of their names.

    What a line has not measured stays empty.
    """
    from rich.console import Console
    from rich.table import Table

    shown = Table(first, *(name for name, _ in measures.values()), title=title)
    for row, line in rows.items():
        cells = (_cell(line.get(name, {}), form) for name, (_, form) in measures.items())
        shown.add_row(row, *cells)
    Console(width=140).print(shown)


def _cell(value: Mapping[str, float], form: str) -> str:
    return " ± ".join(form.format(value[key]) for key in ("mean", "spread") if key in value)
