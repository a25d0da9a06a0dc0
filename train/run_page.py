"""The page of a training run: loss curves, sample clips, times and settings in one HTML file.

It depends only on the files in the run folder, so you can write it at any time, also while the run
continues. The page loads nothing: curves, images and video are inline data, and its content
security policy allows nothing else. Every text is escaped.
"""

from __future__ import annotations

import base64
import io
import math
import re
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape
from itertools import islice
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from egosim_jax.io.bounded import (
    own_file,
    plot_text,
    quote,
    quote_text,
    read_bytes,
    read_json,
    read_lines,
)
from egosim_jax.io.images import decode_image
from egosim_jax.io.run import CONFIG, ENVIRONMENT, write_text
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError

PAGE, METRICS, TIMES = "index.html", "metrics.jsonl", "times.json"
VALIDATION = "validation_"
"""Prefix of the names of validation metrics."""
SPEED = (
    "step_time_s", "data_wait_frac", "tflops", "mfu", "peak_mem_gb", "eta_min",
)  # fmt: skip
"""Metrics of speed: they are in the table of the last values, and have no curve."""
COLORS = {"training": "tab:blue", "validation": "tab:orange"}
MAX_POINTS = 1000
"""Maximum number of points of a curve; longer curves show means of consecutive values."""
MAX_SHEETS, SHEET_PX, JPEG_QUALITY = 8, 1200, 85
"""Maximum number of contact sheets, evenly spaced in time; their width; their JPEG quality."""
MAX_CLIP_BYTES, MAX_SHEET_BYTES = 1 << 24, 1 << 27
"""Maximum size of a sample video, which the page omits beyond it, and of a contact sheet."""
MAX_METRICS_BYTES, MAX_STEP, MAX_VALUE = 1 << 27, 1 << 53, 1e100
"""Maximum size of metrics.jsonl, number of a step, and absolute value in a curve."""
MAX_PLOTS, MAX_CURVES, MAX_LABEL = 60, 12, 12
"""Maximum number of plots and of curves of a plot, and length of their labels."""
MAX_ROWS, MAX_CELL, MAX_DEPTH = 2000, 1000, 32
"""Maximum number of rows of a table, length of a cell, and depth of a value."""
_HEAD = """<!doctype html>
<html lang="en"><head><meta charset="utf-8">
<meta http-equiv="Content-Security-Policy"
 content="default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 1200px;
 padding: 0 1rem; color: #1b1f24 }}
h1 {{ font-size: 1.6rem }}
h2 {{ font-size: 1.3rem; margin-top: 2.4rem; border-top: 1px solid #dde1e6; padding-top: 1rem }}
h3 {{ font-size: 1rem; margin-bottom: .3rem }}
img, video {{ max-width: 100%; display: block }}
video {{ min-width: min(100%, 30rem) }}
table {{ border-collapse: collapse; margin: .4rem 0 1rem; font-variant-numeric: tabular-nums }}
th, td {{ padding: .2rem 1.2rem .2rem 0; text-align: left; border-bottom: 1px solid #dde1e6;
 font-weight: 400 }}
th {{ color: #57606a }}
.row {{ display: flex; gap: 4rem }}
summary {{ cursor: pointer; font-weight: 600; margin: .4rem 0 }}
</style></head><body>
"""


def write_page(run: Path, out: Path | None = None) -> Path:
    """Write the page of a run folder, by default to its index.html, and return the path.

    Raises `InputError` if the folder holds no training.
    """
    stages = stages_of(run)
    if not stages:
        raise InputError(
            f"{run} is not the folder of a training: it needs {METRICS} and {CONFIG}, or folders "
            "of stages that have both. Give the --out of egosim train."
        )
    name = printable(run.resolve().name)
    parts = [_HEAD.format(title=escape(f"Training {name}")), f"<h1>Training {escape(name)}</h1>"]
    for stage in stages:
        parts += stage.sections()
    if stages[0].folder != run:
        parts += _details("Settings of the whole run", Stage(run).json(CONFIG))
    path = out or run / PAGE
    write_text(path, "\n".join([*parts, "</body></html>\n"]))
    return path


def stages_of(run: Path) -> list[Stage]:
    """Return the trainings of a run folder: its own, or its stages in their order."""
    if (alone := Stage(run)).is_training:
        return [alone]
    root = run.resolve()
    paths = sorted(run.glob(f"*/{METRICS}"))
    found = (Stage(p.parent) for p in paths if p.parent.resolve().is_relative_to(root))
    stages = [stage for stage in found if stage.is_training]
    order = {name: index for index, name in enumerate(alone.json(CONFIG))}
    return sorted(stages, key=lambda stage: order.get(stage.folder.name, len(order)))


