"""LeRobot datasets, versions 2.0, 2.1 and 3.0: one camera's video and the task per episode.

    v2   meta/info.json, meta/episodes.jsonl, one video per episode and camera
    v3   meta/info.json, meta/tasks.parquet, meta/episodes/chunk-*/file-*.parquet; a video holds
         several episodes, each from `from_timestamp` to `to_timestamp` in seconds

Row k of an episode belongs to the frame of its video that is nearest to the row's `timestamp`, in
seconds after the episode's start (`io/timing.py`). Without that column, or if its values do not
differ, row k belongs to k / fps. Rows at the video's rate must be as many as the frames of the
episode. Rows of another rate after the end of the video are omitted, with a warning.

Paths come from the templates in info.json; only the fields of the format are filled in. The format
does not define cameras, hands and their units (a robot's state has no common meaning), so they stay
unknown. Videos may have any codec that FFmpeg reads, such as AV1. tasks.parquet is a pandas file:
the text is its index or a column `task`. Followed: huggingface's `lerobot` of 2026,
`dataset_metadata.py` and `io_utils.py`.
"""

from __future__ import annotations

import logging
import string
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import tyro
from jaxtyping import Bool, Float

from egosim_jax.data.pairing import pair_rows
from egosim_jax.data.readers import Entry, inside, make_id, make_rate, natural_order, require
from egosim_jax.data.recording import MAX_FRAMES, Recording
from egosim_jax.io.bounded import (
    listing,
    quote,
    quote_path,
    quote_text,
    read_json,
    read_lines,
)
from egosim_jax.io.timing import Timeline, row_times
from egosim_jax.io.untrusted.parquet import read_parquet
from egosim_jax.io.video import VideoInfo, probe_video
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)

EGOCENTRIC = ("ego", "head", "top")
"""Parts of the preferred camera's name if there are several cameras."""
VERSIONS = ("v2.0", "v2.1", "v3.0")
MAX_EPISODES = 1_000_000
"""Maximum number of episodes."""


@dataclass(frozen=True, kw_only=True)
class _Episode:
    index: int
    video: Path
    start_s: float
    stop_s: float | None
    """End of its part of the video; None if the video has no other episode."""
    data: Path | None
    length: int
    tasks: tuple[str, ...] | None
    """Texts of its tasks; None if only the table of its rows says which they are."""


