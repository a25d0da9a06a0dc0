"""Write simulated episodes as a LeRobot dataset, version 3.0.

    meta/info.json meta/stats.json meta/tasks.parquet
    meta/episodes/chunk-000/file-000.parquet   length, tasks and file of each episode
    meta/egosim/episode_000000/                initial scene of the episode
    data/chunk-000/file-000.parquet            rows of episode 0; the next one is file-001

A row has the frame as a lossless PNG (feature of dtype image), and two float32 vectors of hands and
camera: `observation.state` at that frame and `action` at the next frame. The joints of the hands,
the pose of the camera and its intrinsics are also stored as float64, in the columns `HANDS`,
`POSES` and `INTRINSICS`, and so are other vectors. The first frame of a clip replaces the last
frame of the clip before.

Statistics (meta/stats.json) are of each episode: minimum, maximum, mean, standard deviation and
quantiles. The dataset's quantiles are their means, weighted by the number of frames; the other
statistics are exact. Images are sampled. `lerobot` estimates the quantiles by histograms of 5000
bins; ours are exact.
Followed: `lerobot` 0.4.4, `datasets/lerobot_dataset.py`, `datasets/utils.py`,
`datasets/compute_stats.py`.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, Int, Shaped, UInt8
from PIL import Image

from egosim_jax.io.atomic import atomic_folder
from egosim_jax.io.bounded import quote_path
from egosim_jax.io.run import write_json
from egosim_jax.types import Action, Cameras, InputError

IMAGE, STATE, ACTION = "observation.images.ego", "observation.state", "action"
HANDS = "observation.hands.joints_m"
"""Joints of all hands in the world, in meters, hand by hand; NaN where a hand is missing."""
POSES = "observation.camera.world_from_camera"
"""Rows of the camera's 4x4 pose in the world, in OpenCV axes."""
INTRINSICS = "observation.camera.intrinsics_px"
"""Rows of the camera's 3x3 matrix in pixels."""
SCENE = "meta/egosim/episode_{:06d}"
"""Folder of the initial scene of an episode."""
CHUNK = 1000
"""Number of files in a folder."""
PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
"""Quantiles by name."""
SAMPLES, POWER = (100, 10_000), 0.75
"""Minimum and maximum number of sampled images of an episode, and the power of its length."""
SMALL_PX, SAMPLED_PX = 300, 150
"""Side from which images are sampled, and about the side to which, in pixels."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class ClipRecord:
    """Clip of an episode with its action."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """Frames of the clip."""
    rows: Float[np.ndarray, "f d"]
    """Row of hands and camera at each frame."""
    action: Action
    """Cameras, joints of the hands and caption of the clip."""
    images: Mapping[str, UInt8[np.ndarray, "f h w 3"]] = field(default_factory=dict)
    """Frames of further cameras, by the name of their feature (`image_feature`)."""
    others: Mapping[str, Shaped[np.ndarray, "f ..."]] = field(default_factory=dict)
    """Other vectors or numbers of each frame, by the name of their feature."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class EpisodeRecord:
    """Consecutive clips that start from a scene."""

    clips: Iterable[ClipRecord]
    """Clips of the episode, consumed one by one."""
    save_scene: Callable[[Path], None]
    """Function that writes the initial scene of the episode to a folder."""


@dataclass
class _Totals:
    tasks: dict[str, int] = field(default_factory=dict)
    episodes: list[dict[str, Any]] = field(default_factory=list)
    frames: int = 0
    sizes: set[tuple[int, ...]] = field(default_factory=set)
    images: tuple[str, ...] = ()
    vectors: dict[str, dict[str, Any]] = field(default_factory=dict)
    statistics: dict[str, list[dict[str, np.ndarray]]] = field(default_factory=dict)


def image_feature(camera: str) -> str:
    """Return the name of a further camera's feature."""
    return f"observation.images.{camera}"


def camera_vectors(camera: str, cameras: Cameras) -> dict[str, Float[np.ndarray, "f _"]]:
    """Return pose and intrinsics of a further camera at each frame, by the name of the feature."""
    poses = np.asarray(cameras.world_from_camera, float).reshape(-1, 16)
    intrinsics = np.asarray(cameras.intrinsics_px, float).reshape(1, 9)
    return {
        POSES.replace("camera", f"camera.{camera}", 1): poses,
        INTRINSICS.replace("camera", f"camera.{camera}", 1): intrinsics.repeat(len(poses), axis=0),
    }


def check_new(folder: Path) -> None:
    """Raise `InputError` unless a path is free or an empty folder."""
    if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise InputError(
            f"{quote_path(folder)} exists and is not empty: a dataset needs a new or an empty "
            "folder. Choose another one, or remove it first. (--out)"
        )


