"""nerfstudio captures: transforms.json with images, poses, intrinsics and maybe depth.

`transform_matrix` is camera to world in OpenGL's axes (x right, y up, z backward), which are
converted to OpenCV's; the world stays the file's. Pixel coordinates start at the corner of the
image, so half a pixel is subtracted. Depth files are in millimeters. The unit of poses is
arbitrary, unless the user says that it is meters (as in Polycam and Record3D captures). Frames are
sorted by file name; the longest run without gaps is the recording. Keys that may change cameras or
poses and are not read are refused. Followed: nerfstudio 1.1, `nerfstudio_dataparser.py`, and
instant-ngp's `is_fisheye`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import tyro

from egosim_jax.data.readers import Entry, inside, make_id, make_rate, natural_order
from egosim_jax.data.readers.images import (
    MAX_IMAGES,
    describe_run,
    longest_run,
    read_posed,
    write_images,
)
from egosim_jax.data.readers.lenses import MAX_SPREAD, Lens
from egosim_jax.data.readers.rotations import OPENCV_FROM_OPENGL
from egosim_jax.data.recorded_files import DepthFiles
from egosim_jax.data.recording import Recording
from egosim_jax.io.bounded import quote, quote_path, read_json
from egosim_jax.types import InputError, is_rigid

MODELS = (
    "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV_FISHEYE"
)  # fmt: skip
"""Supported camera models."""
READ = frozenset({
    "frames", "file_path", "transform_matrix", "depth_file_path", "camera_model", "is_fisheye",
    "fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2",
    "applied_scale",
})  # fmt: skip
"""Keys that are read."""
WITHOUT_EFFECT = frozenset({
    "applied_transform", "orientation_override", "auto_scale_poses_override", "aabb_scale",
    "scale", "offset", "camera_angle_x", "camera_angle_y", "integer_depth_scale",
    "camera_linear_velocity", "camera_angular_velocity", "rolling_shutter_time",
})  # fmt: skip
"""Keys without effect: on the world of a trained scene, repeated elsewhere, or without our use."""
_MEANING = re.compile(
    r"camera|cam_|lens|fish|distort|rectif|projection|equirect|panoram|spher|ortho|latlong|omni|"
    r"stereo|theta|transform|pose|rotat|orient|convention|coord|axis|axes|flip|mirror|unit|metric|"
    r"scale|shift|offset|crop|resiz|downs|fov|angle|focal|principal|skew|shutter|mitsuba|"
    r"^f[xy]$|^fl_|^[ckps][xy0-9]+$"
)
"""Words of keys that may change cameras or poses."""


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
        problems = {str(image): _problem(image, entry, path) for image, entry in images}
        names = [str(image.relative_to(path.parent)) for image, _ in images]
        run = longest_run(list(problems), lambda name: problems[name] is None)
        images = [images[index] for index in run]
        if not images:
            raise InputError(next(filter(None, problems.values())))
        frames = [entry for _, entry in images]
        check_keys(written, frames, path)
        lens = _read_lens(written, frames, path)
        self._check_scale(written, path)
        poses = np.stack([_pose(entry) for entry in frames]) @ OPENCV_FROM_OPENGL
        pixels = (read_posed(image, lens) for image, _ in images)
        recording, remap = write_images(folder, pixels, lens, fps)
        return replace(
            recording,
            world_from_camera=poses,
            intrinsics_px=(remap or lens).intrinsics_px,
            metric=self.metric,
            depth=_find_depth(path.parent, frames) if remap is None else None,  # not remapped
            provenance={
                "lens": "pinhole" if remap is None else "remapped",
                **describe_run(names, run),
            },
        )

    def _check_scale(self, written: Mapping[str, Any], path: Path) -> None:
        """Raise `InputError` if poses that the user calls metric were scaled."""
        scale = written.get("applied_scale", 1)
        if self.metric and scale != 1:
            raise InputError(
                f"{quote_path(path)}: applied_scale is {quote(scale)}: its poses were scaled and "
                "are not in meters. Divide the translations by it and remove it, or omit --metric."
            )


def check_keys(written: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Raise `InputError` for a key that may change cameras or poses, and that is not read.

    A key whose value is empty, false or zero changes nothing.
    """
    unread = {
        key: value
        for part in (written, *frames)
        for key, value in part.items()
        if key not in READ and key not in WITHOUT_EFFECT and _MEANING.search(key.lower())
    }
    for key, value in unread.items():
        if np.any(np.array(value, object) != 0) if isinstance(value, list) else value:
            raise InputError(
                f"{quote_path(path)} has the key {quote(key)}, which is not read and may change "
                "cameras or poses. Remove it if it changes neither; else convert the capture to "
                "OPENCV or OPENCV_FISHEYE cameras and OpenGL poses."
            )