@dataclass(frozen=True, kw_only=True)
class LeRobot:
    """LeRobot dataset, v2.0 to v3.0: video and task of each episode."""

    dataset: ClassVar[str] = "lerobot"
    source: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset, with meta/info.json."""
    camera: str | None = None
    """Key of the camera, such as observation.images.head; default: the only or egocentric one."""

    def find(self) -> Iterator[Entry]:
        """Yield the episodes of a LeRobot dataset."""
        info = read_info(self.source)
        camera, fps = _choose_camera(info["features"], self.camera), rate_of(info)
        episodes = _episodes_v3 if info["codebase_version"] == "v3.0" else _episodes_v2
        # Consecutive episodes share a video and a table.
        probe, read = lru_cache(maxsize=1)(probe_video), lru_cache(maxsize=1)(_read_stamps)
        tasks = lru_cache(maxsize=1)(partial(_tasks_of_rows, self.source))
        for episode in episodes(self.source, info, camera):
            if isinstance(episode, str):
                index, _, problem = episode.partition(": ")
                yield Entry(
                    recording_id=make_id([f"episode_{index}"]),
                    read=partial(_fail, problem),
                    source=self.source,
                )
                continue
            yield Entry(
                recording_id=f"episode_{episode.index:06d}",
                read=partial(_read, episode, fps, probe, read, tasks),
                source=episode.video,
                options={"camera": camera},
            )


def _read(
    episode: _Episode,
    fps: Fraction,
    probe: Callable[[Path], VideoInfo],
    read: Callable[[Path], Mapping[int, list[Any]]],
    read_texts: Callable[[Path], Mapping[int, tuple[str, ...]]],
    folder: Path,
) -> Recording:
    info = probe(episode.video)
    stamps = read(episode.data).get(episode.index) if episode.data else None
    start_s, stop_s = episode.start_s, episode.stop_s
    end_s = (info.frames - 0.5) / float(info.fps)  # the last frame is the nearest until then
    name = f"Episode {episode.index}, column timestamp"
    first_s, timeline = 0.0, Timeline.even(episode.length, fps)
    if stamps:
        _, first_s, timeline = row_times(stamps, [fps], name)
    whole = timeline.count == len(timeline.times_s)
    after_s = timeline.times_s if whole else timeline.moments_s(0, timeline.count)
    times_s, fps = start_s + first_s + after_s, timeline.fps
    if not first_s and fps == info.fps and stop_s != np.inf:
        frames = info.frames if stop_s is None else round((stop_s - start_s) * float(fps))
        pair_rows(episode.video, info, episode.length, what="rows", frames=frames)
    stop_s = end_s if stop_s is None else min(end_s, stop_s - 0.5 / float(fps))

    def fit(times_s: Float[np.ndarray, " f"]) -> Bool[np.ndarray, " f"]:
        return (start_s - 0.5 / float(fps) < times_s) & (times_s < stop_s)

    fits, where = fit(times_s), f"which has {info.frames} frames in {end_s:.3f} s"
    if not fits.all() and fit(start_s + after_s).all():
        raise InputError(
            f"{name}, is from {first_s:.3f} to {first_s + after_s[-1]:.3f} s, not all in its part "
            f"of {quote_path(episode.video)}, {where}: it must be in seconds after the start of "
            "the episode. Subtract its first value."
        )
    if not fits.any():
        raise InputError(
            f"Episode {episode.index} begins at {times_s[0]:.3f} s of {quote_path(episode.video)}, "
            f"{where}: the video is not the one that the metadata describe. Download both again."
        )
    if len(times_s) != episode.length or not fits.all():
        logger.warning(
            "Episode %d: %d of %d rows are within %s, %.3f to %.3f s; the others are omitted",
            episode.index, fits.sum(), episode.length, quote_path(episode.video), episode.start_s,
            stop_s,
        )  # fmt: skip
    times_s = times_s[fits]
    start = _consecutive(info, times_s)
    tasks = episode.tasks or ()
    if episode.tasks is None and episode.data:
        try:
            tasks = read_texts(episode.data).get(episode.index, ())
        except InputError as error:
            logger.warning("Episode %d: its tasks stay unknown: %s", episode.index, error)
    return Recording.of_video(
        episode.video,
        info,
        start=start or 0,
        times_s=times_s if start is None else None,
        frames=len(times_s),
        fps=fps,
        caption="; ".join(tasks) or None,
    )


def _consecutive(info: VideoInfo, times_s: Float[np.ndarray, " f"]) -> int | None:
    """Return the first of the frames nearest to times if no frame is between them, or None."""
    start = round(float(times_s[0]) * info.fps)
    stop = start + len(times_s)
    nearest = info.timeline.nearest
    same = np.array_equal(nearest(info.timeline.moments_s(start, stop)), nearest(times_s))
    return start if same and stop <= info.frames else None


def _read_stamps(path: Path) -> dict[int, list[Any]]:
    """Return the time stamps of each episode in a table; empty without such a column."""
    require("pyarrow")
    names = ("episode_index", "frame_index", "timestamp")
    table = read_parquet(path, [], optional=names) if path.is_file() else {}
    stamps: dict[int, list[Any]] = {}
    if all(name in table for name in names):
        for number in sorted(range(len(table["timestamp"])), key=table["frame_index"].__getitem__):
            stamps.setdefault(table["episode_index"][number], []).append(table["timestamp"][number])
    return stamps


def read_info(root: Path, versions: Sequence[str] = VERSIONS) -> dict[str, Any]:
    """Return meta/info.json, checked: one of `versions`, with features and a frame rate."""
    info = read_json(root / "meta" / "info.json")
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise InputError(f"{root}/meta/info.json does not describe a LeRobot dataset.")
    if (version := info.get("codebase_version")) not in versions:
        raise InputError(
            f"{root} is of LeRobot version {quote(version)}; supported are {', '.join(versions)}. "
            "Convert it with LeRobot's own script."
        )
    rate_of(info)
    return info


def rate_of(info: Mapping[str, Any]) -> Fraction:
    """Return the frame rate of a dataset's tables."""
    return make_rate(info.get("fps", 0), what="fps in meta/info.json")


