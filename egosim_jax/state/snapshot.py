"""The state on disk: a folder of `points.npz` and `state.json`, and PLY for other programs.

`state.json` names the version and the SHA-256 of `points.npz`; nothing is unpickled. Equal states
have equal fingerprints, whatever wrote them.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.atomic import atomic_folder, atomic_write
from egosim_jax.io.digest import sha256
from egosim_jax.io.npz import read_arrays
from egosim_jax.io.untrusted import quote, quote_text, read_json
from egosim_jax.types import InputError, SceneState

VERSION = 1
POINTS, DESCRIPTION = "points.npz", "state.json"
ARRAYS = ("points_m", "colours", "object_ids", "last_seen")
_DTYPES = {"points_m": "float32", "colours": "uint8", "object_ids": "int32", "last_seen": "int32"}


def fingerprint(state: SceneState) -> str:
    """SHA-256 of all that the state holds."""
    digest = hashlib.sha256(json.dumps(_description(state), sort_keys=True).encode())
    for name in ARRAYS:
        digest.update(np.ascontiguousarray(getattr(state, name)).tobytes())
    return digest.hexdigest()


def save(folder: Path | str, state: SceneState) -> None:
    """Write the state to a folder, which is complete or absent."""
    with atomic_folder(Path(folder)) as temporary:
        np.savez(temporary / POINTS, **{name: getattr(state, name) for name in ARRAYS})
        description = _description(state)
        written = {
            "version": VERSION,
            "points": len(state.points_m),
            "sha256": sha256(temporary / POINTS),
            "description_sha256": _sealed(description),
            **description,
        }
        text = json.dumps(written, indent=2) + "\n"
        (temporary / DESCRIPTION).write_text(text, encoding="utf-8")


def load(folder: Path | str) -> SceneState:
    """Read a state. Raises `InputError` if it is damaged, of another version or no state."""
    folder = Path(folder)
    try:
        return _load(folder)
    except InputError as error:
        raise InputError(f"{folder} holds no state that can be read: {error}") from error


def _load(folder: Path) -> SceneState:
    written = read_json(folder / DESCRIPTION)
    if not isinstance(written, dict) or "version" not in written:
        raise InputError(f"{DESCRIPTION} is not the description of a state.")
    if written["version"] != VERSION:
        raise InputError(
            f"it is of version {quote(written['version'])}; this program reads version {VERSION}."
        )
    if sha256(folder / POINTS) != written.get("sha256"):
        raise InputError(
            f"{folder / POINTS} is damaged: it is not what {DESCRIPTION} was written for "
            "(SHA-256). Take another copy."
        )
    arrays = read_arrays(folder / POINTS, _DTYPES)
    try:
        description = _checked(written)
        state = SceneState(**arrays, **description)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{DESCRIPTION}: {quote_text(str(error))}.") from error
    sealed = written.get("description_sha256", None)  # earlier versions have none
    changed = sealed not in (None, _sealed(_description(state)))
    if changed or written.get("points") != len(state.points_m):
        raise InputError(
            f"{folder / DESCRIPTION} was changed after it was written. Take another copy."
        )
    return state


def _sealed(description: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def _checked(written: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of the description, their types checked.

    Raises `ValueError`, `KeyError` or `TypeError`.
    """
    step, names, poses = written["step"], written["names"], written["world_from_object"]
    provenance = written["provenance"]
    if type(step) is not int or step < 0:
        raise ValueError(f"step is {quote(step)}, not a count")
    for field, texts in (("names", names), ("provenance", provenance)):
        if not isinstance(texts, dict) or not all(isinstance(text, str) for text in texts.values()):
            raise ValueError(f"{field} is not a mapping to text")
    if not isinstance(poses, dict):
        raise ValueError("world_from_object is not a mapping to poses")
    return {
        "intrinsics_px": _matrix(written["intrinsics_px"], 3, "intrinsics_px"),
        "step": step,
        "names": {_number(number): name for number, name in names.items()},
        "world_from_object": {
            _number(number): _matrix(pose, 4, f"the pose of object {quote_text(number)}")
            for number, pose in poses.items()
        },
        "provenance": provenance,
    }


def _number(text: str) -> int:
    if not (text.isascii() and text.removeprefix("-").isdigit() and len(text) < 12):
        raise ValueError(f"{quote(text)} is not an object id")
    return int(text)


def _matrix(rows: Any, size: int, name: str) -> np.ndarray:
    square = isinstance(rows, list) and len(rows) == size
    if not square or not all(
        isinstance(row, list) and len(row) == size and all(type(x) in (int, float) for x in row)
        for row in rows
    ):
        raise ValueError(f"{name} is not {size} x {size} numbers")
    matrix = np.array(rows, float)
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name} is not finite")
    return matrix


def _description(state: SceneState) -> dict[str, Any]:
    return {
        "step": state.step,
        "names": {str(number): state.names[number] for number in sorted(state.names)},
        "world_from_object": {
            str(number): np.asarray(state.world_from_object[number]).tolist()
            for number in sorted(state.world_from_object)
        },
        "intrinsics_px": np.asarray(state.intrinsics_px).tolist(),
        "provenance": dict(state.provenance),
    }


def write_ply(path: Path, state: SceneState) -> None:
    """The points as binary PLY: x y z, red green blue, object_ids, last_seen."""
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(np.ascontiguousarray(state.points_m)))
    cloud.point.colors = o3d.core.Tensor(np.ascontiguousarray(state.colours))
    for name in ("object_ids", "last_seen"):
        column = np.ascontiguousarray(getattr(state, name).reshape(-1, 1))
        cloud.point[name] = o3d.core.Tensor(column)
    least = sum(getattr(state, name).nbytes for name in ARRAYS)
    with atomic_write(path) as temporary:
        written = o3d.t.io.write_point_cloud(str(temporary), cloud)
        if not written or temporary.stat().st_size < least:  # it does not see that a disk is full
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))


def read_ply(path: Path, template: SceneState | None = None) -> SceneState:
    """A state from a PLY of points with colours; what PLY does not say comes from the template.

    Raises `InputError` if there are no points or no colours.
    """
    import open3d as o3d

    if not path.is_file():
        raise InputError(f"{path} is not there.")
    cloud = o3d.t.io.read_point_cloud(str(path))
    if cloud.is_empty() or "colors" not in cloud.point:
        raise InputError(f"{path} holds no points with colours.")
    points = cloud.point.positions.numpy().astype(np.float32)
    colours = cloud.point.colors.numpy()
    if colours.dtype != np.uint8:
        colours = np.clip(np.rint(255 * colours), 0, 255)

    def column(name: str) -> np.ndarray:
        if name in cloud.point:
            return cloud.point[name].numpy().reshape(-1).astype(np.int32)
        return np.zeros(len(points), np.int32)

    arrays = {
        "points_m": points,
        "colours": colours.astype(np.uint8),
        "object_ids": column("object_ids"),
        "last_seen": column("last_seen"),
    }
    if template is not None:
        return replace(template, **arrays)
    return SceneState(**arrays, intrinsics_px=np.eye(3), provenance={"read from": path.name})