def _read_model(written: Mapping[str, Any], frames: Sequence[Mapping[str, Any]], path: Path) -> str:
    """Return the camera model of all frames; `is_fisheye` is the name that instant-ngp uses."""

    def one(name: str, default: Any) -> Any:
        found = [entry.get(name, written.get(name, default)) for entry in frames]
        if any(item != found[0] for item in found):
            raise InputError(
                f"{quote_path(path)}: frames have several values of {name}: one camera must have "
                "taken all. Split the capture."
            )
        return found[0]

    fisheye = one("is_fisheye", default=False)
    model = one("camera_model", default="OPENCV_FISHEYE" if fisheye is True else "OPENCV")
    if model not in MODELS:
        raise InputError(
            f"{quote_path(path)}: camera_model is {quote(model)}; expected {', '.join(MODELS)}. "
            "Undistort the images first."
        )
    if not isinstance(fisheye, bool) or (fisheye and model != "OPENCV_FISHEYE"):
        raise InputError(
            f"{quote_path(path)}: is_fisheye is {quote(fisheye)} and camera_model {quote(model)}, "
            "which contradict each other. Remove the wrong one."
        )
    return str(model)


def _read_lens(written: Mapping[str, Any], frames: list[dict[str, Any]], path: Path) -> Lens:
    fisheye = _read_model(written, frames, path) == "OPENCV_FISHEYE"

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
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    for name in {"k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"} - set(names):
        if value(name, 0.0):
            raise InputError(
                f"{quote_path(path)}: {name} is {value(name, 0.0):g}: a lens "
                f"{'OPENCV_FISHEYE' if fisheye else 'OPENCV'} has only {', '.join(names)}. Check "
                "camera_model, or undistort the images first."
            )
    return Lens(
        model="fisheye" if fisheye else "brown",
        coefficients=tuple(value(name, 0.0) for name in names),
        intrinsics_px=np.array([[fx, 0, value("cx") - 0.5], [0, fy, value("cy") - 0.5], [0, 0, 1]]),
        height=int(value("h")),
        width=int(value("w")),
    )


def _pose(entry: Mapping[str, Any]) -> np.ndarray:
    """Return the pose of a frame; an array of another shape if it has none."""
    try:
        matrix = np.array(entry.get("transform_matrix"), float)
    except (TypeError, ValueError):
        return np.zeros(0)
    return np.vstack([matrix, [0, 0, 0, 1]]) if matrix.shape == (3, 4) else matrix


def _problem(image: Path, entry: Mapping[str, Any], path: Path) -> str | None:
    """Return why a frame cannot be used, or None."""
    pose, name = _pose(entry), quote(entry.get("file_path"))
    if pose.shape != (4, 4):
        return f"{quote_path(path)}: the transform_matrix of {name} must be 4 x 4 numbers."
    if not is_rigid(pose[None])[0]:
        return (
            f"{quote_path(path)}: the transform_matrix of {name} is not a rigid transform: it must "
            "be finite, with a rotation of determinant 1. Register the images again."
        )
    return None if os.path.lexists(image) else f"{quote_path(image)} is missing."


def _find_depth(root: Path, frames: list[dict[str, Any]]) -> DepthFiles | None:
    names = [entry.get("depth_file_path") for entry in frames]
    if not any(names):
        return None
    paths = [name and inside(root, name, what="depth_file_path") for name in names]
    return DepthFiles(paths=tuple(path or None for path in paths), unit_m=0.001)
