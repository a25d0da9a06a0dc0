"""Metadata of clips: a table with EgoSim's columns, as CSV or JSON lines, or a DWM list.

    column               holds                                          default without the column
    video                the recorded video (ground truth)              no ground truth
    ego_prior_video      the scene rendered along the camera path       required
    hand_keypoint_video  the hand skeletons                             hand_kp_video.mp4
    first_frame          image (or video: its first frame) for CLIP     hand_inpaint.png
    prompt               the caption                                    required
    video_id             names the outputs                              video, with _ for /

Paths are relative to the folder of the metadata file. The default files have EgoSim's names and are
in the folder of the prior. So is the mask, `pc_mask_video.mp4`, which has no column. Ids consist of
letters, digits, `.`, `_` and `-`; a `/` in an id makes a subfolder of the outputs. No cell of the
columns above may be empty; blanks around their text are dropped. Further columns are copied to the
results.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from egosim_jax.data.clip_files import MAX_CLIPS, SAFE_IDS, ClipFiles, Problems, Prompts, is_safe_id
from egosim_jax.data.dwm import read_list
from egosim_jax.io.bounded import quote, quote_path, quote_text, read_bytes, read_lines
from egosim_jax.runtime.options import meant
from egosim_jax.types import InputError, check_counts

REQUIRED = ("ego_prior_video", "prompt")
COLUMNS = ("video", "ego_prior_video", "hand_keypoint_video", "first_frame", "prompt", "video_id")
STRIPPED = tuple(name for name in COLUMNS if name != "prompt")
"""Columns whose cells are read without blanks at their ends."""
TARGET = "video"
"""Column of the recorded video."""
MASK_NAME, HANDS_NAME, IMAGE_NAME = "pc_mask_video.mp4", "hand_kp_video.mp4", "hand_inpaint.png"
"""Default file names, in the folder of the prior."""
MAX_BYTES = 1 << 28
"""Maximum size of a metadata file in bytes."""
MAX_COLUMNS, MAX_CELLS = 256, 1 << 22
"""Maximum number of columns, and of all cells."""


def read_metadata(path: Path | str, *, prompts: Prompts = "prompts_rewrite") -> list[ClipFiles]:
    """Read every row of a metadata file (`.csv`, or `.jsonl` with one object per line).

    A `.txt` is a DWM list (`data/dwm.py`), for which `prompts` chooses the captions. Raises one
    `InputError` that lists the problems: missing columns, empty cells (which the official loader
    reads as the text "nan"), cells beyond the header, unsafe and duplicate ids.
    """
    path = Path(path)
    if path.suffix == ".txt":
        return read_list(path, prompts=prompts)
    if prompts != "prompts_rewrite":
        raise InputError(
            f"{quote_path(path)} has its captions in the column prompt: {prompts} can be chosen "
            "only for a DWM list, .txt. Give a list, or omit the option. (--prompts, --metadata)"
        )
    clips: list[ClipFiles] = []
    problems = Problems()
    first_seen: dict[str, int] = {}
    cells = 0
    for line, read in _json_rows(path) if path.suffix == ".jsonl" else csv_rows(path):
        row = {name: cell.strip() if name in STRIPPED else cell for name, cell in read.items()}
        mistakes = list(_row_problems(row, first_seen))
        problems.add(f"line {line}{problem}" for problem in mistakes)
        if not mistakes:
            clips.append(_files(path, line, row))
            first_seen[clips[-1].video_id] = line
        cells += len(row)
        if len(clips) > MAX_CLIPS or cells > MAX_CELLS:
            raise InputError(
                f"{quote_path(path)} lists more than {MAX_CLIPS:,} clips or {MAX_CELLS:,} cells. "
                "Split it."
            )
    problems.refuse(f"{quote_path(path)} cannot be used")
    if not clips:
        raise InputError(f"{quote_path(path)} lists no clips.")
    return clips


def check_presence(items: Sequence[ClipFiles]) -> None:
    """Raise `InputError` if no clip has its prior, as when the metadata is in a wrong folder."""
    if not any(item.prior.exists() for item in items):
        shown = ", ".join(quote_path(item.prior) for item in items[:3])
        raise InputError(
            f"None of the {len(items):,} clips has its prior video: {shown}"
            f"{', …' if len(items) > 3 else ''}. Paths are relative to the folder of the metadata."
        )


def select(
    items: Sequence[ClipFiles],
    *,
    where: str | None = None,
    video_ids: Sequence[str] = (),
    limit: int | None = None,
) -> list[ClipFiles]:
    """Select rows by the value of a column (`where="split=test"`), by id, and the first `limit`.

    Raises `InputError` for a column, value or id that does not occur.
    """
    chosen = list(items)
    if where is not None:
        column, equals, value = where.partition("=")
        columns = sorted({name for item in items for name in item.extra})
        if not equals or column not in columns:
            raise InputError(
                f"--where {where!r} must be COLUMN=VALUE with one of the columns "
                f"{_some(columns) or '(the metadata has no further columns)'}."
            )
        chosen = [item for item in items if item.extra.get(column) == value]
        if not chosen:
            values = sorted({item.extra.get(column, "") for item in items})
            raise InputError(f"No clip has {where}; {column} is one of: {_some(values)}.")
    if video_ids:
        by_id = {item.video_id: item for item in chosen}
        for video_id in video_ids:
            if video_id not in by_id:
                hint = meant(video_id, by_id)
                raise InputError(f"No clip has the id {video_id}.{hint} (--video-id)")
        chosen = [by_id[video_id] for video_id in video_ids]
    if limit is not None:
        check_counts({"--limit": limit})
        chosen = chosen[:limit]
    return chosen


def _some(values: Sequence[str]) -> str:
    shown = ", ".join(quote_text(value) for value in values[:20])
    return shown + (f" and {len(values) - 20:,} more" if len(values) > 20 else "")


def _row_problems(row: Mapping[str, str], first_seen: Mapping[str, int]) -> Iterator[str]:
    absent = [name for name in REQUIRED if name not in row]
    if "video_id" not in row and TARGET not in row:
        absent.append("video_id")
    if absent:
        yield f": no column {', '.join(absent)}"
        return
    for name in COLUMNS:
        if name in row and row[name].strip().lower() in ("", "nan"):
            yield f", column {name}: the cell is empty"
    video_id = _video_id(row)
    if video_id.strip() and not is_safe_id(video_id):
        yield (f": video_id {quote(video_id)} is not a valid file name; use {SAFE_IDS}")
    if video_id in first_seen:
        yield f": video_id {quote(video_id)} is a duplicate of line {first_seen[video_id]}"


def _video_id(row: Mapping[str, str]) -> str:
    if "video_id" in row:
        return row["video_id"]
    return row[TARGET].replace("/", "_").removesuffix(".mp4")


def csv_rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line number and cells of each row; raise `InputError` for an invalid table."""
    name = quote_path(path)
    try:
        data = io.BytesIO(read_bytes(path, limit=MAX_BYTES))
        lines = io.TextIOWrapper(data, encoding="utf-8-sig", newline="")
        reader = csv.reader(lines, strict=True)
        header = [cell.strip() for cell in next(reader, [])]
        needed = (*REQUIRED, *(() if TARGET in header else ("video_id",)))
        absent = [column for column in needed if column not in header]
        if absent:
            raise InputError(f"{name} has no column {', '.join(absent)}.")
        repeated = sorted({quote_text(cell) for cell in header if header.count(cell) > 1})
        if repeated or len(header) > MAX_COLUMNS:
            problem = (
                f"more than one column {', '.join(repeated)[:200]}"
                if repeated
                else (f"{len(header)} columns, more than {MAX_COLUMNS}")
            )
            raise InputError(f"{name} has {problem}.")
        line = reader.line_num + 1
        for cells in reader:
            if len(cells) > len(header):
                raise InputError(
                    f"{name}, line {line}: {len(cells)} cells, but the header has "
                    f"{len(header)}. A cell with a comma needs quotes."
                )
            if cells:
                cells += [""] * (len(header) - len(cells))
                yield line, dict(zip(header, cells, strict=True))
            line = reader.line_num + 1
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{name} cannot be read as CSV: {quote_text(str(error))}. Save it as CSV in UTF-8."
        ) from error