@dataclass(frozen=True)
class Stage:
    """One training of a run and its folder."""

    folder: Path
    """Folder with metrics.jsonl, config.json, and samples/ if there are sample clips."""

    @property
    def is_training(self) -> bool:
        """True if a training wrote the folder; evaluations have files of the same names."""
        return bool(own_file(self.folder, METRICS)) and "training" in self.json(CONFIG)

    def sections(self) -> Iterator[str]:
        """Yield the HTML of the training."""
        yield f"<h2>{escape(self.title)}</h2>"
        if self.curves:
            yield f'<img alt="curves" src="{_data("image/svg+xml", draw_curves(self.curves))}">'
        yield '<div class="row"><div><h3>Last values</h3>'
        yield _table({name: f"{y[-1]:.6g}" for name, (_, y) in self.metrics.items()})
        times = {name: s for name, s in self.json(TIMES).items() if _is_number(s)}
        if (total := sum(times.values())) > 0:
            yield "</div><div><h3>Seconds since the last start</h3>"
            yield _table({name: f"{s:.1f} ({s / total:.0%})" for name, s in times.items()})
        yield "</div></div>"
        yield from self._samples()
        yield from _details("Settings", self.json(CONFIG))
        yield from _details("Versions and devices", self.json(ENVIRONMENT))

    @property
    def title(self) -> str:
        """Name of the training, with its progress."""
        training = self.json(CONFIG).get("training")
        steps = training.get("steps") if isinstance(training, dict) else None
        last = max((int(x[-1]) for x, _ in self.metrics.values()), default=0)
        progress = f"step {last:,}" + (f" of {steps:,}" if _is_number(steps) else "")
        return f"{printable(self.folder.resolve().name)}: {progress}"

    @cached_property
    def metrics(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Steps and values of each metric, in the order of the log."""
        found: dict[str, tuple[array[int], array[float]]] = {}
        for _, line in read_lines(self.folder / METRICS, limit=MAX_METRICS_BYTES):
            step = line.get("step") if isinstance(line, dict) else None
            if type(step) is not int or not 0 <= step < MAX_STEP:
                continue
            for name, value in line.items():
                if name != "step" and isinstance(value, int | float):
                    steps, values = found.setdefault(name, (array("q"), array("d")))
                    steps.append(step)
                    values.append(value if _is_number(value) else math.nan)
        return {name: (np.array(x), np.array(y)) for name, (x, y) in found.items()}

    @property
    def curves(self) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
        """Curves by the title of their plot; training and validation share one."""
        plots: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
        for name, points in self.metrics.items():
            if level := re.fullmatch(f"{VALIDATION}loss_([0-9.]+)", name):
                title = "validation loss by noise level"
                plots.setdefault(title, {})[level[1]] = points
            elif name not in SPEED:
                kind = "validation" if name.startswith(VALIDATION) else "training"
                plots.setdefault(name.removeprefix(VALIDATION), {})[kind] = points
        first = [name for name in ("loss", "lr", "grad_norm") if name in plots]
        return {name: plots[name] for name in [*first, *(n for n in plots if n not in first)]}

    def json(self, name: str) -> dict[str, Any]:
        """Return the values of a JSON file; empty if it is missing."""
        path = own_file(self.folder, name)
        value = read_json(path) if path else {}
        return value if isinstance(value, dict) else {}

    def _samples(self) -> Iterator[str]:
        """Yield the newest sample clips as a video, then contact sheets, newest first."""
        names = (f"samples/{path.name}" for path in self.folder.glob("samples/step_*.png"))
        sheets = sorted(sheet for name in names if (sheet := own_file(self.folder, name)))
        if not sheets:
            return
        yield "<h3>Sample clips: generated and VAE reconstruction</h3>"
        clip = own_file(self.folder, f"samples/{sheets[-1].stem}.mp4")
        if clip and clip.stat().st_size <= MAX_CLIP_BYTES:
            video = _data("video/mp4", read_bytes(clip, limit=MAX_CLIP_BYTES))
            yield f'<video src="{video}" muted autoplay loop controls playsinline></video>'
        chosen = np.linspace(0, len(sheets) - 1, min(len(sheets), MAX_SHEETS)).round().astype(int)
        for sheet in reversed([sheets[i] for i in chosen]):
            number = re.sub(r"\D", "", sheet.stem)
            yield f"<p>step {int(number or 0):,}</p>"
            try:
                image = _data("image/jpeg", _thumbnail(sheet))
            except InputError as error:
                yield f"<p>not shown: {escape(printable(str(error)))}</p>"
            else:
                yield f'<img alt="{escape(printable(sheet.stem))}" src="{image}">'


def draw_curves(plots: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]) -> bytes:
    """Return an SVG of plots over the number of updates, three per row."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    plots = {
        title: dict(islice(curves.items(), MAX_CURVES))
        for title, curves in islice(plots.items(), MAX_PLOTS)
    }
    last = max(int(steps.max()) for curves in plots.values() for steps, _ in curves.values()) or 1
    columns = min(3, len(plots))
    rows = -(-len(plots) // columns)
    figure = Figure(figsize=(4 * columns, 2.7 * rows), layout="constrained")
    axes = iter(figure.subplots(rows, columns, squeeze=False).flat)
    for (title, curves), plot in zip(plots.items(), axes, strict=False):
        for kind, (steps, values) in curves.items():
            x, y = _downsample(steps, np.where(np.abs(values) < MAX_VALUE, values, np.nan))
            mark, color = "o" if len(x) < 30 else None, COLORS.get(kind)
            plot.plot(
                x, y, marker=mark, markersize=3, linewidth=1.2, label=kind[:MAX_LABEL], color=color
            )
        finite = np.concatenate([y[np.abs(y) < MAX_VALUE] for _, y in curves.values()])
        if len(finite) and finite.min() > 1 / MAX_VALUE and finite.max() > 10 * finite.min():
            plot.set_yscale("log")
        plot.set_title(plot_text(title), fontsize=10)
        plot.set_xlim(-last / 50, last * 1.02)
        plot.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        plot.grid(alpha=0.3)
        plot.legend(fontsize=8, frameon=False)
    for unused in axes:
        unused.set_axis_off()
    data = io.BytesIO()
    with rc_context({"svg.hashsalt": "egosim"}):  # fixed ids: the same curves give the same bytes
        figure.savefig(data, format="svg", metadata={"Date": None})
    return data.getvalue()


def _downsample(steps: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a curve with at most `MAX_POINTS` points, means of consecutive ones if it has more."""
    count = -(-len(steps) // MAX_POINTS)
    if count == 1:
        return steps, values
    starts = np.arange(0, len(steps), count)
    sizes = np.diff(np.append(starts, len(steps)))
    return np.add.reduceat(steps, starts) / sizes, np.add.reduceat(values, starts) / sizes


def _thumbnail(sheet: Path) -> bytes:
    """Return a contact sheet as a JPEG at most `SHEET_PX` wide, and 16 times as high."""
    from PIL import Image

    pixels = decode_image(read_bytes(sheet, limit=MAX_SHEET_BYTES), name=quote_text(sheet.name))
    image = Image.fromarray(pixels)
    image.thumbnail((SHEET_PX, min(image.height, 16 * SHEET_PX)))
    data = io.BytesIO()
    image.save(data, "JPEG", quality=JPEG_QUALITY)
    return data.getvalue()


def _data(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _table(rows: Mapping[str, str]) -> str:
    shown = ((_cut(k), _cut(v)) for k, v in islice(rows.items(), MAX_ROWS))
    cells = (f"<tr><th>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in shown)
    return f"<table>{''.join(cells)}</table>"


def _details(title: str, value: Any) -> list[str]:
    """Return a folded table of a JSON value by dotted paths."""
    rows = dict(_flat(value))
    if not rows:
        return []
    return [f"<details><summary>{escape(title)}</summary>{_table(rows)}</details>"]


def _cut(text: str) -> str:
    return text[:MAX_CELL] + ("…" if len(text) > MAX_CELL else "")


def _is_number(value: object) -> TypeGuard[int | float]:
    """Return True for a number that fits into a float, and is not NaN or infinite."""
    try:
        return isinstance(value, int | float) and math.isfinite(value)
    except OverflowError:
        return False


def _flat(value: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping) and depth < MAX_DEPTH:
        for key, item in value.items():
            if key != "type":
                yield from _flat(item, f"{path}.{key}"[:MAX_CELL] if path else str(key), depth + 1)
    elif isinstance(value, Sequence) and not isinstance(value, str):
        yield path, ", ".join(_text(item) for item in value[:MAX_CELL])
    else:
        yield path, "" if value is None else _text(value)


def _text(value: Any) -> str:
    try:
        return str(value)
    except (RecursionError, ValueError):  # nested too deeply, or a number of thousands of digits
        return quote(value)
