"""Fingerprints of what was read, which do not depend on codecs, versions and processors.

A fingerprint has a field per fact. Counts, sizes, rates, names and captions are exact. Numbers are
rounded to six decimals. A frame is known by its number: its upper left corner, or all of it, has
the gray level of `level`, which `shown` reads back.
"""

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

Fields = Iterator[tuple[str, Any]]
"""Names and values of facts; a value consists of lists, numbers, texts, booleans and None."""
TOLERANCES = {"levels": 3.0, "centers_px": 0.25, "psnr_db": 0.3}
"""Maximum difference of fields that depend on a codec."""
ROUNDING = 5e-6
"""Maximum absolute and relative difference of all other numbers that are not whole."""


INPUTS: dict[str, Callable[[Path], Fields]] = {}
"""Function that makes and reads a clean input in a folder, by the name of the input."""


def clean(name: str, *args: Any) -> Callable[[Any], Any]:
    """Add an input, which a function makes in a folder with these arguments."""

    def add(make: Any) -> Any:
        assert name not in INPUTS
        INPUTS[name] = lambda folder: make(folder, *args)
        return make

    return add


def level(number: int, count: int) -> int:
    """Gray level of a frame among `count`; `tests.captures.World` has the same in its corners."""
    return 10 + 240 // count * number


def coded(count: int, height: int, width: int) -> np.ndarray:
    """Return frames whose gray levels are their numbers."""
    levels = np.array([level(number, count) for number in range(count)], np.uint8)
    return np.broadcast_to(levels[:, None, None, None], (count, height, width, 3)).copy()