def read_rows(
    root: Path,
    info: Mapping[str, Any],
    episode: int,
    columns: Sequence[str],
    *,
    optional: Sequence[str] = (),
) -> dict[str, list[Any]]:
    """Return columns of an episode's frames in order, from a dataset of version 3.0.

    Raises `InputError` if there is no such episode, or if its frames are not the ones that its
    description names.
    """
    path, length = table_of(root, info, episode)
    frames = read_parquet(path, ["episode_index", "frame_index", *columns], optional=optional)
    chosen = [n for n, index in enumerate(frames["episode_index"]) if index == episode]
    chosen.sort(key=lambda n: frames["frame_index"][n])
    if [frames["frame_index"][n] for n in chosen] != list(range(length)):
        raise InputError(
            f"{quote_path(path)} has {len(chosen)} frames of episode {episode}, meta/episodes says "
            f"{length}, from 0 without gaps. Download both again."
        )
    names = [name for name in (*columns, *optional) if name in frames]
    return {name: [frames[name][n] for n in chosen] for name in names}


def table_of(root: Path, info: Mapping[str, Any], episode: int) -> tuple[Path, int]:
    """Return the table of an episode's frames, and their number."""
    require("pyarrow")
    places = ["episode_index", "length", "data/chunk_index", "data/file_index"]
    known = 0
    for path in sorted((root / "meta" / "episodes").glob("*/*.parquet"), key=natural_order):
        table = read_parquet(path, places)
        known += len(table["episode_index"])
        if episode in table["episode_index"]:
            number = table["episode_index"].index(episode)
            break
    else:
        raise InputError(
            f"{quote_path(root)} has no episode {episode} among its {known}: choose another one. "
            "(--episode)"
        )
    row = {name: _count(values[number], name) for name, values in table.items()}
    fields = {name: row[f"data/{name}"] for name in ("chunk_index", "file_index")}
    return _fill(root, info.get("data_path"), fields, what="data_path"), row["length"]


def _fail(problem: str, folder: Path) -> Recording:
    raise InputError(problem)


def _choose_camera(features: Mapping[str, Any], wanted: str | None) -> str:
    """Return the key of the camera to read. Raises `InputError` if it is not clear."""
    dtypes = {k: f.get("dtype") for k, f in features.items() if isinstance(f, dict)}
    videos = [
        key for key, dtype in dtypes.items() if dtype == "video" and not _is_depth(features[key])
    ]
    if wanted is not None:
        videos = [key for key in videos if key == wanted or key.rpartition(".")[2] == wanted]
    preferred = [key for key in videos if any(part in key.lower() for part in EGOCENTRIC)]
    chosen = videos if len(videos) == 1 else preferred
    if len(chosen) == 1:
        return chosen[0]
    if not videos and wanted is None and "image" in dtypes.values():
        raise InputError(
            "The dataset stores images in its tables: only videos are read. Convert it with "
            "LeRobot's own script."
        )
    keys = listing([quote_text(key) for key, dtype in dtypes.items() if dtype == "video"], limit=20)
    raise InputError(
        f"The camera to read is not clear: the dataset has the videos {keys or '(none)'}. Choose "
        "one. (--camera)"
    )


def _is_depth(feature: Mapping[str, Any]) -> bool:
    infos = [feature.get("info"), feature.get("video_info")]
    names = ("is_depth_map", "video.is_depth_map")
    return any(bool(info.get(n)) for info in infos if isinstance(info, dict) for n in names)


