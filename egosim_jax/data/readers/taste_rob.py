"""TASTE-Rob: egocentric videos of a fixed camera, with captions of the hands' actions.

The layout of the archive is not public, so the reader needs a table: a CSV with a column of video
paths and a column of captions, under any of the names below. The camera does not move: all poses
are the identity. Intrinsics, hands and scale are unknown.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import tyro

from egosim_jax.data.readers import Entry, find_files, inside, make_id
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import (
    CSV_COSTS,
    check_memory,
    listing,
    quote_path,
    quote_text,
    read_bytes,
)
from egosim_jax.io.video import probe_video
from egosim_jax.types import InputError

VIDEO_COLUMNS = ("video", "video_path", "file", "file_name", "filename", "path", "name")
CAPTION_COLUMNS = ("caption", "prompt", "text", "language", "instruction", "description")
MAX_BYTES = 1 << 28
"""Maximum size of a table in bytes."""


@dataclass(frozen=True, kw_only=True)
class TasteRob:
    """TASTE-Rob, or any fixed-camera videos with a table of captions."""

    dataset: ClassVar[str] = "taste_rob"
    source: Annotated[Path, tyro.conf.Positional]
    """CSV with columns for video and caption, or a folder that holds such files."""

    def find(self) -> Iterator[Entry]:
        """List the rows of the tables."""
        for table in find_files(self.source, "*.csv", kind="table of videos and captions"):
            for name, caption in read_table(table):
                video = Path(name)
                yield Entry(
                    recording_id=make_id(video.with_suffix("").parts),
                    read=partial(_read, table.parent, name, caption),
                    source=table.parent / name,
                )


def _read(root: Path, name: str, caption: str, folder: Path) -> Recording:
    video = inside(root, name, what="the video of a row")
    info = probe_video(video)
    return Recording.of_video(
        video,
        info,
        world_from_camera=np.tile(np.eye(4), (info.frames, 1, 1)),
        caption=caption or None,
        provenance={"camera": "fixed"},
    )


def read_table(path: Path) -> list[tuple[str, str]]:
    """Return videos and captions of a table. Raises `InputError` if it has no such columns."""
    name = quote_path(path)
    try:
        data = read_bytes(path, limit=MAX_BYTES)
        check_memory(data, CSV_COSTS, source=name)
        text = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig", newline="")
        rows = list(csv.reader(text, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{name} cannot be read as CSV: {quote_text(str(error))}.") from error
    header = [cell.strip().lower() for cell in rows[0]] if rows else []
    columns = [
        next((header.index(column) for column in names if column in header), None)
        for names in (VIDEO_COLUMNS, CAPTION_COLUMNS)
    ]
    video, caption = columns
    if video is None or caption is None:
        raise InputError(
            f"{name} has the columns {quote_text(listing(header)) or '(none)'}: it must have one "
            f"of {', '.join(VIDEO_COLUMNS)} and one of {', '.join(CAPTION_COLUMNS)}."
        )
    return [
        (row[video].strip(), row[caption].strip())
        for row in rows[1:]
        if len(row) > max(video, caption) and row[video].strip()
    ]
