"""EgoVid-5M: clips of Ego4D with captions, and for some of them camera poses.

    *.csv                   video_id `<uuid>_<start>_<end>`, name, llava_cap, noun_cls, ...
    poses/<video_id>/       intri.npy `3 3` at 540 rows, fused_pose.npy or sfm_pose.npy `f 4 4`
    <video_id>.mp4          clips, or Ego4D's videos <uuid>.mp4, cut to frames start to end
                            (exclusive)

The dataset documents neither the direction of the poses (camera to world or the reverse) nor the
pixel centers. The direction is decided from the video and recorded: tracks of points satisfy the
epipolar constraint of the right direction only. The evidence is the median Sampson distance in
pixels (Hartley and Zisserman, Multiple View Geometry, 11.4.3). Poses stay unknown if the video does
not decide. Pixel centers are assumed at integers.
Of a clip with more frames than poses, the frames with poses are used, unless poses at another rate
fit the video better. Poses without intrinsics stay unknown. The fused poses are structure from
motion scaled by an accelerometer. That scale is not trusted, so `metric` is False. The dataset has
no hands. Followed: its README of 2025.
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
from jaxtyping import Float, UInt8

from egosim_jax.data.pairing import pair_rows
from egosim_jax.data.readers import Entry, find_files, make_id
from egosim_jax.data.recording import Recording
from egosim_jax.geometry import invert
from egosim_jax.io.bounded import open_regular, quote_path, quote_text, read_bytes, refusing
from egosim_jax.io.untrusted.npz import read_npy
from egosim_jax.io.video import VideoInfo, probe_video, read_video
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
PAIRS = 6
"""Number of frame pairs to compare."""
GAP = 8
"""Distance between the frames of a pair."""
MIN_TRACKS = 20
"""Minimum number of tracks for a pair to count."""
MAX_ERROR_PX = 3.0
"""Maximum median Sampson distance of an accepted reading, in pixels."""
MIN_RATIO = 1.5
"""Minimum ratio between the two readings' distances for a decision."""
RATE = "other_rate"
"""Reading of poses that are as many for the whole clip as its frames at another rate."""
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
    info = probe_video(video)
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
        poses, intrinsics, notes = _read_cameras(path, video, info, start, frames)
        frames = frames if poses is None else len(poses)
    caption = row.get("llava_cap", "").strip() or row.get("name", "").strip()
    nouns = [noun.strip() for noun in row.get("noun_cls", "").split(",")]
    return Recording.of_video(
        video,
        info,
        start=start,
        frames=frames,
        world_from_camera=poses,
        intrinsics_px=intrinsics,
        caption=caption or None,
        names=tuple(noun for noun in nouns if noun and not noun.lstrip("-").isdecimal()),
        provenance=notes,
    )