def shown(frames: np.ndarray, count: int) -> list[int]:
    """Return the numbers of frames that were taken out of `count`."""
    corners = frames[:, 2:6, 2:6].reshape(len(frames), -1).mean(axis=1)
    numbers = (corners - level(0, count)) / (240 // count)
    assert (np.abs(numbers - np.rint(numbers)) < 0.4).all(), f"between two frames: {numbers}"
    return np.rint(numbers).astype(int).tolist()


def numbers(values: Any) -> Any:
    """Return floats rounded to six decimals, as lists; missing ones are None."""
    rounded = np.round(np.asarray(values, np.float64), 6) + 0.0  # no -0.0
    listed = rounded.astype(object)
    listed[~np.isfinite(rounded)] = None
    return listed.tolist()


def means(frames: np.ndarray) -> Any:
    """Return the mean color of each frame or image."""
    return np.round(frames.mean(axis=(-3, -2)), 1).tolist()


def cameras(poses: np.ndarray | None, intrinsics: np.ndarray | None) -> Fields:
    """Yield all positions, the first and last rotation, and the lens."""
    ends = None if poses is None else numbers(poses[[0, -1], :3, :3])
    yield "positions", None if poses is None else numbers(poses[:, :3, 3])
    yield "rotations", ends
    yield "intrinsics", None if intrinsics is None else numbers(intrinsics)


def hands(joints: np.ndarray | None) -> Fields:
    """Yield the hands in each frame, and wrist, thumb and index finger in the first and last."""
    if joints is None:
        yield "hands", None
        return
    points = [0, 4, 8] if joints.shape[2] == 21 else [0, 1, 2]
    yield "hands", np.isfinite(joints).all(axis=(2, 3)).astype(int).tolist()
    yield "joints", numbers(joints[[0, -1]][:, :, points])


def recording(found: Any, root: Path, *, count: int | None = 12) -> Fields:
    """Yield the facts of a recording whose video has `count` coded frames; None: not coded."""
    frames = found.read_frames().frames
    yield "video", found.video.relative_to(root).as_posix()
    yield "span", [int(found.start), int(found.frames)]
    yield "fps", str(found.fps)
    yield "size", [int(found.width), int(found.height)]
    if count is None:
        yield "centers_px", numbers([center(frame) for frame in frames])
    else:
        yield "shown", shown(frames, count)
    yield "about", [found.caption, list(found.names), found.kind, bool(found.metric)]
    yield from cameras(found.world_from_camera, found.intrinsics_px)
    yield from hands(found.joints_m)
    depths = [found.read_depth(number) for number in (0, 1, found.frames - 1)]
    yield "depth", [None if d is None else depth_facts(d) for d in depths]
    if found.points is not None:
        yield from scene_points(found.points)


def scene_points(points: Any) -> Fields:
    """Yield counts, and the first and last point and observation."""
    yield "points", [len(points.points_m), len(points.frames)]
    yield "points_m", numbers(points.points_m[[0, -1]])
    yield "colors", points.colors[[0, -1]].tolist()
    seen = [points.frames[[0, -1]].tolist(), points.indices[[0, -1]].tolist()]
    yield "observed", [*seen, np.round(points.pixels_px[[0, -1]].astype(float), 2).tolist()]
    yield "error", numbers(points.error_px[[0, -1]])


def depth_facts(depth: np.ndarray) -> Any:
    """Return size, unknown pixels, and the depth in the corner and in the middle."""
    rows, columns = depth.shape
    samples = depth[0, 0], depth[rows // 2, columns // 2]
    return [[columns, rows], int((~np.isfinite(depth)).sum()), numbers(samples)]


def center(frame: np.ndarray) -> tuple[float, float]:
    """Column and row of the center of the bright pixels."""
    bright = np.clip(frame.mean(axis=-1) - 64, 0, None)
    rows, columns = np.indices(bright.shape)
    return (bright * columns).sum() / bright.sum(), (bright * rows).sum() / bright.sum()


def episode(found: Any) -> Fields:
    """Yield scene, first frame, cameras, hands and prompts."""
    state, image = found.state, found.first_frame
    yield "shape", [*map(int, found.shape), found.fps, len(found.ground_truth)]
    yield "points", [len(state.points_m), sorted(set(state.object_ids.tolist()))]
    yield "points_m", numbers([state.points_m[0], state.points_m[-1], state.points_m.mean(axis=0)])
    yield "point_levels", np.round(state.colors.mean(axis=0), 1).tolist()
    yield "image_levels", None if image is None else [means(image), image[0, 0].tolist()]
    for number, action in enumerate(found.actions):
        fields = chain(
            [("about", [action.prompt, action.kind])],
            cameras(action.cameras.world_from_camera, action.cameras.intrinsics_px),
            hands(action.joints_m),
        )
        yield from under(f"action {number}", fields)


def bits(arrays: Mapping[str, np.ndarray]) -> list[Any]:
    """Return number, size and hash of arrays, each with its name, dtype and shape."""
    found = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        found.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return [len(arrays), sum(int(a.size) for a in arrays.values()), found.hexdigest()]


def under(name: str, fields: Fields) -> Fields:
    """Yield the fields with a name before their own."""
    for field, value in fields:
        yield f"{name}, {field}", value


def line(name: str, field: str, value: Any) -> str:
    """Return the line of a field in a golden file."""
    return f"{name}: {field} = {json.dumps(value, ensure_ascii=False, allow_nan=False)}"


def is_same(found: Any, golden: Any, tolerance: float | None) -> bool:
    """Compare whole numbers, texts and booleans exactly, and other numbers up to rounding."""
    if isinstance(golden, list):
        fits = isinstance(found, list) and len(found) == len(golden)
        return fits and all(map(is_same, found, golden, [tolerance] * len(golden)))
    if tolerance is not None and isinstance(golden, int | float):
        return isinstance(found, int | float) and abs(found - golden) <= tolerance
    if isinstance(golden, float) and isinstance(found, float):
        return math.isclose(found, golden, rel_tol=ROUNDING, abs_tol=ROUNDING)
    return type(found) is type(golden) and found == golden


def tolerance_of(field: str) -> float | None:
    """Return the tolerance of a field that depends on a codec; None for all others."""
    return next((most for end, most in TOLERANCES.items() if field.endswith(end)), None)
