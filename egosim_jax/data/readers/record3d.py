"""Record3D captures of an iPhone: images with poses, intrinsics and LiDAR depth.

    NAME.r3d, a zip archive, or a folder with its files
        metadata        JSON: w h, dw dh, fps, K (9 numbers by columns), poses (qx qy qz qw x y z),
                        perFrameIntrinsicCoeffs (fx fy cx cy, at w x h), frameTimestamps (seconds)
        rgbd/<n>.jpg    images
        rgbd/<n>.depth  float32 meters `dh dw`, compressed by LZFSE
        rgbd/<n>.conf   uint8 `dh dw`, compressed, too: 0 low, 1 medium, 2 high; may be absent

or a folder exported as "EXR + RGB", with metadata.json and rgb/<n>.jpg, whose EXR depth is not
read. Poses are camera to world in ARKit's axes, which are OpenGL's, in meters; the world is y up.
Images are taken by their time stamps (`io/timing.py`). Pixel coordinates start at the corner of the
image, so half a pixel is subtracted. ARKit refocuses continuously; the median over the frames is
used if the focal length changes little. Depth of low confidence is unknown; if a capture has
confidences, so is the depth of a frame without them. Depth is written as PNG in millimeters and
needs the package lzfse. Without it, depth is unknown, and the recording says so. That library
limits no size, so the declared size of a stream is checked before. A stream is a sequence of
blocks, each with the number of bytes that it decompresses to, and ends with `bvx$` (Apple's
`lzfse_internal.h`).
Followed: nerfstudio 1.1, `record3d_utils.py`, and readers of .r3d files of 2025.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
import tyro
from PIL import Image

from egosim_jax.data.readers import Entry, check_one_camera, make_id, make_rate, natural_order
from egosim_jax.data.readers.images import (
    MAX_IMAGES,
    describe_run,
    longest_run,
    write_images,
)
from egosim_jax.data.readers.lenses import Lens
from egosim_jax.data.readers.rotations import OPENCV_FROM_OPENGL, make_poses
from egosim_jax.data.recorded_files import DepthFiles
from egosim_jax.data.recording import Recording
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import (
    open_regular,
    parse_json,
    quote,
    quote_path,
    quote_text,
    read_bytes,
    refusing,
)
from egosim_jax.io.images import decode_image
from egosim_jax.io.timing import row_times
from egosim_jax.io.untrusted.zipped import from_file
from egosim_jax.types import InputError, is_rigid

logger = logging.getLogger(__name__)

MAX_FILE_BYTES = 1 << 28
"""Maximum size of a file in a capture or archive, in bytes."""
MAX_SPREAD = 0.03
"""Maximum relative change of the focal length during a capture."""
MAX_DEPTH_SIDE = 4096
"""Maximum height and width of a depth map in pixels."""
MIN_CONFIDENCE = 1
"""Minimum confidence of used depth: 0 is ARKit's low, 1 its medium."""
_IMAGE = re.compile(r"(?:rgbd|rgb)/(\d{1,9})\.jpg")

ReadFile = Callable[[str], bytes]


@dataclass(frozen=True, kw_only=True)
class Record3D:
    """Record3D captures: images, cameras and LiDAR depth."""

    dataset: ClassVar[str] = "record3d"
    source: Annotated[Path, tyro.conf.Positional]
    """A .r3d file, a folder of such files, or the folder of one capture."""

    def find(self) -> Iterator[Entry]:
        """Yield the captures of a Record3D folder."""
        captures = [self.source]
        if self.source.is_dir() and not _metadata_name(self.source):
            captures = sorted(self.source.rglob("*.r3d"), key=natural_order)
        if not captures or not self.source.exists():
            raise InputError(
                f"{self.source} holds no .r3d files and no metadata: it must be a Record3D "
                "capture, or a folder of .r3d files."
            )
        for path in captures:
            yield Entry(
                recording_id=make_id([path.resolve().stem]), read=partial(_read, path), source=path
            )


def _metadata_name(folder: Path) -> str | None:
    return next((n for n in ("metadata", "metadata.json") if (folder / n).is_file()), None)


