"""Find and open the videos and recordings to annotate, each with a unique id."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from egosim_jax.data.pairing import by_frame
from egosim_jax.data.readers import numbered
from egosim_jax.data.recorded_files import DESCRIPTION, DepthFiles
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import listing, quote_path
from egosim_jax.io.video import VIDEO_SUFFIXES, probe_video
from egosim_jax.types import InputError

DEPTH_SUFFIXES = {".png": 0.001, ".npy": 1.0}
"""Suffix of depth maps -> unit in meters."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A video file or the folder of a recording."""

    name: str
    """Unique id; the ids of the clips begin with it."""
    path: Path
    """Video file or recording folder."""


def find_sources(paths: Sequence[Path]) -> list[Source]:
    """Return the videos and recordings at the paths: files, or folders of them.

    Raises `InputError` if a path does not exist or holds neither, or if two sources have one id.
    """
    videos: list[Path] = []
    for path in paths:
        if path.is_dir():
            videos += _inside(path)
        elif path.exists():
            videos.append(path)
        else:
            raise InputError(f"{quote_path(path)} does not exist.")
    videos = list(dict.fromkeys(path.resolve() for path in videos))
    names = [_name(path, 1) for path in videos]
    names = [
        name if names.count(name) == 1 else _name(path, 2)
        for path, name in zip(videos, names, strict=True)
    ]
    doubles = [
        quote_path(path) for path, name in zip(videos, names, strict=True) if names.count(name) > 1
    ]
    if doubles:
        raise InputError(
            f"Videos with the same id: {listing(doubles)}. Ids are made from the names of a file "
            "and its folder: rename some, or annotate them to different folders."
        )
    return [Source(name=name, path=path) for name, path in zip(names, videos, strict=True)]


def open_source(
    source: Source, depth_files: Path | None = None, depth_unit_m: float | None = None
) -> Recording:
    """Return the recording of a source; for a video, it has only length, size and frame rate.

    `depth_files` is a folder of depth maps: ID/N.png (millimeters) or ID/N.npy (meters) for frame N
    of the video, optionally with the prefix `depth_`. `depth_unit_m` replaces the unit of all
    depth. Raises `InputError` if a file cannot be read.
    """
    if source.path.is_dir():
        recording = Recording.load(source.path)
    else:
        info = probe_video(source.path)
        recording = Recording(
            recording_id=source.name,
            video=source.path,
            frames=info.frames,
            fps=info.fps,
            height=info.height,
            width=info.width,
        )
    if depth_files is not None:
        recording = _with_depth(recording, depth_files)
    if depth_unit_m is None or recording.depth is None:
        return recording
    return replace(recording, depth=replace(recording.depth, unit_m=depth_unit_m))


def _with_depth(recording: Recording, folder: Path) -> Recording:
    target = folder / recording.recording_id
    for suffix, unit_m in DEPTH_SUFFIXES.items():
        files = numbered(target.glob(f"*{suffix}"))
        if files:
            info = probe_video(recording.video)
            files = by_frame(files, recording.video, info, what=f"depth maps (*{suffix})")
            paths = tuple(files.get(frame) for frame in _frame_numbers(recording, float(info.fps)))
            return replace(recording, depth=DepthFiles(paths=paths, unit_m=unit_m))
    raise InputError(
        f"{quote_path(target)} has no depth maps: they are named 000000.png (16 bits, millimeters) "
        "or 000000.npy (meters), by frame. (--depth)"
    )


def _frame_numbers(recording: Recording, fps: float) -> list[int]:
    """Return the number in the video of each frame of a recording, from 0 at its constant rate."""
    if recording.times_s is None:
        return list(range(recording.start, recording.start + recording.frames))
    return np.floor(recording.times_s * fps + 0.5 + 1e-6).astype(int).tolist()


def _inside(folder: Path) -> list[Path]:
    """Return the recordings and videos in a folder, without the videos of recordings.

    Hidden files and folders are skipped: a crash may leave a part of an import in one.
    """
    if (folder / DESCRIPTION).is_file():
        return [folder]
    files = [
        path
        for path in sorted(folder.rglob("*"))
        if not any(name.startswith(".") for name in path.relative_to(folder).parts)
    ]
    recordings = [path.parent for path in files if path.name == DESCRIPTION]
    videos = [
        path
        for path in files
        if path.suffix.lower() in VIDEO_SUFFIXES
        and not path.is_dir()
        and not any(parent in path.parents for parent in recordings)
    ]
    if not recordings and not videos:
        raise InputError(
            f"{quote_path(folder)} holds no video ({', '.join(VIDEO_SUFFIXES)}) and no recording "
            "(`egosim data import`)."
        )
    return recordings + videos


def _name(path: Path, parts: int) -> str:
    """Return an id made from the last parts of a path, in characters allowed in ids.

    A file called `video`, as in many datasets, is named after its folders only.
    """
    last = path.name if path.is_dir() else path.stem
    end = len(path.parts) - 1
    kept = [*path.parts[max(1, end - parts) : end]] if last == "video" else [
        *path.parts[max(1, end - parts + 1) : end], last
    ]  # fmt: skip
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", "_".join(kept)).strip("_")
    return name[:120] or "video"
