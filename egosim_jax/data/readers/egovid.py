"""EgoVid-5M: clips of Ego4D with captions, and for some of them camera poses.

    *.csv                   video_id `<uuid>_<start>_<end>`, name, llava_cap, noun_cls, ...
    poses/<video_id>/       intri.npy `3 3` at 540 rows, fused_pose.npy or sfm_pose.npy `f 4 4`
    <video_id>.mp4          clips, or Ego4D's videos <uuid>.mp4, cut to frames start to end
                            (exclusive)

The dataset documents neither the direction of the poses (camera to world or the reverse) nor the
pixel centers. The direction is decided from the video by epipolar geometry (`pose_reading`) and
recorded; poses stay unknown if the video does not decide. Pixel centers are assumed at integers.
Of a clip with more frames than poses, the frames with poses are used. The fused poses are structure
from motion scaled by an accelerometer. That scale is not trusted, so `metric` is False. The dataset
has no hands. Followed: its README of 2025.
"""

from __future__ import annotations

import csv
import io
import logging
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import tyro
from jaxtyping import Float

from egosim_jax.data.pairing import check_lengths, pair_rows
from egosim_jax.data.readers import Entry, find_files, make_id
from egosim_jax.data.readers.pose_reading import read_poses
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import open_regular, quote_path, quote_text, read_bytes
from egosim_jax.io.segments import probe_long_video, read_segment
from egosim_jax.io.untrusted.npz import read_npy
from egosim_jax.io.video import VideoInfo
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)

POSES = ("fused_pose.npy", "sfm_pose.npy")
"""Files of poses, the recommended one first."""
ROWS = 540
"""Height in pixels of the images that the intrinsics are for."""
MAX_NPY_BYTES = 1 << 24
"""Maximum size of a file of poses in bytes."""
MAX_LINE = 1 << 20
"""Maximum length of a line in a table, in characters."""
_ID = re.compile(r"([A-Za-z0-9-]+)_(\d{1,9})_(\d{1,9})")


@dataclass(frozen=True, kw_only=True)
class EgoVid:
    """EgoVid-5M: captions, and cameras where the dataset has them."""

    dataset: ClassVar[str] = "egovid"
    source: Annotated[Path, tyro.conf.Positional]
    """Folder with the CSV files and poses/, or one CSV file in it."""
    videos: Path | None = None
    """Folder with the videos at any depth; by default the folder of the CSV file."""

    def find(self) -> Iterator[Entry]:
        """List the rows whose video exists; the tables name more videos than users download."""
        root = self.source if self.source.is_dir() else self.source.parent
        folder = self.videos or root
        videos = {path.stem: path for path in sorted(folder.rglob("*.mp4"))}
        if not videos:
            raise InputError(f"{folder} holds no .mp4 files at any depth. (--videos)")
        for table in find_files(self.source, "*.csv", kind="table of EgoVid-5M"):
            for row in _rows(table):
                video_id = row["video_id"].removesuffix(".mp4")
                uuid, _, _ = _split(video_id)
                if video_id not in videos and uuid not in videos:
                    continue
                video = videos.get(video_id) or videos[uuid]
                yield Entry(
                    recording_id=make_id([video_id]),
                    read=partial(_read, root, video, video_id, row),
                    source=video,
                )


