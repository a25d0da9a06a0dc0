"""LeRobot datasets, version 3.0, of episodes that were simulated.

    meta/info.json meta/stats.json meta/tasks.parquet
    meta/episodes/chunk-000/file-000.parquet   length, tasks and place of each episode
    data/chunk-000/file-000.parquet            rows of episode 0; the next one is file-001

A row has the frame as a PNG, which loses nothing (feature of dtype image), `observation.state`, the
row of hands and camera at that frame, and `action`, that of the next frame; both are float32. The
clips of an episode follow each other: the first frame of a clip takes the place of the last one of
the clip before. Followed: `lerobot` 0.4.4, `datasets/lerobot_dataset.py`, `datasets/utils.py`.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from egosim_jax.io.atomic import atomic_folder
from egosim_jax.io.run import write_json
from egosim_jax.io.untrusted import quote_path
from egosim_jax.types import InputError

IMAGE, STATE, ACTION = "observation.images.ego", "observation.state", "action"
CHUNK = 1000
"""Files in a folder."""
PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")


@no_type_check
@dataclass(frozen=True, kw_only=True)
class ClipRecord:
    """Clip of an episode with its action."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """Frames of the clip."""
    rows: Float[np.ndarray, "f d"]
    """Row of hands and camera at each frame."""
    prompt: str
    """Caption of the clip."""


@dataclass
class _Statistics:
    """Running minimum, maximum, mean and standard deviation of a feature."""

    shape: tuple[int, ...]
    count: int = 0
    low: Any = np.inf
    high: Any = -np.inf
    total: Any = 0.0
    squares: Any = 0.0

    def add(self, values: Float[np.ndarray, "n d"]) -> None:
        self.count += len(values)
        self.low = np.minimum(self.low, values.min(axis=0))
        self.high = np.maximum(self.high, values.max(axis=0))
        self.total = self.total + values.sum(axis=0)
        self.squares = self.squares + np.square(values).sum(axis=0)

    def result(self, frames: int) -> dict[str, Any]:
        mean = self.total / self.count
        deviation = np.sqrt(np.maximum(self.squares / self.count - mean**2, 0))
        named = {"min": self.low, "max": self.high, "mean": mean, "std": deviation}
        found = {name: np.reshape(value, self.shape).tolist() for name, value in named.items()}
        return {**found, "count": [frames]}


@dataclass
class _Totals:
    tasks: dict[str, int] = field(default_factory=dict)
    episodes: list[dict[str, Any]] = field(default_factory=list)
    frames: int = 0
    sizes: set[tuple[int, ...]] = field(default_factory=set)


def check_new(folder: Path) -> None:
    """Raise `InputError` unless nothing exists at a path, or an empty folder."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise InputError(
            f"{quote_path(folder)} exists and is not empty: a dataset needs a new or an empty "
            "folder. Choose another one, or remove it first. (--out)"
        )


def write_lerobot(
    folder: Path,
    episodes: Iterable[Iterable[ClipRecord]],
    *,
    names: Sequence[str],
    fps: int,
    robot_type: str,
) -> None:
    """Write a dataset, complete or absent; `names` are those of the numbers of a row.

    One clip after the other is taken from `episodes` and written.
    Raises `InputError` if there is nothing to write, if clips differ in size, if the folder holds
    files, or without pyarrow.
    """
    check_new(folder)
    if find_spec("pyarrow") is None:
        raise InputError(
            "A LeRobot dataset is written by pyarrow, which is not installed: pip install "
            "'egosim-jax[video]'."
        )
    statistics = {
        IMAGE: _Statistics((3, 1, 1)),
        STATE: _Statistics((len(names),)),
        ACTION: _Statistics((len(names),)),
    }
    totals = _Totals()
    with atomic_folder(folder) as temporary:
        for clips in episodes:
            _write_episode(temporary, clips, totals, statistics, fps)
        if not totals.episodes:
            raise InputError("There are no episodes: a dataset needs at least one. Record one.")
        _write_meta(temporary, totals, statistics, fps=fps, robot_type=robot_type,
                    names=names)  # fmt: skip


