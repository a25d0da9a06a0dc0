"""HTML page of all annotated clips: prior, mask, hands and video, or the reason of a refusal."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from egosim_jax.annotate.clip import SHEET
from egosim_jax.io.bounded import own_file, read_bytes
from egosim_jax.io.run import write_text
from egosim_jax.runtime.terminal import counted

PAGE = "index.html"
MAX_IMAGES = 500
"""Maximum number of clips shown with images; further clips are only listed."""
MAX_SHEET_BYTES = 1 << 24
MIN_HIDDEN = 0.005
"""Share of the first frame's pixels from which hidden places are named."""
HIDDEN = (
    "the clip begins with hands in view. The scene behind them is taken from other frames or "
    "filled in, and parts of hands and sleeves may stay in it: look at the prior. Begin without "
    "hands in view, or mask them by a network. (--masks)"
)
"""Note on a scene with hidden places."""
_HEAD = """<!doctype html>
<html lang="en"><meta charset="utf-8"><title>Annotated clips</title>
<style>
body { font: 14px/1.4 sans-serif; margin: 24px; max-width: 1300px }
section { border-top: 1px solid #bbb; padding: 12px 0 }
img { max-width: 100%; display: block }
pre { white-space: pre-wrap; font-size: 12px; color: #444 }
.refused h2, .failed h2 { color: #a00 }
h2 { font-size: 16px; margin: 4px 0 }
</style>
"""


def summary(report: Mapping[str, Any]) -> str:
    """Return the numbers of clips and videos of a report, by their result."""
    counts, videos = report["clips"], report["videos"].values()
    return (
        f"{counted(counts['done'], 'clip')} done, {counts['refused']} refused, "
        f"{counts['failed']} failed; of {counted(len(videos), 'video')}, "
        f"{sum(not video['done'] for video in videos)} without a clip"
    )


def hides_scene(about: Mapping[str, Any]) -> bool:
    """Return True if hands hide a part of the scene in a clip's first frame."""
    return about["status"] == "done" and about.get("plate", {}).get("hidden", 0) > MIN_HIDDEN


def write_page(out: Path, report: Mapping[str, Any]) -> None:
    """Write the page: self-contained, without scripts, with escaped text."""
    parts = [
        _HEAD,
        f"<h1>{html.escape(summary(report))}</h1>",
        "<p>Images, from top to bottom: prior, mask (white: not observed), hands, video.</p>",
    ]
    for name, video in report["videos"].items():
        if "problem" in video:
            parts.append(_section("failed", name, video["problem"], None, {}))
    for number, about in enumerate(report["annotations"]):
        name = f"{about['video_id']}/{SHEET}"
        drawn = own_file(out, name) if number < MAX_IMAGES else None
        title = f"{about['video_id']}: {about['status']}"
        text = about.get("reason") or about.get("row", {}).get("prompt", "")
        if hides_scene(about):
            text = f"{text} Note: {HIDDEN}"
        shown = ("quality", "hands", "cameras", "depth", "scale", "plate", "prior", "caption")
        figures = {name: about[name] for name in shown if name in about}
        parts.append(_section(about["status"], title, text, drawn, figures))
    write_text(out / PAGE, "\n".join(parts) + "\n</html>\n")


def _section(
    status: str, title: str, text: str, drawn: Path | None, figures: Mapping[str, Any]
) -> str:
    image = ""
    if drawn is not None:
        data = base64.b64encode(read_bytes(drawn, limit=MAX_SHEET_BYTES)).decode()
        image = f'<img alt="{html.escape(title)}" src="data:image/jpeg;base64,{data}">'
    table = "\n".join(f"{name}: {json.dumps(value)}" for name, value in figures.items())
    return (
        f'<section class="{html.escape(status)}"><h2>{html.escape(title)}</h2>'
        f"<p>{html.escape(text)}</p>{image}<pre>{html.escape(table)}</pre></section>"
    )