def _read(path: Path, folder: Path) -> Recording:
    with _open_capture(path) as (names, read):
        metadata = _read_metadata(names, read, path)
        matches = filter(None, map(_IMAGE.fullmatch, sorted(names)))
        numbered = {int(match[1]): match[0] for match in matches}  # rgbd/ rather than rgb/
        count = max(numbered, default=-1) + 1
        poses = _poses(metadata, path)
        posed = count if poses is None else len(poses)
        if not 0 < count <= posed:
            raise InputError(
                f"{quote_path(path)} has {len(numbered)} images and {posed} poses: the images must "
                "be numbered from 0, one per pose. Export the capture again."
            )
        lens, spread = _lens(metadata, posed, path)
        rigid = np.ones(posed, bool) if poses is None else is_rigid(poses)
        numbers = sorted(numbered)[:MAX_IMAGES]
        used = dict(zip((numbered[number] for number in numbers), rigid[numbers], strict=True))
        run = longest_run(list(used), used.__getitem__)
        notes = describe_run(list(used), run)
        if run:  # without a pose, the recording names the first
            numbers = [numbers[index] for index in run]
        numbers, fps = _moments(metadata, numbers, path)
        poses = None if poses is None else poses[numbers]
        images = (
            decode_image(read(name), name=quote_text(name), pixels="stored")
            for name in map(numbered.__getitem__, numbers)
        )
        recording, remap = write_images(folder, images, lens, fps)
        depth, why = _write_depth(names, read, metadata, numbers, path, folder)
    return replace(
        recording,
        world_from_camera=poses,
        intrinsics_px=(remap or lens).intrinsics_px if np.isfinite(spread) else None,
        metric=poses is not None,
        depth=depth,
        provenance={"focal_spread": f"{spread:.4f}", "depth": why, **notes},
    )


@contextmanager
def _open_capture(path: Path) -> Iterator[tuple[list[str], ReadFile]]:
    """Open an archive or folder; yield its file names and a function that reads a file."""
    if path.is_dir():
        files = (file for file in path.glob("**/*") if not file.is_dir())
        names = [str(file.relative_to(path)) for file in files]
        yield names, lambda name: read_bytes(path / name, limit=MAX_FILE_BYTES)
        return
    with open_regular(path) as file:
        damage = f"{quote_path(path)} is not a readable .r3d file"
        with refusing(damage):
            archive = from_file(file)

        def read(name: str) -> bytes:
            with refusing(damage):
                return archive.read(name, limit=MAX_FILE_BYTES)

        yield list(archive.entries), read


def _read_metadata(names: list[str], read: ReadFile, path: Path) -> dict[str, Any]:
    name = next((name for name in ("metadata", "metadata.json") if name in names), "")
    source = f"{quote_path(path)}: {name}"
    metadata = name and parse_json(read(name), source=source, limit=MAX_FILE_BYTES)
    if not isinstance(metadata, dict):
        raise InputError(f"{quote_path(path)} has no metadata: it is not a Record3D capture.")
    return metadata


def _numbers(metadata: dict[str, Any], name: str, columns: int, path: Path) -> np.ndarray:
    """Return a table of finite numbers."""
    try:
        table = np.array(metadata.get(name), float)
    except (TypeError, ValueError):
        table = np.zeros((0, 0))
    if table.ndim != 2 or table.shape[1] != columns or not np.isfinite(table).all():
        raise InputError(
            f"{quote_path(path)}: {name} is of shape {table.shape}: it must be finite numbers, "
            f"{columns} per frame."
        )
    return table


def _number(metadata: dict[str, Any], name: str, path: Path) -> float:
    value = metadata.get(name)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < 1e5:
        raise InputError(f"{quote_path(path)}: {name} is {quote(value)}, not a positive number.")
    return float(value)


def _poses(metadata: dict[str, Any], path: Path) -> np.ndarray | None:
    """Return camera poses, or None for a capture without them, which tracked nothing."""
    if not metadata.get("poses"):
        logger.warning("%s has no poses: its cameras stay unknown", quote_path(path))
        return None
    table = _numbers(metadata, "poses", 7, path)
    return make_poses(table[:, :4], table[:, 4:]) @ OPENCV_FROM_OPENGL


def _moments(
    metadata: dict[str, Any], numbers: list[int], path: Path
) -> tuple[list[int], Fraction]:
    """Return the images nearest to the moments of a constant rate, and the rate.

    Captures without time stamps have the rate that they state.
    """
    fps = make_rate(metadata.get("fps", 0), what=f"{quote_path(path)}: fps")
    stamps = metadata.get("frameTimestamps")
    if not isinstance(stamps, list) or not stamps:
        return numbers, fps
    known = [stamps[number] if number < len(stamps) else None for number in numbers]
    rows, _, timeline = row_times(known, [fps], f"{quote_path(path)}, frameTimestamps")
    if timeline.count > MAX_IMAGES:
        raise InputError(
            f"{quote_path(path)}: frameTimestamps give {timeline.count:,} frames at "
            f"{float(timeline.fps):g} fps, more than {MAX_IMAGES:,}, the maximum. Split the "
            "capture."
        )
    near = rows[timeline.nearest(timeline.moments_s(0, timeline.count))]
    return [numbers[row] for row in near], timeline.fps


