"""Clips of EgoSim's data preparation: a video with cameras from Depth Anything 3.

    video_16fps.mp4 or video.mp4, caption.txt
    _proc/poses_da3_smoothed or _proc/poses_da3, at any depth:
        extrinsics_000000.npy `4 4`, world to camera, OpenCV axes; intrinsics_000000.npy `3 3`;
        depth_000000.npy `h w` of the first frame

Smoothed poses are preferred. Of a clip without any, video and caption are kept, and with some, the
frames before the first one without a pose. Pixel centers are at integers, because
the release back-projects points from integers. It runs DA3NESTED-GIANT-LARGE-1.1, which estimates
meters, so `metric` is True, up to its error; the files do not name their network. Hands come from
HaMeR's results in _proc/mano_full (`hamer`), if they exist. Followed: jinkun-hao/EgoSim of 2026,
`data_process`.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import tyro

from egosim_jax.data.pairing import pair_rows
from egosim_jax.data.readers import Entry, check_one_camera, make_id, natural_order, numbered
from egosim_jax.data.readers.egovid import read_matrices
from egosim_jax.data.readers.hamer import read_hamer
from egosim_jax.data.readers.hands import with_joints
from egosim_jax.data.recorded_files import DepthFiles
from egosim_jax.data.recording import Recording
from egosim_jax.geometry import invert
from egosim_jax.io.bounded import quote_path, read_bytes
from egosim_jax.io.video import VideoInfo, probe_video
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)

VIDEOS = ("video_16fps.mp4", "video.mp4")
"""Names of the video; poses belong to the first."""
MAX_DRIFT = 0.02
"""Maximum relative change of the focal length over the frames; the median is used."""
MAX_CAPTION_BYTES = 10_000
"""Maximum size of a caption in bytes."""


@dataclass(frozen=True, kw_only=True)
class EgoSimClips:
    """Clips of EgoSim's data preparation: cameras, caption, depth of the first frame."""

    dataset: ClassVar[str] = "egosim"
    source: Annotated[Path, tyro.conf.Positional]
    """Folder of one clip, or folder of such folders."""

    def find(self) -> Iterator[Entry]:
        """List the folders with a video and `_proc`."""
        folders = [self.source] if (self.source / "_proc").is_dir() else sorted(
            (path.parent for path in self.source.glob("*/_proc")), key=natural_order
        )  # fmt: skip
        if not folders:
            raise InputError(f"{self.source} has no folder _proc, in it or one level below.")
        for folder in folders:
            yield Entry(
                recording_id=make_id([folder.resolve().name]),
                read=partial(_read, folder),
                source=folder,
            )


def _read(clip: Path, folder: Path) -> Recording:
    video = next((clip / name for name in VIDEOS if (clip / name).exists()), None)
    if video is None:
        raise InputError(f"{quote_path(clip)} has none of {', '.join(VIDEOS)}.")
    info = probe_video(video)
    info.check_square(quote_path(video))
    poses_folder = _find_poses(clip / "_proc")
    if poses_folder is None:
        logger.warning("%s: cameras and hands stay unknown: no extrinsics_*.npy", quote_path(clip))
        return _of_video(clip, video, info)
    paths, found = _numbered(poses_folder)
    rows = pair_rows(video, info, found, what="extrinsics")
    rows = rows[rows < len(paths)]
    poses = invert(np.stack([read_matrices(path, (4, 4)) for path in paths]))
    lenses = [path.with_name(path.name.replace("extrinsics", "intrinsics")) for path in paths]
    cameras = [read_matrices(path, (3, 3)) for path in lenses if path.exists()]
    notes, intrinsics = {"scale": "estimated by Depth Anything 3"}, None
    if cameras:
        intrinsics = np.median(cameras, axis=0)
        focal_px = np.stack(cameras)[:, 0, 0]
        drift = check_one_camera(focal_px, quote_path(poses_folder), most=MAX_DRIFT)
        notes["focal_drift"] = f"{drift:.4f}"
    else:
        logger.warning("%s: intrinsics and hands stay unknown", quote_path(lenses[0]))
    depth = poses_folder / "depth_000000.npy"
    files = (depth if depth.exists() else None, *[None] * (len(rows) - 1))
    recording = replace(
        _of_video(clip, video, info),
        frames=len(rows),
        world_from_camera=poses[rows],
        intrinsics_px=intrinsics,
        metric=True,
        depth=DepthFiles(paths=files, unit_m=1.0) if files[0] else None,
        provenance={"poses": str(poses_folder.relative_to(clip)), **notes},
    )
    hands = sorted((clip / "_proc" / "mano_full").rglob("*.json"))
    if not hands or recording.cameras is None:
        return recording
    cameras = replace(recording.cameras, world_from_camera=poses)
    return with_joints(recording, read_hamer(hands[0], cameras, info)[rows])


def _of_video(clip: Path, video: Path, info: VideoInfo) -> Recording:
    """Return the recording of a clip with its caption, without cameras."""
    caption = clip / "caption.txt"
    text = ""
    if caption.exists():
        text = read_bytes(caption, limit=MAX_CAPTION_BYTES).decode("utf-8-sig", "replace").strip()
    return Recording.of_video(
        video, info, caption=text or None, provenance={"poses": "unknown: none"}
    )


def _numbered(folder: Path) -> tuple[list[Path], int]:
    """Return the extrinsics of the frames from 0 to the first gap, and the number of all."""
    files = numbered(folder.glob("extrinsics_*.npy"))
    first = next(number for number in range(len(files) + 1) if number not in files)
    if not first:
        raise InputError(
            f"{quote_path(folder)} has no extrinsics_000000.npy: frames are numbered from 0. Run "
            "DA3 on the whole video."
        )
    if first < len(files):
        logger.warning(
            "%s has %d extrinsics, but none of frame %d: only the frames before it are used",
            quote_path(folder), len(files), first,
        )  # fmt: skip
    return [files[number] for number in range(first)], len(files)


def _find_poses(folder: Path) -> Path | None:
    """Return the folder of extrinsics, or None; smoothed ones are preferred."""
    found = sorted({path.parent for path in folder.rglob("extrinsics_*.npy")})
    smoothed = [path for path in found if "smoothed" in str(path.relative_to(folder))]
    return next(iter((*smoothed, *found)), None)
