"""The state on disk: a folder of `points.npz` and `state.json`, and PLY for other programs.

`state.json` names the version and the SHA-256 of `points.npz`; nothing is unpickled. Equal states
have equal fingerprints, whatever wrote them.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.atomic import atomic_write
from egosim_jax.types import InputError, SceneState

VERSION = 1
POINTS, DESCRIPTION = "points.npz", "state.json"
ARRAYS = ("points_m", "colours", "object_ids", "last_seen")
_DTYPES = {
    "points_m": np.float32,
    "colours": np.uint8,
    "object_ids": np.int32,
    "last_seen": np.int32,
}


def fingerprint(state: SceneState) -> str:
    """SHA-256 of all that the state holds."""
    digest = hashlib.sha256(json.dumps(_description(state), sort_keys=True).encode())
    for name in ARRAYS:
        digest.update(np.ascontiguousarray(getattr(state, name)).tobytes())
    return digest.hexdigest()


def save(folder: Path, state: SceneState) -> None:
    """Write the state to a folder, which is there whole or not at all."""
    temporary = folder.with_name(folder.name + ".tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    with (temporary / POINTS).open("wb") as file:
        np.savez(file, **{name: getattr(state, name) for name in ARRAYS})
    written = {
        "version": VERSION,
        "points": len(state.points_m),
        "sha256": hashlib.sha256((temporary / POINTS).read_bytes()).hexdigest(),
        **_description(state),
    }
    (temporary / DESCRIPTION).write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    temporary.rename(folder)


def load(folder: Path) -> SceneState:
    """Read a state. Raises `InputError` if it is damaged, of another version or no state."""
    try:
        written: dict[str, Any] = json.loads((folder / DESCRIPTION).read_text(encoding="utf-8"))
        version = written["version"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder} holds no state that can be read: {error}.") from error
    if version != VERSION:
        raise InputError(
            f"{folder} holds a state of version {version}; this program reads version {VERSION}."
        )
    try:
        data = (folder / POINTS).read_bytes()
        if hashlib.sha256(data).hexdigest() != written["sha256"]:
            raise InputError(
                f"{folder / POINTS} is damaged: it is not what {DESCRIPTION} was written for "
                "(SHA-256). Take another copy."
            )
        with np.load(folder / POINTS, allow_pickle=False) as file:
            arrays = {name: file[name].astype(_DTYPES[name], copy=False) for name in ARRAYS}
        return SceneState(
            **arrays,
            intrinsics_px=np.array(written["intrinsics_px"], float),
            step=int(written["step"]),
            names={int(number): name for number, name in written["names"].items()},
            world_from_object={
                int(number): np.array(pose, float)
                for number, pose in written["world_from_object"].items()
            },
            provenance=written["provenance"],
        )
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{folder} holds no state that can be read: {error}.") from error


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
    with atomic_write(path) as temporary:
        if not o3d.t.io.write_point_cloud(str(temporary), cloud):
            raise OSError(f"{path} could not be written")


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
