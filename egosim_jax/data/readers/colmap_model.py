"""COLMAP's sparse models, text and binary, read without COLMAP and bounded by the file's size.

    cameras.{txt,bin}, images.{txt,bin}, points3D.{txt,bin}

A pose takes world to camera, as a quaternion w x y z and a translation, in OpenCV axes; pixel
centers are at half integers there, so that half a pixel is subtracted here. The unit is arbitrary.
Followed: COLMAP 3.9 to 4.2, whose rigs and frames are not needed.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int, UInt8

from egosim_jax.data.readers.lenses import Lens
from egosim_jax.data.readers.rotations import make_poses
from egosim_jax.geometry import invert
from egosim_jax.io.bounded import quote, quote_path, quote_text, read_bytes
from egosim_jax.types import InputError

MAX_BYTES = 1 << 30
"""Largest file of a model in bytes."""
MAX_VALUE = 1e12
"""Largest coordinate, color or error of a point."""
MODELS = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5),
          4: ("OPENCV", 8), 5: ("OPENCV_FISHEYE", 8)}  # fmt: skip
"""Camera models that are read, by number: name and number of parameters."""
_NUMBERS = {name: number for number, (name, _) in MODELS.items()}


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Image:
    """Image of a model."""

    image_id: int
    name: str
    camera_id: int
    world_from_camera: Float[np.ndarray, "4 4"]
    """Pose in OpenCV axes, in the model's unit."""
    pixels_px: Float[np.ndarray, "n 2"]
    """Column and row of each keypoint."""
    point_ids: Int[np.ndarray, " n"]
    """Point of each keypoint; -1 where it has none."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Model:
    """Cameras, images and points of a sparse model."""

    lenses: Mapping[int, Lens]
    """Lens of each camera by id."""
    images: tuple[Image, ...]
    """Images that the COLMAP model registered."""
    point_ids: Int[np.ndarray, " p"]
    points_m: Float[np.ndarray, "p 3"]
    """Positions in the model's unit."""
    colors: UInt8[np.ndarray, "p 3"]
    error_px: Float[np.ndarray, " p"]
    """Mean reprojection error of each point, in pixels."""


def read_model(folder: Path) -> Model:
    """Read a model. Raises `InputError` if files are missing, damaged or of unknown cameras."""
    suffix = ".bin" if (folder / "images.bin").exists() else ".txt"
    read = _BINARY if suffix == ".bin" else _TEXT
    parts = {}
    for name, parse in read.items():
        path = folder / f"{name}{suffix}"
        data = read_bytes(path, limit=MAX_BYTES)
        try:
            parts[name] = parse(data)
        except (ValueError, struct.error, IndexError, OverflowError) as error:
            if isinstance(error, InputError):
                raise
            raise InputError(
                f"{quote_path(path)} is damaged: {quote_text(str(error))}. Export the model again."
            ) from error
    ids, points, colors, errors = parts["points3D"]
    images = parts["images"]
    unknown = {image.camera_id for image in images} - parts["cameras"].keys()
    if unknown or not images:
        raise InputError(
            f"{quote_path(folder)} has {len(images)} registered images, with cameras that are "
            f"not listed: {quote(str(sorted(unknown)))}."
        )
    return Model(lenses=parts["cameras"], images=images, point_ids=ids, points_m=points,
                 colors=colors, error_px=errors)  # fmt: skip


def make_lens(model: str, width: int, height: int, parameters: list[float]) -> Lens:
    """Return the lens of a camera, with pixel centers at integers."""
    if model not in _NUMBERS:
        raise InputError(
            f"The camera model {quote_text(model)} is not read; {', '.join(_NUMBERS)} are. "
            "Undistort the images with COLMAP first."
        )
    if len(parameters) != MODELS[_NUMBERS[model]][1]:
        raise ValueError(f"a {model} camera has {len(parameters)} parameters")
    one_focal = model.startswith("SIMPLE") or model == "RADIAL"
    fx, fy, cx, cy, *k = [parameters[0], *parameters] if one_focal else parameters
    if model == "OPENCV_FISHEYE":
        coefficients = tuple(k)
    else:
        k1, k2, p1, p2 = [*k, 0.0, 0.0, 0.0, 0.0][:4]
        coefficients = (k1, k2, p1, p2, 0.0)
    return Lens(
        model="fisheye" if model == "OPENCV_FISHEYE" else "brown",
        coefficients=coefficients,
        intrinsics_px=np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]),
        height=height,
        width=width,
    )