def _episodes_v2(root: Path, info: Mapping[str, Any], camera: str) -> Iterator[_Episode | str]:
    chunk, template = info.get("chunks_size", 1000), info.get("video_path")
    if type(chunk) is not int or chunk < 1:
        raise InputError(f"meta/info.json: chunks_size is {quote(chunk)}, not a positive number.")
    for line, row in read_lines(root / "meta" / "episodes.jsonl", last="read"):
        if not isinstance(row, dict):
            raise InputError(f"meta/episodes.jsonl, line {line} is not a JSON object.")
        index = row.get("episode_index")
        try:
            number = _count(index, "episode_index")
            fields = {"episode_chunk": number // chunk, "episode_index": number}
            yield _Episode(
                index=number,
                video=_fill(root, template, {**fields, "video_key": camera}, what="video_path"),
                start_s=0.0,
                stop_s=None,
                data=_data_path(root, info, fields),
                length=_count(row.get("length"), "length", minimum=1),
                tasks=_texts(row.get("tasks")),
            )
        except InputError as error:
            yield f"{line}: {error}"


def _episodes_v3(root: Path, info: Mapping[str, Any], camera: str) -> Iterator[_Episode | str]:
    require("pyarrow")
    paths = sorted((root / "meta" / "episodes").glob("*/*.parquet"), key=natural_order)
    if not paths:
        raise InputError(f"{root} has no meta/episodes/chunk-*/file-*.parquet.")
    names = ("chunk_index", "file_index", "from_timestamp")
    place = {n: f"videos/{camera}/{n}" for n in names}
    stop, template = f"videos/{camera}/to_timestamp", info.get("video_path")
    for path in paths:
        table = read_parquet(
            path,
            ["episode_index", "length", *place.values()],
            optional=["tasks", "data/chunk_index", "data/file_index", stop],
        )
        for number in range(len(table["episode_index"])):
            row = {name: values[number] for name, values in table.items()}
            try:
                index = _count(row["episode_index"], "episode_index")
                fields = {n: _count(row[place[n]], n) for n in ("chunk_index", "file_index")}
                start_s = _time(row[place["from_timestamp"]], "from_timestamp")
                end_s = row.get(stop)
                data = {n: row.get(f"data/{n}") for n in ("chunk_index", "file_index")}
                yield _Episode(
                    index=index,
                    video=_fill(root, template, {**fields, "video_key": camera}, what="video_path"),
                    start_s=start_s,
                    stop_s=float("inf") if end_s is None else _time(end_s, "to_timestamp"),
                    data=_data_path(root, info, data),
                    length=_count(row["length"], "length", minimum=1),
                    tasks=_texts(row["tasks"]) if "tasks" in row else None,
                )
            except InputError as error:
                yield f"{row['episode_index']!s:.20}: {error}"


def _tasks_of_rows(root: Path, path: Path) -> dict[int, tuple[str, ...]]:
    """Return the texts of each episode's tasks, in the order of its rows in a table."""
    texts, rows = read_tasks(root), read_parquet(path, ["episode_index", "task_index"])
    used: dict[int, dict[int, None]] = {}
    for episode, task in zip(rows["episode_index"], rows["task_index"], strict=True):
        used.setdefault(episode, {})[task] = None
    return {
        episode: tuple(texts[task] for task in tasks if task in texts)
        for episode, tasks in used.items()
    }


def read_tasks(root: Path) -> dict[int, str]:
    """Return the text of each task by its index, from either form of meta/tasks.parquet."""
    names = ("task", "__index_level_0__")
    table = read_parquet(root / "meta" / "tasks.parquet", ["task_index"], optional=names)
    texts = next((table[name] for name in names if name in table), None)
    if texts is None:
        raise InputError("meta/tasks.parquet has neither an index of texts nor a column task.")
    pairs = zip(table["task_index"], texts, strict=True)
    return {index: text for index, text in pairs if isinstance(text, str)}


def _data_path(root: Path, info: Mapping[str, Any], fields: Mapping[str, Any]) -> Path | None:
    """Return the table of an episode's rows; None if the dataset does not name it."""
    try:
        fields = {name: _count(value, name) for name, value in fields.items()}
        return _fill(root, info.get("data_path"), fields, what="data_path")
    except InputError:
        return None


def _fill(root: Path, template: object, fields: Mapping[str, int | str], *, what: str) -> Path:
    """Fill in a path template of info.json, which may hold only plain fields."""
    # str.format would also resolve attributes and items, and pad to gigabytes.
    parts = []
    try:
        for text, name, form, conversion in string.Formatter().parse(str(template)):
            parts.append(text)
            if name is None:
                continue
            width = (form or "").removesuffix("d")
            if (
                name not in fields
                or conversion
                or (width and not width.isdecimal())
                or len(width) > 2
            ):
                raise ValueError(f"field {quote(name)}")
            parts.append(format(fields[name], form) if form else str(fields[name]))
    except ValueError as error:
        raise InputError(
            f"meta/info.json: {what} is {quote(template)}: {quote_text(str(error))} cannot be "
            f"filled in; fields are {', '.join(fields)}."
        ) from error
    return inside(root, "".join(parts), what=f"meta/info.json: {what}")


def _count(value: Any, name: str, *, minimum: int = 0) -> int:
    if type(value) is not int or not minimum <= value < max(MAX_EPISODES, MAX_FRAMES):
        raise InputError(f"{name} is {quote(value)}, not a whole number of at least {minimum}.")
    return value


def _time(value: Any, name: str) -> float:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not 0 <= value < 1e6:
        raise InputError(f"{name} is {quote(value)}, not a time in seconds.")
    return float(value)


def _texts(value: Any) -> tuple[str, ...]:
    texts = value if isinstance(value, list) else [value]
    return tuple(text for text in texts if isinstance(text, str))
