"""The table that lists clips: EgoSim's metadata, as CSV or as JSON lines.

    column               holds
    video                the recorded video (truth); the column may be absent, its cells not empty
    ego_prior_video      the scene rendered along the camera path
    hand_keypoint_video  the hand skeletons
    first_frame          image (or video, of which the first frame is taken) for CLIP
    prompt               the caption
    video_id             names the outputs: letters, digits, `.`, `_` and `-`

Paths are relative to the folder of the metadata file. The mask has no column: it lies beside the
prior as `pc_mask_video.mp4`. Further columns are carried to the results.
"""

from __future__ import annotations

import csv
import difflib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from egosim_jax.types import InputError, check_counts

REQUIRED = ("ego_prior_video", "hand_keypoint_video", "first_frame", "prompt", "video_id")
TRUTH = "video"
MASK_NAME = "pc_mask_video.mp4"
SAFE_ID = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,199}")
"""What may name an output file."""


@dataclass(frozen=True, kw_only=True)
class ClipFiles:
    """One row of the metadata: where a clip's files lie."""

    video_id: str
    """Names the outputs; unique."""
    prompt: str
    """Caption."""
    prior: Path
    """Video of the rendered scene."""
    mask: Path
    """Video of where the render shows nothing (white)."""
    hands: Path
    """Video of the hand skeletons."""
    first_frame: Path
    """Image for CLIP."""
    truth: Path | None
    """Recorded video, if the metadata names one."""
    extra: Mapping[str, str]
    """Further columns."""
    row: str
    """File and line, for messages."""


def read_metadata(path: Path) -> list[ClipFiles]:
    """Read every row of a metadata file (`.csv`, or `.jsonl` with an object a line).

    Raises one `InputError` that lists every problem: missing columns, empty cells (which the
    official loader turns into the text "nan"), cells beyond the header, unsafe and repeated ids.
    """
    rows = list(_json_rows(path) if path.suffix == ".jsonl" else _csv_rows(path))
    if not rows:
        raise InputError(f"{path} lists no clips.")
    problems: list[str] = []
    first_seen: dict[str, int] = {}
    for line, row in rows:
        absent = [name for name in REQUIRED if name not in row]
        if absent:
            problems.append(f"line {line}: no column {', '.join(absent)}")
            continue
        for name in (*REQUIRED, TRUTH):
            if name in row and row[name].strip().lower() in ("", "nan"):
                problems.append(f"line {line}, column {name}: the cell is empty")
        video_id = row["video_id"]
        if video_id.strip() and not SAFE_ID.fullmatch(video_id):
            problems.append(
                f"line {line}: video_id {video_id!r} cannot name a file; use letters, digits, "
                "'.', '_' and '-'"
            )
        if video_id in first_seen:
            problems.append(
                f"line {line}: video_id {video_id!r} is already that of line {first_seen[video_id]}"
            )
        first_seen.setdefault(video_id, line)
    if problems:
        raise InputError(_listing(f"{path} cannot be used", problems))
    return [_files(path, line, row) for line, row in rows]


def select(
    items: Sequence[ClipFiles],
    *,
    where: str | None = None,
    video_ids: Sequence[str] = (),
    limit: int | None = None,
) -> list[ClipFiles]:
    """Rows whose extra column has a value (`where="split=test"`), of these ids, the first `limit`.

    Raises `InputError` for a column, value or id that does not occur.
    """
    chosen = list(items)
    if where is not None:
        column, equals, value = where.partition("=")
        columns = sorted({name for item in items for name in item.extra})
        if not equals or column not in columns:
            raise InputError(
                f"--where {where!r} must be COLUMN=VALUE with one of the columns "
                f"{', '.join(columns) or '(the metadata has no further columns)'}."
            )
        chosen = [item for item in items if item.extra.get(column) == value]
        if not chosen:
            values = sorted({item.extra.get(column, "") for item in items})
            raise InputError(f"No clip has {where}; {column} is one of: {', '.join(values)}.")
    if video_ids:
        by_id = {item.video_id: item for item in chosen}
        for video_id in video_ids:
            if video_id not in by_id:
                near = difflib.get_close_matches(video_id, by_id, n=1)
                hint = f" Did you mean {near[0]}?" if near else ""
                raise InputError(f"No clip is called {video_id}.{hint} (--video-id)")
        chosen = [by_id[video_id] for video_id in video_ids]
    if limit is not None:
        check_counts({"--limit": limit})
        chosen = chosen[:limit]
    return chosen


def _csv_rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Line number and cells of each row; `InputError` if the file is no table."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file, strict=True)
            header = next(reader, [])
            absent = [name for name in REQUIRED if name not in header]
            if absent:
                raise InputError(f"{path} has no column {', '.join(absent)}.")
            repeated = sorted({name for name in header if header.count(name) > 1})
            if repeated:
                raise InputError(f"{path} has more than one column {', '.join(repeated)}.")
            line = reader.line_num + 1
            for cells in reader:
                if len(cells) > len(header):
                    raise InputError(
                        f"{path}, line {line}: {len(cells)} cells, but the header has "
                        f"{len(header)}. A cell with a comma needs quotes."
                    )
                if cells:
                    cells += [""] * (len(header) - len(cells))
                    yield line, dict(zip(header, cells, strict=True))
                line = reader.line_num + 1
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as CSV: {error}.") from error


def _json_rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Line number and values of each line; null counts as an empty cell."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {error}.") from error
    for line, text in enumerate(lines, start=1):
        if not text.strip():
            continue
        try:
            row = json.loads(text)
        except json.JSONDecodeError as error:
            raise InputError(f"{path}, line {line} is not JSON: {error}.") from error
        if not isinstance(row, dict):
            raise InputError(f"{path}, line {line} is not a JSON object.")
        yield line, {name: "" if value is None else str(value) for name, value in row.items()}


def _files(path: Path, line: int, row: Mapping[str, str]) -> ClipFiles:
    folder = path.parent
    prior = folder / row["ego_prior_video"]
    return ClipFiles(
        video_id=row["video_id"],
        prompt=row["prompt"],
        prior=prior,
        mask=prior.parent / MASK_NAME,
        hands=folder / row["hand_keypoint_video"],
        first_frame=folder / row["first_frame"],
        truth=folder / row[TRUTH] if TRUTH in row else None,
        extra={name: cell for name, cell in row.items() if name not in (*REQUIRED, TRUTH)},
        row=f"{path.name} line {line}",
    )


def _listing(what: str, problems: Sequence[str], *, most: int = 20) -> str:
    shown = [f"  {problem}" for problem in problems[:most]]
    if len(problems) > most:
        shown.append(f"  and {len(problems) - most} more")
    return "\n".join([f"{what}:", *shown])