def _read(
    root: Path, video: Path, video_id: str, row: Mapping[str, str], folder: Path
) -> Recording:
    uuid, start, stop = _split(video_id)
    info = probe_long_video(video)
    if video.stem == uuid and video.stem != video_id:
        frames = max(0, min(stop, info.frames) - start)
        if frames < stop - start:
            why = f"frames {start} to {stop - 1}, and {quote_path(video)} has {info.frames}"
            if not frames:
                raise InputError(f"{video_id} is {why}. Download the complete video.")
            logger.warning("%s is %s: the first %d are used", video_id, why, frames)
    else:
        start, frames = 0, info.frames
    notes: dict[str, str] = {}
    poses = intrinsics = None
    path = root / "poses" / video_id
    if path.is_dir() and re.fullmatch(_ID, video_id):
        rows, poses, intrinsics, notes = _read_cameras(path, video, info, start, frames)
        frames = frames if rows is None else len(rows)
    caption = row.get("llava_cap", "").strip() or row.get("name", "").strip()
    nouns = [noun.strip() for noun in row.get("noun_cls", "").split(",")]
    return Recording(
        recording_id=make_id([video_id]),
        video=video,
        start=start,
        frames=frames,
        fps=info.fps,
        height=info.height,
        width=info.width,
        world_from_camera=poses,
        intrinsics_px=intrinsics,
        caption=caption or None,
        names=tuple(noun for noun in nouns if noun and not noun.lstrip("-").isdecimal()),
        provenance=notes,
    )


def _read_cameras(
    folder: Path, video: Path, info: VideoInfo, start: int, frames: int
) -> tuple[np.ndarray | None, np.ndarray | None, Float[np.ndarray, "3 3"], dict[str, str]]:
    """Return the row of each frame and its pose, both None if unknown, intrinsics and notes."""
    path = next((folder / name for name in POSES if (folder / name).exists()), None)
    if path is None:
        raise InputError(f"{quote_path(folder)} has none of {', '.join(POSES)}.")
    intrinsics = read_matrices(folder / "intri.npy", (3, 3))
    intrinsics[:2] *= info.height / ROWS
    matrices = read_matrices(path, (None, 4, 4))
    try:
        if start == 0 and frames == info.frames:
            rows = pair_rows(video, info, len(matrices), what="poses")
        else:
            fps = float(info.fps)
            rows = np.arange(check_lengths(video, frames, len(matrices), fps=fps, what="poses"))
    except InputError as error:
        logger.warning("%s Its poses stay unknown.", error)
        why = f"unknown: {len(matrices)} poses for {frames} frames"
        return None, None, intrinsics, {"poses": why}
    decoded = read_segment(video, start=start, count=len(rows), each=_halve).frames
    scale = np.diag([0.5, 0.5, 1.0])
    poses, evidence = read_poses(decoded, matrices[rows], scale @ intrinsics)
    if poses is None:
        rows = None
    return rows, poses, intrinsics, {**evidence, "poses_file": path.name}


def _halve(frame: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def read_matrices(path: Path, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return the finite numbers of an npy file as float64; None in a shape allows any size."""
    name = quote_path(path)
    try:
        values = read_npy(read_bytes(path, limit=MAX_NPY_BYTES), name)
    except ValueError as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{name} is not a readable npy file: {quote_text(str(error))}.") from error
    fits = values.ndim == len(shape)
    if not fits or any(n not in (None, size) for size, n in zip(values.shape, shape, strict=True)):
        raise InputError(f"{name} has shape {values.shape}; expected {shape}.")
    if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise InputError(f"{name} holds {values.dtype} that are not all finite numbers.")
    return values.astype(np.float64)


def _split(video_id: str) -> tuple[str, int, int]:
    match = _ID.fullmatch(video_id)
    return (match[1], int(match[2]), int(match[3])) if match else (video_id, 0, 0)


def _rows(path: Path) -> Iterator[dict[str, str]]:
    """Yield the rows of a table one by one; a table may have gigabytes."""
    name = quote_path(path)
    try:
        with open_regular(path) as file:
            text = io.TextIOWrapper(file, encoding="utf-8-sig", newline="")
            lines = iter(lambda: text.readline(MAX_LINE), "")
            reader = csv.DictReader(lines, strict=True)
            reader.fieldnames = [name.strip() for name in reader.fieldnames or ()]
            if "video_id" not in reader.fieldnames:
                raise InputError(f"{name} has no column video_id.")
            for row in reader:
                cells = {k: v.strip() for k, v in row.items() if k and isinstance(v, str)}
                if cells.get("video_id"):
                    yield cells
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{name} cannot be read as CSV: {quote_text(str(error))}.") from error