def _json_rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line number and values of each line; null becomes an empty cell."""
    for line, row in read_lines(path, limit=MAX_BYTES, last="read"):
        where = f"{quote_path(path)}, line {line}"
        if not isinstance(row, dict):
            raise InputError(f"{where} is not a JSON object.")
        if len(row) > MAX_COLUMNS:
            raise InputError(f"{where} has {len(row)} columns, more than {MAX_COLUMNS}.")
        yield line, {name: _cell(value, name, where) for name, value in row.items()}


def _cell(value: Any, name: str, where: str) -> str:
    if isinstance(value, (list, dict)):
        raise InputError(f"{where}: {quote(name)} is {quote(value)}, not text or a number.")
    return "" if value is None else str(value)


def _files(path: Path, line: int, row: Mapping[str, str]) -> ClipFiles:
    folder = path.parent
    prior = folder / row["ego_prior_video"]

    def path_of(column: str, name: str) -> Path:
        return folder / row[column] if column in row else prior.parent / name

    return ClipFiles(
        video_id=_video_id(row),
        prompt=row["prompt"],
        prior=prior,
        mask=prior.parent / MASK_NAME,
        hands=path_of("hand_keypoint_video", HANDS_NAME),
        first_frame=path_of("first_frame", IMAGE_NAME),
        target=folder / row[TARGET] if TARGET in row else None,
        extra={name: cell for name, cell in row.items() if name not in COLUMNS},
        row=f"{path.name} line {line}",
    )
