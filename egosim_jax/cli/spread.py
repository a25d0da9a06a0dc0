"""Means and spreads of measures, for reports and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

Measures = Mapping[str, tuple[str, str]]
"""By name: what a table calls it, and its format."""
Line = Mapping[str, Mapping[str, float]]
"""Mean and spread of each measure."""


def summarise(found: Sequence[Mapping[str, float]], measures: Measures) -> Line:
    """Mean of each measure and its standard deviation (n - 1); NaN does not count."""
    import numpy as np

    line = {}
    for name in measures:
        values = np.array([one[name] for one in found], float)
        spread = float(np.nanstd(values, ddof=1)) if len(values) > 1 else 0.0
        line[name] = {"mean": float(np.nanmean(values)), "spread": spread}
    return line


def print_table(
    first: str, rows: Mapping[str, Line], measures: Measures, *, title: str | None = None
) -> None:
    """Print a row for each line, mean ± spread; `first` heads the column of their names."""
    from rich.console import Console
    from rich.table import Table

    shown = Table(first, *(name for name, _ in measures.values()), title=title)
    for row, line in rows.items():
        cells = []
        for name, (_, form) in measures.items():
            mean, spread = (form.format(line[name][key]) for key in ("mean", "spread"))
            cells.append(f"{mean} ± {spread}")
        shown.add_row(row, *cells)
    Console(width=140).print(shown)
