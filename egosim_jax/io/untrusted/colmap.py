"""Sparse models of COLMAP, read by pycolmap in a child process.

    cameras, images and points3D, each .bin or .txt

The rigs and frames of COLMAP 3.12 and later are not needed: images have the same poses. A pose
takes world to camera in OpenCV axes, in an arbitrary unit. COLMAP has the center of the first
pixel at (0.5, 0.5). In the arrays here it is at (0, 0).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Float, Int32, UInt8

from egosim_jax.io.bounded import quote_path, read_bytes, refusing
from egosim_jax.io.untrusted.isolated import MAX_ADDRESSES, TIMEOUT_S, read_file

MAX_BYTES = 1 << 30
"""Maximum size of each file of a model in bytes."""
MAX_VALUE = 1e12
"""Maximum coordinate or error of a point."""
PARTS = ("cameras", "images", "points3D")
MAX_SIDE_PX = 1 << 16


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Camera of a model, as COLMAP has it: its principal point is half a pixel larger than ours."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Image:
    """Registered image of a model."""

    name: str
    camera_id: int
    camera_from_world: Float[np.ndarray, "4 4"]
    pixels_px: Float[np.ndarray, "n 2"]
    """Column and row of each keypoint that observes a point."""
    observed: Int32[np.ndarray, " n"]
    """Index of the point that each keypoint observes."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Model:
    """Cameras, images in order of their names, and points in order of their ids."""

    cameras: Mapping[int, Camera]
    images: tuple[Image, ...]
    points: Float[np.ndarray, "p 3"]
    colors: UInt8[np.ndarray, "p 3"]
    error_px: Float[np.ndarray, " p"]
    """Mean reprojection error of each point, in pixels."""


def read_model(folder: Path) -> Model:
    """Read a model. Raises `InputError` if files are missing, too large or damaged."""
    suffix = ".bin" if (folder / "images.bin").exists() else ".txt"
    with TemporaryDirectory(prefix="egosim_colmap_") as name:
        for part in PARTS:
            data = read_bytes(folder / f"{part}{suffix}", limit=MAX_BYTES)
            (Path(name) / f"{part}{suffix}").write_bytes(data if suffix == ".bin" else _plain(data))
        return read_file(
            _read, folder, Path(name), suffix, max_memory=MAX_ADDRESSES, max_cpu_s=TIMEOUT_S
        )


def _plain(data: bytes) -> bytes:
    """Return a text with line feeds and single spaces, as pycolmap reads it.

    pycolmap keeps the carriage return of an image's name, and drops the last image if no line of
    keypoints follows it.
    """
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    data = re.sub(rb" +", b" ", data.replace(b"\t", b" "))
    return re.sub(rb" ?\n ?", b"\n", data).strip(b" ") + b"\n\n"


def _read(folder: Path, copy: Path, suffix: str) -> Model:
    """Read the copy of a model; this runs in the child."""
    import pycolmap

    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    with refusing(f"{quote_path(folder)} is damaged or too large, export the model again"):
        model = pycolmap.Reconstruction()
        if suffix == ".bin":
            for part in PARTS:
                _check_size(part, (copy / f"{part}.bin").read_bytes())
            model.read_binary(copy)
        else:
            _check_rotations(copy / "images.txt")
            model.read_text(copy)
        if any(
            not 0 < side <= MAX_SIDE_PX
            for c in model.cameras.values()
            for side in (c.width, c.height)
        ):
            raise ValueError("a camera has an impossible image size")
        found = to_arrays(model)
        numbers = np.column_stack([found.points, found.error_px])
        if not (np.abs(numbers) < MAX_VALUE).all():
            raise ValueError("a point is not finite, or implausible")
        return found


def _check_size(part: str, data: bytes) -> None:
    """Raise `ValueError` or `struct.error` unless the records that a binary file counts fill it.

    pycolmap does not check this: it reads on after the end, and allocates what a count asks for.
    """
    import pycolmap

    number, end = struct.Struct("<Q").unpack_from, 8
    for _ in range(number(data)[0]):
        if part == "cameras":
            model = pycolmap.CameraModelId(*struct.unpack_from("<i", data, end + 4))
            parameters = pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params
            end += 24 + 8 * len(parameters)
        elif part == "images":  # a pose, a name that ends with 0, and keypoints
            _check_rotation(struct.unpack_from("<4d", data, end + 4))
            end = data.index(b"\0", end + 64) + 1
            end += 8 + 24 * number(data, end)[0]
        else:  # a point and its track
            end += 51 + 8 * number(data, end + 43)[0]
    if end != len(data):
        raise ValueError(f"{part}.bin has {len(data):,} bytes, its records {end:,}")


def _check_rotations(path: Path) -> None:
    """Raise `ValueError` for an impossible rotation in a text file."""
    lines = (line.strip() for line in path.read_text("utf-8").splitlines())
    records = (line for line in lines if not line.startswith("#"))
    for record in records:
        if record:
            _check_rotation(tuple(map(float, record.split()[1:5])))
            next(records, None)  # the keypoints, which may be an empty line


def _check_rotation(quaternion: tuple[float, ...]) -> None:
    # pycolmap normalizes quaternions, and would read zeros as the identity.
    if not 0.5 < np.linalg.norm(quaternion) < 2:
        raise ValueError(f"the quaternion {quaternion} is not a rotation")


def to_arrays(model: Any) -> Model:
    """Return the arrays of a pycolmap reconstruction."""
    import pycolmap

    points = dict(sorted(model.points3D.items()))
    index = {number: row for row, number in enumerate(points)}
    # The rays of this camera are pixels with centers at integers. Keypoints have no array, and one
    # call for each would be 200 times slower.
    unit: Any = pycolmap.Camera(model="SIMPLE_PINHOLE", width=1, height=1, params=[1, 0.5, 0.5])
    images = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if image.has_pose:
            keypoints = image.get_observation_points2D()
            observed = np.array([index.get(k.point3D_id, -1) for k in keypoints], np.int32)
            images.append(
                Image(
                    name=image.name,
                    camera_id=image.camera_id,
                    camera_from_world=np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]),
                    pixels_px=unit.cam_from_img(keypoints)[observed >= 0],
                    observed=observed[observed >= 0],
                )
            )
    return Model(
        cameras={
            number: Camera(
                model=camera.model_name,
                width=camera.width,
                height=camera.height,
                parameters=tuple(camera.params.tolist()),
            )
            for number, camera in model.cameras.items()
        },
        images=tuple(images),
        points=np.array([point.xyz for point in points.values()], float).reshape(-1, 3),
        colors=np.array([point.color for point in points.values()], np.uint8).reshape(-1, 3),
        error_px=np.array([point.error for point in points.values()], float),
    )
