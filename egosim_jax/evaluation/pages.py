"""A self-contained HTML page of an evaluation: tables, protocol, and clips of all methods.

Each clip is one small video with a column for each method, which keeps the methods in step. The
page loads no other files: its content security policy allows only inline data, and the template
escapes every value.
"""

from __future__ import annotations

import base64
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.transforms import resize_video
from egosim_jax.data.windows import Window
from egosim_jax.evaluation.files import ARROWS
from egosim_jax.evaluation.methods import Method, Shape, read_at
from egosim_jax.evaluation.metrics.report import cell_of
from egosim_jax.evaluation.result import Evaluation
from egosim_jax.evaluation.scoring import row_of
from egosim_jax.io.run import write_text
from egosim_jax.io.video import probe_video
from egosim_jax.io.writing import encode_video
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError

PAGE, TEMPLATE = "index.html", "page.html"
PANEL_PX = 224
"""Width of one column in pixels."""
EVERY, CRF = 2, 30
"""Frame step, and x264 quality, of the videos on the page."""
MISSING = (
    "the page cannot be written: it needs jinja2, which is not installed. Install "
    "egosim-jax[metrics]."
)


class ShownClip(NamedTuple):
    """A clip on a page."""

    title: str
    prompt: str
    names: list[str]
    """Titles of the video's columns."""
    video: str
    """Video as a data URI."""
    scores: list[list[str]]
    """Title and cells of each method."""


def can_be_written() -> bool:
    """Return True if jinja2, which a page needs, is installed."""
    return find_spec("jinja2") is not None


def write_page(
    evaluation: Evaluation, methods: Sequence[Method], path: Path, *, title: str, clips: int
) -> None:
    """Write the page of an evaluation, with at most `clips` clips of each group."""
    render(
        path,
        title=title,
        tables=list(_tables(evaluation)),
        notes=evaluation.notes(),
        skipped=list(evaluation.skipped),
        clips=list(_clips(evaluation, methods, clips)),
    )


def render(
    path: Path,
    *,
    title: str,
    tables: Sequence[Mapping[str, Any]],
    notes: Sequence[str],
    skipped: Sequence[str],
    clips: Sequence[ShownClip],
) -> None:
    """Write a page of tables, notes, what was skipped, and clips.

    A table has `caption`, `corner`, `heads` and `rows`, and `differences` from a `reference`.
    """
    import jinja2

    template = resources.files("egosim_jax.evaluation").joinpath(TEMPLATE).read_text("utf-8")
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    text = page.from_string(template).render(
        title=title, tables=tables, notes=notes, skipped=skipped, clips=clips
    )
    write_text(path, text)


def _tables(evaluation: Evaluation) -> Iterator[dict[str, Any]]:
    differences = evaluation.differences()
    for group in evaluation.summaries():
        columns = evaluation.headings(group)
        yield {
            "corner": "method",
            "caption": f"{evaluation.caption(group)}: mean ± spread over clips",
            "heads": [f"{c.heading} {ARROWS[c.better]}" for c in columns.values()],
            "rows": [
                (
                    title,
                    title.endswith("(published)"),
                    [cell_of(row.get(key, {}), c.form) for key, c in columns.items()],
                )
                for title, row in evaluation.table(group).items()
            ],
            "reference": f"{next(iter(evaluation.titles.values()))} on the same clips",
            "differences": [
                (
                    evaluation.titles[method],
                    [cell_of(values.get(key, {}), c.form) for key, c in columns.items()],
                )
                for method, values in differences.get(group, {}).items()
            ],
        }


def _clips(evaluation: Evaluation, methods: Sequence[Method], count: int) -> Iterator[ShownClip]:
    """Yield the first clips of each group."""
    by_group: dict[str, dict[Window, list]] = {}
    for row in evaluation.rows:
        by_group.setdefault(evaluation.group_of(row), {}).setdefault(row.window, []).append(row)
    chosen = [
        (group, window, rows)
        for group, windows in sorted(by_group.items())
        for window, rows in islice(windows.items(), count)
    ]
    by_name = {row_of(method): method for method in reversed(methods)}
    for group, window, rows in track(chosen, "drawing", total=len(chosen)):
        shown = [by_name[row.method] for row in rows if not row.own]
        frames, fps = _strip(window, shown, rows[0].shape)
        columns = evaluation.headings(group)
        yield ShownClip(
            title=f"{evaluation.groups.get(group, group)}: {window.output_id}",
            prompt=window.files.prompt,
            names=[*(method.title for method in shown), "ground truth"],
            video=as_uri(frames, fps),
            scores=[
                [evaluation.titles[row.method]]
                + [c.form.format(row.scores[k]) if k in row.scores else "" for k, c in
                   columns.items()]
                for row in rows
            ],
        )  # fmt: skip


def as_uri(frames: UInt8[np.ndarray, "f h w 3"], fps: float) -> str:
    """Return a video as a data URI."""
    data = base64.b64encode(encode_video(frames, fps, crf=CRF)).decode()
    return f"data:video/mp4;base64,{data}"


def columns_of(
    videos: Sequence[UInt8[np.ndarray, "_ _ _ 3"]], height: int, width: int
) -> UInt8[np.ndarray, "_ _ _ 3"]:
    """Return every second frame of videos in columns of `PANEL_PX`; a short one holds its last."""
    rows = round(PANEL_PX * height / width / 2) * 2
    panels = [resize_video(np.ascontiguousarray(v[::EVERY]), rows, PANEL_PX) for v in videos]
    longest = max(map(len, panels))
    holds = [((0, longest - len(panel)), (0, 0), (0, 0), (0, 0)) for panel in panels]
    held = [np.pad(panel, hold, "edge") for panel, hold in zip(panels, holds, strict=True)]
    return np.concatenate(held, axis=2)


def _strip(
    window: Window, methods: Sequence[Method], shape: Shape
) -> tuple[UInt8[np.ndarray, "f h w 3"], float]:
    """Return the small videos of a clip in columns, ground truth last, and their frame rate."""
    target_path = window.files.target
    if target_path is None:
        raise InputError(f"{window.files.row} has no ground truth. (column video)")
    target = read_at(target_path, shape, window.start)
    videos = [*(method.video(window, shape, target) for method in methods), target]
    frames = columns_of(videos, shape.height, shape.width)
    return frames, float(probe_video(target_path).fps) / EVERY
