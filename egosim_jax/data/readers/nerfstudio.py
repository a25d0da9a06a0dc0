"""nerfstudio captures: transforms.json with images, poses, intrinsics and maybe depth.

`transform_matrix` is camera to world in OpenGL's axes (x right, y up, z backward), which are
converted to OpenCV's; the world stays the file's. Pixel coordinates start at the corner of the
image, so half a pixel is subtracted. Depth files are in millimeters. The unit of poses is
arbitrary, unless the user says that it is meters (as in Polycam and Record3D captures). Frames are
sorted by file name. Followed: nerfstudio 1.1, `nerfstudio_dataparser.py`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import tyro

from egosim_jax.data.readers import Entry, inside, make_id, natural_order
from egosim_jax.data.readers.colmap import make_rate
from egosim_jax.data.readers.images import MAX_IMAGES, ImageVideo, write_images
from egosim_jax.data.readers.lenses import Lens
from egosim_jax.data.readers.rotations import OPENCV_FROM_OPENGL
from egosim_jax.data.recorded_files import DepthFiles
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import quote, quote_path, read_json
from egosim_jax.io.images import read_image
from egosim_jax.types import InputError

MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE")
"""Supported camera models."""
MAX_SPREAD = 0.01
"""Maximum relative difference of focal lengths between frames; the median is used."""


@dataclass(frozen=True, kw_only=True)
class Nerfstudio:
    """nerfstudio capture: images, cameras and depth."""

    dataset: ClassVar[str] = "nerfstudio"
    source: Annotated[Path, tyro.conf.Positional]
    """Folder with transforms.json, or a file in that format."""
    fps: float
    """Frame rate of the images, sorted by name; the file does not hold it."""
    metric: bool = False
    """True if poses are in meters."""

    def find(self) -> Iterator[Entry]:
        """List the one capture of the source."""
        path = self.source if self.source.is_file() else self.source / "transforms.json"
        if not path.is_file():
            raise InputError(f"{self.source} has no transforms.json.")
        yield Entry(
            recording_id=make_id([path.resolve().parent.name]),
            read=partial(self._read, path),
            source=path,
            options={"--fps": str(self.fps), "--metric": str(self.metric)},
        )

    def _read(self, path: Path, folder: Path) -> Recording:
        fps = make_rate(self.fps)
        written = read_json(path, limit=1 << 27)
        entries = written.get("frames") if isinstance(written, dict) else None
        if not isinstance(entries, list) or not 0 < len(entries) <= MAX_IMAGES:
            raise InputError(f"{quote_path(path)}: frames must be a list of 1 to {MAX_IMAGES:,}.")
        for number, entry in enumerate(entries):
            if not isinstance(entry, dict):
                raise InputError(f"{quote_path(path)}: frame {number} is {quote(entry)}.")
        images = [(inside(path.parent, e.get("file_path"), what="file_path"), e) for e in entries]
        images.sort(key=lambda pair: natural_order(pair[0]))
        frames = [entry for _, entry in images]
        lens = _read_lens(written, frames, path)
        poses = np.stack([_pose(entry, path) for entry in frames]) @ OPENCV_FROM_OPENGL
        video = write_images(folder, (read_image(p) for p, _ in images), lens, fps)
        return Recording(
            recording_id=make_id([path.resolve().parent.name]),
            video=video.path,
            frames=video.frames,
            fps=fps,
            height=video.height,
            width=video.width,
            world_from_camera=poses,
            intrinsics_px=video.intrinsics_px,
            metric=self.metric,
            depth=_find_depth(path.parent, frames, video),
            provenance={"lens": "pinhole" if video.remap is None else "remapped"},
        )


def _read_lens(written: Mapping[str, Any], frames: list[dict[str, Any]], path: Path) -> Lens:
    model = written.get("camera_model", "OPENCV")
    if model not in MODELS:
        raise InputError(
            f"{quote_path(path)}: camera_model is {quote(model)}; expected {', '.join(MODELS)}."
        )

    def value(name: str, default: float | None = None) -> float:
        """Return the number for all frames, or the median of the frames' own numbers."""
        found = [written[name]] if name in written else [e.get(name, default) for e in frames]
        for item in found:
            if isinstance(item, bool) or not isinstance(item, (int, float)) or not abs(item) < 1e6:
                raise InputError(f"{quote_path(path)}: {name} is {quote(item)}, not a number.")
        median = float(np.median(found))
        if np.ptp(found) > MAX_SPREAD * max(abs(median), 1):
            raise InputError(
                f"{quote_path(path)}: {name} is from {min(found):g} to {max(found):g}: all frames "
                "must have one camera. Split the capture."
            )
        return median

    fx = value("fl_x")
    fy = value("fl_y", fx)
    fisheye = model == "OPENCV_FISHEYE"
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return Lens(
        model="fisheye" if fisheye else "brown",
        coefficients=tuple(value(name, 0.0) for name in names),
        intrinsics_px=np.array([[fx, 0, value("cx") - 0.5], [0, fy, value("cy") - 0.5], [0, 0, 1]]),
        height=int(value("h")),
        width=int(value("w")),
    )


def _pose(entry: Mapping[str, Any], path: Path) -> np.ndarray:
    try:
        matrix = np.array(entry.get("transform_matrix"), float)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0, 0, 0, 1]])
    if matrix.shape != (4, 4):
        raise InputError(
            f"{quote_path(path)}: the transform_matrix of {quote(entry.get('file_path'))} must be "
            "4 x 4 numbers."
        )
    return matrix


def _find_depth(root: Path, frames: list[dict[str, Any]], video: ImageVideo) -> DepthFiles | None:
    """Return depth files; None if the images were remapped, because depth is not."""
    names = [entry.get("depth_file_path") for entry in frames]
    if not any(names) or video.remap is not None:
        return None
    paths = [name and inside(root, name, what="depth_file_path") for name in names]
    return DepthFiles(paths=tuple(path or None for path in paths), unit_m=0.001)