def write_lerobot(
    folder: Path,
    episodes: Iterable[EpisodeRecord],
    *,
    names: Sequence[str],
    fps: int | Fraction,
    robot_type: str,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write a dataset, complete or absent; `names` are the names of the numbers in a row.

    `about` is added to the description in meta/info.json.

    Clips are read from `episodes` and written one by one. Raises `InputError` if there is nothing
    to write, if clips differ in size, if the folder holds files, or without pyarrow.
    """
    check_new(folder)
    if find_spec("pyarrow") is None:
        raise InputError(
            "A LeRobot dataset is written by pyarrow, which is not installed: pip install "
            "'egosim-jax[video]'."
        )
    totals = _Totals()
    with atomic_folder(folder) as temporary:
        for episode in episodes:
            episode.save_scene(temporary / SCENE.format(len(totals.episodes)))
            _write_episode(temporary, episode.clips, totals, fps)
        if not totals.episodes:
            raise InputError("There are no episodes: a dataset needs at least one. Record one.")
        _write_meta(temporary, totals, fps=fps, robot_type=robot_type, names=names, about=about)


def _steps(
    clips: Iterable[ClipRecord], totals: _Totals
) -> Iterator[tuple[dict[str, np.ndarray], str, dict[str, np.ndarray]]]:
    """Yield images, prompt and vectors of each step; the action of the last step is its own row."""
    last = None
    for last in clips:
        totals.sizes.add(last.frames.shape[1:3])
        if len(totals.sizes) > 1:
            raise InputError(
                f"The episodes have clips of the sizes {sorted(totals.sizes)}: all must have one "
                "size. Export them separately."
            )
        for number in range(len(last.frames) - 1):
            yield _images(last, number), last.action.prompt, _numbers(last, number)
    if last is None:
        raise InputError("An episode has no clip: it needs at least one. Remove it.")
    number = len(last.frames) - 1
    yield _images(last, number), last.action.prompt, _numbers(last, number)


def _images(clip: ClipRecord, frame: int) -> dict[str, np.ndarray]:
    """Return the images of a frame by name, the main camera's first."""
    others = {name: frames[frame] for name, frames in clip.images.items()}
    return {IMAGE: clip.frames[frame], **others}


def _numbers(clip: ClipRecord, frame: int) -> dict[str, np.ndarray]:
    """Return the vectors of a frame by name."""
    cameras, following = clip.action.cameras, min(frame + 1, len(clip.rows) - 1)
    return {
        STATE: clip.rows[frame].astype(np.float32),
        ACTION: clip.rows[following].astype(np.float32),
        HANDS: clip.action.joints_m[frame].astype(float).ravel(),
        POSES: np.asarray(cameras.world_from_camera[frame], float).ravel(),
        INTRINSICS: np.asarray(cameras.intrinsics_px, float).ravel(),
        **{name: np.asarray(values[frame]) for name, values in clip.others.items()},
    }


def _write_episode(
    folder: Path,
    clips: Iterable[ClipRecord],
    totals: _Totals,
    fps: int | Fraction,
) -> None:
    number, prompts, steps = len(totals.episodes), [], []
    images: dict[str, list[dict[str, Any]]] = {}
    counted: dict[str, list[np.ndarray]] = {}
    for shown, prompt, step in _steps(clips, totals):
        for name, image in shown.items():
            counted.setdefault(name, []).append(levels(image))
            images.setdefault(name, []).append({"bytes": _png(image), "path": None})
        prompts.append(prompt)
        totals.tasks.setdefault(prompt, len(totals.tasks))
        steps.append(step)
    vectors = {name: np.stack([step[name] for step in steps]) for name in steps[0]}
    if totals.images not in ((), tuple(images)):
        raise InputError(
            f"The episodes have the images {list(totals.images)} and {list(images)}: all must have "
            "the same cameras. Export them separately."
        )
    totals.images = tuple(images)
    for name, of_image in counted.items():
        totals.statistics.setdefault(name, []).append(image_statistics(of_image))
    for name, values in vectors.items():
        totals.vectors[name] = {"dtype": values.dtype.name, "shape": list(values.shape[1:]) or [1]}
        table = values.reshape(len(values), -1).astype(float)
        totals.statistics.setdefault(name, []).append(vector_statistics(table))
    count, first = len(steps), totals.frames
    columns = {
        **images,
        **{name: list(values) for name, values in vectors.items()},
        "timestamp": (np.arange(count) / float(fps)).astype(np.float32),
        "frame_index": np.arange(count),
        "episode_index": np.full(count, number),
        "index": np.arange(first, first + count),
        "task_index": np.array([totals.tasks[prompt] for prompt in prompts]),
    }
    place = {"chunk_index": number // CHUNK, "file_index": number % CHUNK}
    _write_table(folder / PATH.format(**place), columns, images=totals.images)
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


def _write_table(path: Path, columns: dict[str, Any], *, images: Sequence[str] = ()) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    image = pa.struct({"bytes": pa.binary(), "path": pa.string()})
    short = pa.list_(pa.float32())
    types = {STATE: short, ACTION: short, "timestamp": pa.float32()}
    types |= dict.fromkeys(images, image)
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
    *,
    fps: int | Fraction,
    robot_type: str,
    names: Sequence[str],
    about: Mapping[str, Any] | None,
) -> None:
    """Write description, statistics, tasks and files of the episodes."""
    rows = {key: [episode[key] for episode in totals.episodes] for key in totals.episodes[0]}
    _write_table(folder / "meta/episodes/chunk-000/file-000.parquet", rows)
    _write_tasks(folder / "meta/tasks.parquet", totals.tasks)
    frames = totals.frames
    stats = {key: aggregate(episodes) for key, episodes in totals.statistics.items()}
    write_json(folder / "meta/stats.json", stats)
    (size,) = totals.sizes
    vector = {"dtype": "float32", "shape": [len(names)], "names": list(names)}
    exact = {
        name: {**feature, "names": None}
        for name, feature in totals.vectors.items()
        if name not in (STATE, ACTION)
    }
    image = {"dtype": "image", "shape": [*size, 3], "names": ["height", "width", "channels"]}
    counters = {name: {"dtype": "int64", "shape": [1], "names": None} for name in COUNTERS}
    info = {
        **(about or {}),
        "codebase_version": "v3.0",
        "robot_type": robot_type,
        "total_episodes": len(totals.episodes),
        "total_frames": frames,
        "total_tasks": len(totals.tasks),
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": int(fps) if fps == int(fps) else float(fps),
        "splits": {"train": f"0:{len(totals.episodes)}"},
        "data_path": PATH,
        "video_path": None,
        "features": {
            **dict.fromkeys(totals.images, image),
            STATE: vector,
            ACTION: vector,
            **exact,
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            **counters,
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


def vector_statistics(values: Float[np.ndarray, "n d"]) -> dict[str, np.ndarray]:
    """Return the statistics of an episode's vectors, without NaN; NaN where there is no number."""
    figures = {name: np.full(values.shape[1], np.nan) for name in ("min", "max", "mean", "std")}
    figures |= {name: np.full(values.shape[1], np.nan) for name in QUANTILES}
    for number, column in enumerate(values.T):
        numbers = column[~np.isnan(column)]
        if len(numbers):
            figures["min"][number], figures["max"][number] = numbers.min(), numbers.max()
            figures["mean"][number], figures["std"][number] = numbers.mean(), numbers.std()
            for name, value in zip(
                QUANTILES, np.quantile(numbers, [*QUANTILES.values()]), strict=True
            ):
                figures[name][number] = value
    return {**figures, "count": np.array([len(values)])}


def levels(image: UInt8[np.ndarray, "h w 3"]) -> Int[np.ndarray, "3 256"]:
    """Return how many pixels of an image have each value, by channel; large images are sampled."""
    height, width = image.shape[:2]
    step = max(height, width) // SAMPLED_PX if max(height, width) >= SMALL_PX else 1
    pixels = image[::step, ::step].reshape(-1, 3)
    return np.stack([np.bincount(channel, minlength=256) for channel in pixels.T])


def image_statistics(images: Sequence[Int[np.ndarray, "3 256"]]) -> dict[str, np.ndarray]:
    """Return the statistics of an episode's images from 0 to 1, from the `levels` of each image."""
    least, most = SAMPLES
    count = max(min(least, len(images)), min(int(len(images) ** POWER), most))
    chosen = np.round(np.linspace(0, len(images) - 1, count)).astype(int)
    counts = np.sum([images[n] for n in chosen.tolist()], axis=0)
    values, total = np.arange(256) / 255, counts.sum(axis=1)
    mean = counts @ values / total
    variance = np.maximum(counts @ values**2 / total - mean**2, 0)
    ranks = np.cumsum(counts, axis=1)
    at = {"min": 0.0, **QUANTILES, "max": 1.0}
    figures = {
        name: np.array([values[_rank(row, share)] for row in ranks]) for name, share in at.items()
    }
    figures |= {"mean": mean, "std": np.sqrt(variance)}
    return {name: value.reshape(3, 1, 1) for name, value in figures.items()} | {
        "count": np.array([count])
    }


def _rank(ranks: Int[np.ndarray, " v"], share: float) -> int:
    """Return the index of the value below which a share of the pixels is."""
    return int(np.searchsorted(ranks, max(share * ranks[-1], 1)))


def aggregate(episodes: Sequence[dict[str, np.ndarray]]) -> dict[str, Any]:
    """Return the statistics of a dataset from its episodes, as JSON."""
    stacked = {name: np.stack([e[name] for e in episodes]) for name in episodes[0]}
    counts = stacked.pop("count")
    mean, deviation = stacked.pop("mean"), stacked.pop("std")
    weights = counts.reshape(-1, *[1] * (mean.ndim - 1)) * ~np.isnan(mean)
    total = np.where(weights.sum(axis=0) > 0, weights.sum(axis=0), np.nan)

    def average(values: np.ndarray) -> np.ndarray:
        return np.nansum(weights * np.nan_to_num(values), axis=0) / total

    center = average(mean)
    figures = {
        "min": np.fmin.reduce(stacked.pop("min")),
        "max": np.fmax.reduce(stacked.pop("max")),
        "mean": center,
        "std": np.sqrt(average(deviation**2 + (mean - center) ** 2)),
        **{name: average(values) for name, values in stacked.items()},
    }
    return {name: value.tolist() for name, value in figures.items()} | {
        "count": counts.sum(axis=0).tolist()
    }
