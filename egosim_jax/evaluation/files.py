"""Files of an evaluation: JSON, CSV, LaTeX, and an image of the scores.

metrics.jsonl   one line per clip, with the scores of each method
report.json     definitions, protocol, summaries, paired differences, published figures
scores.csv      one row per clip and method, with the compared frames and sizes
table.tex       a LaTeX table of each group
scores.png      means and spreads of each group and column
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from egosim_jax.evaluation.metrics.report import cell_of
from egosim_jax.evaluation.result import Evaluation
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import plot_text
from egosim_jax.io.run import write_json, write_text
from egosim_jax.runtime.terminal import printable

_LATEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "±": r"$\pm$",
}  # fmt: skip
_FORMULAS = ("=", "+", "-", "@", "\uff1d", "\uff0b", "\uff0d", "\uff20")
"""Beginnings of formulas, also in full width."""
MAX_DRAWN = 40
"""Maximum number of groups, and of methods, in the image."""
ARROWS = {"higher": "↑", "lower": "↓"}
"""Arrow for the better direction of a measure."""


def write_files(evaluation: Evaluation, out: Path) -> None:
    """Write all files of an evaluation except the image."""
    lines: dict[str, dict] = {}
    for row in evaluation.rows:
        window = row.window
        line = {"video_id": window.output_id, "split": window.split}
        scores = {key: finite(row.scores[key]) for key in evaluation.measured if key in row.scores}
        lines.setdefault(window.output_id, line)[row.method] = scores
    text = "".join(f"{json.dumps(line)}\n" for line in lines.values())
    write_text(out / "metrics.jsonl", text)
    write_json(out / "report.json", finite(evaluation.report))
    write_text(out / "scores.csv", to_csv(evaluation))
    write_text(out / "table.tex", to_latex(evaluation))


def finite(value: Any) -> Any:
    """Return a value for JSON, with null for NaN and infinity."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_csv(evaluation: Evaluation) -> str:
    """Return CSV with a row per clip and method."""
    buffer = io.StringIO()
    table = csv.writer(buffer, lineterminator="\n")
    table.writerow(
        [
            "video_id", "source_id", evaluation.group, "method", "first_frame", "frames_scored",
            "width", "height", "source", *evaluation.measured,
        ]
    )  # fmt: skip
    first = evaluation.protocol.first
    for row in evaluation.rows:
        table.writerow(
            [
                *map(cell, (row.window.output_id, row.window.files.video_id)),
                *map(cell, (evaluation.group_of(row), row.method)),
                row.window.start + first,
                row.shape.frames - first,
                row.shape.width,
                row.shape.height,
                cell(row.source),
                *(repr(row.scores[k]) if k in row.scores else "" for k in evaluation.measured),
            ]
        )
    return buffer.getvalue()


def cell(text: str) -> str:
    """Return a text for CSV that a spreadsheet does not read as a formula."""
    if not text.strip().startswith(_FORMULAS) and text[:1] not in ("\t", "\r", "\n"):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def to_latex(evaluation: Evaluation) -> str:
    """Return a LaTeX table of each group, with the protocol in its caption."""
    tables = []
    for group in evaluation.summaries():
        headings = evaluation.headings(group)
        heads = [f"{escape(c.heading)} ${_arrow(c.better)}$" for c in headings.values()]
        rows = [
            " & ".join(
                [escape(title)]
                + [escape(cell_of(row.get(key, {}), c.form)) for key, c in headings.items()]
            )
            for title, row in evaluation.table(group).items()
        ]
        body = " \\\\\n".join([" & ".join(["method", *heads]), *rows])
        caption = f"{evaluation.caption(group)}, mean ± spread. {' '.join(evaluation.notes()[:2])}"
        tables.append(
            "\\begin{table}\n\\centering\n"
            f"\\begin{{tabular}}{{l{'r' * len(headings)}}}\n\\hline\n{body} \\\\\n\\hline\n"
            f"\\end{{tabular}}\n\\caption{{{escape(caption)}}}\n\\end{{table}}\n"
        )
    return "\n".join(tables)


def _arrow(better: str) -> str:
    return r"\uparrow" if better == "higher" else r"\downarrow"


def escape(text: str) -> str:
    """Return text with LaTeX's special characters escaped."""
    return "".join(_LATEX.get(letter, letter) for letter in printable(text).replace("\n", " "))


def draw(evaluation: Evaluation, path: Path) -> None:
    """Draw means and spreads: a row of plots for each group, a column for each measure."""
    matplotlib.use("agg")
    groups = list(evaluation.summaries())[:MAX_DRAWN]
    shown = [key for key in evaluation.shown if key in evaluation.measured]
    tables = {g: dict(islice(evaluation.table(g).items(), MAX_DRAWN)) for g in groups}
    count = max(map(len, tables.values()))
    size = (4.2 * len(shown) + 2, (0.34 * count + 1.0) * len(groups))
    figure = Figure(figsize=size, layout="constrained")
    plots = figure.subplots(len(groups), len(shown), squeeze=False, sharey="row")
    for group, row in zip(groups, plots, strict=True):
        table = tables[group]
        for key, axes in zip(shown, row, strict=True):
            column = evaluation.columns[key]
            for place, (title, summary) in enumerate(table.items()):
                if key in summary:
                    value, published = summary[key], title.endswith("(published)")
                    axes.errorbar(
                        value["mean"],
                        place,
                        xerr=value.get("spread"),
                        fmt="s" if published else "o",
                        color="tab:gray" if published else "tab:blue",
                        capsize=3,
                    )
            axes.set_yticks(range(len(table)), list(map(plot_text, table)))
            axes.set_ylim(len(table) - 0.5, -0.5)
            title = f"{plot_text(evaluation.groups.get(group, group))}: {column.heading}"
            axes.set_title(f"{title} {ARROWS[column.better]}", fontsize=9)
            axes.grid(axis="x", alpha=0.3)
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)