def _lens(metadata: dict[str, Any], frames: int, path: Path) -> tuple[Lens, float]:
    """Return the camera and its focal length's relative spread, NaN without intrinsics."""
    width, height = (int(_number(metadata, name, path)) for name in ("w", "h"))
    if metadata.get("perFrameIntrinsicCoeffs"):
        table = _numbers(metadata, "perFrameIntrinsicCoeffs", 4, path)
    elif not metadata.get("K"):
        table = np.full((1, 4), np.nan)
    else:
        matrix = _numbers({"K": [metadata.get("K")]}, "K", 9, path)[0]
        table = matrix[[0, 4, 6, 7]][None]
    if len(table) not in (1, frames):
        raise InputError(
            f"{quote_path(path)}: perFrameIntrinsicCoeffs has {len(table)} rows for {frames} "
            "frames."
        )
    if np.isnan(table).any():
        logger.warning("%s has no K: its intrinsics stay unknown", quote_path(path))
    fx, fy, cx, cy = np.nan_to_num(np.median(table, axis=0), nan=1.0).tolist()
    spread = check_one_camera(table[:, 0], quote_path(path), most=MAX_SPREAD)
    return Lens(
        model="brown",
        coefficients=(0.0,) * 5,
        intrinsics_px=np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]),
        height=height,
        width=width,
    ), spread


def _write_depth(
    names: list[str],
    read: ReadFile,
    metadata: dict[str, Any],
    numbers: Sequence[int],
    path: Path,
    folder: Path,
) -> tuple[DepthFiles | None, str]:
    """Write depth maps as PNG in millimeters; return them, or None, and their source or why not."""
    known = set(names)
    found = [f"rgbd/{number}.depth" in known for number in numbers]
    if not any(found):
        return None, "none"
    if find_spec("lzfse") is None:
        return None, "not read: pip install 'egosim-jax[video]'"
    columns, rows = (int(_number(metadata, name, path)) for name in ("dw", "dh"))
    if max(columns, rows) > MAX_DEPTH_SIDE:
        raise InputError(f"{quote_path(path)}: depth of {columns}x{rows} pixels is too large.")
    paths: list[Path | None] = [None] * len(numbers)
    judged = any(name.endswith(".conf") for name in names)

    def unpack(name: str, dtype: str) -> np.ndarray:
        try:
            data = unpack_lzfse(read(name), np.dtype(dtype).itemsize * rows * columns)
        except ValueError as error:
            raise InputError(f"{quote_path(path)}: {name} is damaged: {error}.") from error
        return np.frombuffer(data, dtype).reshape(rows, columns)

    for frame, number in enumerate(numbers):
        confidence = f"rgbd/{number}.conf"
        if found[frame] and (confidence in known or not judged):
            meters = unpack(f"rgbd/{number}.depth", "<f4")
            good = np.isfinite(meters) & (meters > 0) & (meters < 65)
            if judged:
                good &= unpack(confidence, "u1") >= MIN_CONFIDENCE
            meters = np.where(good, meters, 0)
            paths[frame] = target = folder / "depth" / f"{number:06d}.png"
            with atomic_write(target) as temporary:
                Image.fromarray(np.rint(1000 * meters).astype(np.uint16)).save(temporary)
    source = "LiDAR of medium and high confidence" if judged else "LiDAR"
    return DepthFiles(paths=tuple(paths), unit_m=0.001), source


def unpack_lzfse(data: bytes, size: int) -> bytes:
    """Decompress an LZFSE stream to `size` bytes. Raises `ValueError` if it has another size.

    Data that already has that size is returned unchanged: some apps do not compress.
    """
    if len(data) == size:
        return data
    if (declared := unpacked_size(data)) != size:
        raise ValueError(f"it unpacks to {declared:,} bytes; expected {size:,}")
    import lzfse

    try:
        unpacked = lzfse.decompress(data)
    except (lzfse.error, MemoryError) as error:  # it looks for ever more room for a damaged block
        raise ValueError("a block cannot be unpacked") from error
    if len(unpacked) != size:
        raise ValueError(f"it unpacked to {len(unpacked):,} bytes; expected {size:,}")
    return unpacked


def unpacked_size(data: bytes) -> int:
    """Return the total declared size of the blocks. Raises `ValueError` if this is not LZFSE."""

    def number(at: int, count: int) -> int:
        if at + count > len(data):
            raise ValueError("it is cut off")
        return int.from_bytes(data[at : at + count], "little")

    at, total = 0, 0
    while data[at : at + 4] != b"bvx$":
        magic, raw = data[at : at + 4], number(at + 4, 4)
        if magic == b"bvx2":
            literals, lengths, header = (number(at + 8 * n, 8) for n in (1, 2, 3))
            length = (header & 0xFFFFFFFF) + (literals >> 20 & 0xFFFFF) + (lengths >> 40 & 0xFFFFF)
        elif magic == b"bvxn":
            length = 12 + number(at + 8, 4)
        elif magic == b"bvx-":
            length = 8 + raw
        else:
            raise ValueError("it is not an LZFSE stream")
        at, total = at + max(length, 8), total + raw
    return total