def _steps(
    clips: Iterable[ClipRecord], totals: _Totals
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, str]]:
    """Yield frame, row, next row and prompt; the last frame of all holds its row."""
    last = None
    for last in clips:
        totals.sizes.add(last.frames.shape[1:3])
        if len(totals.sizes) > 1:
            raise InputError(
                f"The episodes have clips of the sizes {sorted(totals.sizes)}: all must have one "
                "size. Export them separately."
            )
        for frame, row, following in zip(last.frames, last.rows[:-1], last.rows[1:], strict=False):
            yield frame, row, following, last.prompt
    if last is None:
        raise InputError("An episode has no clip: it needs at least one. Remove it.")
    yield last.frames[-1], last.rows[-1], last.rows[-1], last.prompt


def _write_episode(
    folder: Path,
    clips: Iterable[ClipRecord],
    totals: _Totals,
    statistics: dict[str, _Statistics],
    fps: int,
) -> None:
    number, pictures, steps = len(totals.episodes), [], []
    for frame, *step in _steps(clips, totals):
        statistics[IMAGE].add(frame.reshape(-1, 3) / 255)
        pictures.append({"bytes": _png(frame), "path": None})
        steps.append(step)
    states, actions = (np.stack([step[i] for step in steps]).astype(np.float32) for i in (0, 1))
    prompts = [prompt for *_, prompt in steps]
    for prompt in prompts:
        totals.tasks.setdefault(prompt, len(totals.tasks))
    statistics[STATE].add(states.astype(float))
    statistics[ACTION].add(actions.astype(float))
    count, first = len(steps), totals.frames
    columns = {
        IMAGE: pictures,
        STATE: list(states),
        ACTION: list(actions),
        "timestamp": (np.arange(count) / fps).astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, number),
        "index": np.arange(first, first + count),
        "task_index": np.array([totals.tasks[prompt] for prompt in prompts]),
    }
    place = {"chunk_index": number // CHUNK, "file_index": number % CHUNK}
    _write_table(folder / PATH.format(**place), columns)
    totals.frames += count
    totals.episodes.append(
        {
            "episode_index": number,
            "tasks": list(dict.fromkeys(prompts)),
            "length": count,
            "dataset_from_index": first,
            "dataset_to_index": first + count,
            **{f"data/{name}": value for name, value in place.items()},
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
    )


def _write_table(path: Path, columns: dict[str, Any]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    picture = pa.struct({"bytes": pa.binary(), "path": pa.string()})
    vector = pa.list_(pa.float32())
    types = {IMAGE: picture, STATE: vector, ACTION: vector, "timestamp": pa.float32()}
    arrays = {
        name: pa.array(values, types.get(name, pa.int64() if name in COUNTERS else None))
        for name, values in columns.items()
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(arrays), path)


def _png(frame: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(frame).save(data, "PNG")
    return data.getvalue()


def _write_meta(
    folder: Path,
    totals: _Totals,
    statistics: dict[str, _Statistics],
    *,
    fps: int,
    robot_type: str,
    names: Sequence[str],
) -> None:
    """Write description, statistics, tasks and places of the episodes."""
    rows = {key: [episode[key] for episode in totals.episodes] for key in totals.episodes[0]}
    _write_table(folder / "meta/episodes/chunk-000/file-000.parquet", rows)
    _write_tasks(folder / "meta/tasks.parquet", totals.tasks)
    frames = totals.frames
    stats = {key: found.result(frames) for key, found in statistics.items()}
    write_json(folder / "meta/stats.json", stats)
    (size,) = totals.sizes
    vector = {"dtype": "float32", "shape": [len(names)], "names": list(names)}
    picture = {"dtype": "image", "shape": [*size, 3], "names": ["height", "width", "channels"]}
    own = {name: {"dtype": "int64", "shape": [1], "names": None} for name in COUNTERS}
    info = {
        "codebase_version": "v3.0",
        "robot_type": robot_type,
        "total_episodes": len(totals.episodes),
        "total_frames": frames,
        "total_tasks": len(totals.tasks),
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(totals.episodes)}"},
        "data_path": PATH,
        "video_path": None,
        "features": {
            IMAGE: picture,
            STATE: vector,
            ACTION: vector,
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            **own,
        },
    }
    write_json(folder / "meta/info.json", info)


def _write_tasks(path: Path, tasks: dict[str, int]) -> None:
    """Write the tasks as pandas does, with the texts as the index."""
    import json

    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pa.table(
        {"task_index": pa.array(list(tasks.values()), pa.int64()), "__index_level_0__": list(tasks)}
    )
    about = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", "pandas_type": "int64",
             "numpy_type": "int64", "metadata": None},
            {"name": None, "field_name": "__index_level_0__", "pandas_type": "unicode",
             "numpy_type": "object", "metadata": None},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), path)