class _Bytes:
    """Reader of packed values, which never reads beyond the end."""

    def __init__(self, data: bytes):
        self._data, self._at = data, 0

    def unpack(self, form: str) -> tuple:
        values = struct.unpack_from("<" + form, self._data, self._at)
        self._at += struct.calcsize("<" + form)
        return values

    def count(self, least: int) -> int:
        """Return a number of records of at least so many bytes each, which must fit the file."""
        (count,) = self.unpack("Q")
        if count > (len(self._data) - self._at) // least:
            raise ValueError(f"it declares {count} records, more than fit its size")
        return count

    def array(self, dtype: np.dtype, count: int) -> np.ndarray:
        values = np.frombuffer(self._data, dtype, count=count, offset=self._at)
        self._at += values.nbytes
        return values

    def text(self) -> str:
        end = self._data.index(b"\0", self._at)
        text = self._data[self._at : end].decode("utf-8")
        self._at = end + 1
        return text


def _cameras_binary(data: bytes) -> dict[int, Lens]:
    file, found = _Bytes(data), {}
    for _ in range(file.count(24)):
        number, model, width, height = file.unpack("iiQQ")
        name, count = MODELS.get(model, (f"number {model}", 0))
        parameters = list(file.unpack(f"{count}d"))
        found[number] = make_lens(name, width, height, parameters)
    return found


_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])


def _images_binary(data: bytes) -> tuple[Image, ...]:
    file, found = _Bytes(data), []
    for _ in range(file.count(73)):
        number, *pose, camera = file.unpack("I7dI")
        name = file.text()
        keypoints = file.array(_KEYPOINT, file.count(_KEYPOINT.itemsize))
        found.append(_image(number, name, camera, pose, keypoints["xy"], keypoints["point"]))
    return tuple(found)


def _points_binary(data: bytes) -> tuple[np.ndarray, ...]:
    file, rows = _Bytes(data), []
    for _ in range(file.count(51)):
        rows.append(file.unpack("Q3d3Bd"))
        file.array(np.dtype("<u8"), file.count(8))
    return _points(rows)


def _cameras_text(data: bytes) -> dict[int, Lens]:
    found = {}
    for line in _lines(data):
        number, model, width, height, *parameters = line.split()
        values = [float(value) for value in parameters]
        found[int(number)] = make_lens(model, int(width), int(height), values)
    return found


def _images_text(data: bytes) -> tuple[Image, ...]:
    lines, found = list(_lines(data, blank=True)), []
    while lines and not lines[-1].strip():
        lines.pop()
    for number in range(0, len(lines), 2):
        head = lines[number].split(maxsplit=9)
        values = np.array((lines[number + 1 : number + 2] or [""])[0].split(), float).reshape(-1, 3)
        pose = [float(value) for value in head[1:8]]
        points = values[:, 2].astype(np.int64)
        found.append(_image(int(head[0]), head[9], int(head[8]), pose, values[:, :2], points))
    return tuple(found)


def _points_text(data: bytes) -> tuple[np.ndarray, ...]:
    return _points([[float(value) for value in line.split()[:8]] for line in _lines(data)])


def _lines(data: bytes, *, blank: bool = False) -> Iterator[str]:
    for line in data.decode("utf-8").split("\n"):
        if not line.startswith("#") and (blank or line.strip()):
            yield line


def _image(
    number: int, name: str, camera: int, pose: list[float], pixels: np.ndarray, points: np.ndarray
) -> Image:
    qw, qx, qy, qz, *translation = pose
    camera_from_world = make_poses(np.array([[qx, qy, qz, qw]]), np.array([translation]))
    return Image(
        image_id=number,
        name=name,
        camera_id=camera,
        world_from_camera=invert(camera_from_world)[0],
        pixels_px=pixels - 0.5,
        point_ids=np.asarray(points, np.int64),
    )


def _points(rows: list) -> tuple[np.ndarray, ...]:
    table = np.array(rows, float).reshape(len(rows), 8)
    if not (np.abs(table[:, 1:]) < MAX_VALUE).all():
        raise ValueError("a point is not finite, or implausible")
    colors = np.clip(table[:, 4:7], 0, 255).astype(np.uint8)
    return table[:, 0].astype(np.int64), table[:, 1:4], colors, table[:, 7]


_BINARY: dict[str, Callable] = {
    "cameras": _cameras_binary, "images": _images_binary, "points3D": _points_binary,
}  # fmt: skip
_TEXT: dict[str, Callable] = {
    "cameras": _cameras_text, "images": _images_text, "points3D": _points_text,
}  # fmt: skip