def _read_cameras(
    folder: Path, video: Path, info: VideoInfo, start: int, frames: int
) -> tuple[np.ndarray | None, np.ndarray | None, dict[str, str]]:
    """Return the poses of the first frames and the intrinsics, None if unknown, and notes."""
    try:
        intrinsics = read_matrices(folder / "intri.npy", (3, 3))
    except InputError as error:
        logger.warning("%s The poses stay unknown.", error)
        return None, None, {"poses": "unknown: no intrinsics"}
    intrinsics[:2] *= info.height / ROWS
    path = next((folder / name for name in POSES if (folder / name).exists()), None)
    if path is None:
        none = f"{quote_path(folder)} has none of {', '.join(POSES)}"
        logger.warning("%s. The poses stay unknown.", none)
        return None, intrinsics, {"poses": "unknown: none"}
    matrices = read_matrices(path, (None, 4, 4))
    rows, other = np.arange(min(frames, len(matrices))), None
    try:
        rows = pair_rows(video, info, len(matrices), what="poses", frames=frames)
    except InputError:
        other = matrices[rows * len(matrices) // frames]
    fewer = f"{len(matrices)} poses for {frames} frames"
    scale = np.diag([0.5, 0.5, 1.0])
    poses, evidence = None, {"poses": "unknown: none"}
    if len(rows):
        decoded = read_video(video, start=start, stop=start + len(rows), whole=True, each=_halve)
        poses, evidence = _direct(decoded.frames, matrices[rows], other, scale @ intrinsics)
    if poses is None:
        logger.warning("%s: %s stay %s", quote_path(path), fewer, evidence["poses"])
    elif other is not None:
        logger.warning("%s: %s: the first %d of both are used", quote_path(path), fewer, len(rows))
    return poses, intrinsics, {**evidence, "poses_file": path.name}


def _halve(frame: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)


def read_matrices(path: Path, shape: tuple[int | None, ...]) -> np.ndarray:
    """Return the finite numbers of an npy file as float64; None in a shape allows any size."""
    name = quote_path(path)
    with refusing(f"{name} is not a readable npy file"):
        values = read_npy(read_bytes(path, limit=MAX_NPY_BYTES), name)
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


def _direct(
    frames: UInt8[np.ndarray, "f h w 3"],
    matrices: Float[np.ndarray, "f 4 4"],
    other: Float[np.ndarray, "f 4 4"] | None,
    intrinsics_px: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "f 4 4"] | None, Mapping[str, str]]:
    """Return `world_from_camera` by the reading that fits the video, or None; and the evidence.

    `other` has the poses of the frames if the poses are of another rate: they must not fit better.
    """
    readings = {"camera_to_world": matrices, "world_to_camera": invert(matrices)}
    if other is not None:
        readings |= {f"{RATE}_camera_to_world": other, f"{RATE}_world_to_camera": invert(other)}
    errors: dict[str, list[float]] = {name: [] for name in readings}
    for start in np.linspace(0, max(0, len(frames) - 1 - GAP), PAIRS).astype(int).tolist():
        stop = min(start + GAP, len(frames) - 1)
        points, moved = _track(frames[start], frames[stop])
        if len(points) < MIN_TRACKS:
            continue
        for name, poses in readings.items():
            relative = invert(poses[stop]) @ poses[start]
            errors[name].append(_sampson_px(relative, points, moved, intrinsics_px))
    medians = {n: float(np.median(e)) if e else float("nan") for n, e in errors.items()}
    evidence = {f"epipolar_error_px_{name}": f"{value:.2f}" for name, value in medians.items()}
    best, opposite = sorted([*readings][:2], key=lambda name: medians[name])
    clear = medians[best] <= MAX_ERROR_PX and medians[opposite] >= MIN_RATIO * medians[best]
    if min(medians.values()) < medians[best]:
        return None, {"poses": "unknown: at another rate they fit the video better", **evidence}
    if not clear:
        return None, {"poses": "unknown: no reading clearly fits the video", **evidence}
    return readings[best], {"poses": best, **evidence}


def _track(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels in the first frame and in the second, tracked forward and backward."""
    import cv2

    gray = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in (first, second)]
    points = cv2.goodFeaturesToTrack(gray[0], 400, 0.01, 5)
    if points is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    there, found, _ = cv2.calcOpticalFlowPyrLK(gray[0], gray[1], points, points.copy())
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(gray[1], gray[0], there, there.copy())
    good = np.asarray(found, bool)[:, 0] & np.asarray(found_back, bool)[:, 0]
    good &= np.linalg.norm(back - points, axis=-1)[:, 0] < 0.5
    return points[good, 0].astype(float), there[good, 0].astype(float)


def _sampson_px(
    relative: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "n 2"],
    moved: Float[np.ndarray, "n 2"],
    intrinsics_px: Float[np.ndarray, "3 3"],
) -> float:
    """Return the median Sampson distance in pixels for a pose `second_from_first`."""
    x, y, z = relative[:3, 3] / max(float(np.linalg.norm(relative[:3, 3])), 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = np.linalg.inv(intrinsics_px)
    fundamental = inverse.T @ cross @ relative[:3, :3] @ inverse
    one = np.ones((len(points), 1))
    first, second = np.hstack([points, one]), np.hstack([moved, one])
    lines, back = first @ fundamental.T, second @ fundamental
    size = np.hypot.reduce([*lines[:, :2].T, *back[:, :2].T])
    distance = np.abs((second * lines).sum(axis=1)) / np.maximum(size, 1e-12)
    return float(np.median(distance))
