"""Storage of a state: a folder of `points.npz` and `state.json`, and PLY for other programs.

`state.json` names the version and the SHA-256 of `points.npz`; nothing is unpickled. Equal states
have equal fingerprints.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.atomic import atomic_folder, check_replaceable
from egosim_jax.io.bounded import (
    check_version,
    named,
    quote,
    quote_path,
    quote_text,
    read_json,
)
from egosim_jax.io.digest import sha256
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.state.ply import read_points, write_points
from egosim_jax.types import InputError, SceneState

VERSION = 1
POINTS, DESCRIPTION = "points.npz", "state.json"
_NAMES = re.compile(r"points\.npz|state\.json")
ARRAYS = ("points_m", "colors", "object_ids", "last_seen")
CHANNELS = ("red", "green", "blue")
SPLATS = ("f_dc_0", "f_dc_1", "f_dc_2")
COLORS = (CHANNELS, ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"), SPLATS)
"""Names of the color channels in files of several programs."""
SH0 = 0.28209479
"""Spherical harmonic of degree 0, the factor of a splat's base color."""
_DTYPES = {"points_m": "float32", "colors": "uint8", "object_ids": "int32", "last_seen": "int32"}


def fingerprint(state: SceneState) -> str:
    """Return the SHA-256 of all fields of a state."""
    digest = hashlib.sha256(json.dumps(_description(state), sort_keys=True).encode())
    for name in ARRAYS:
        digest.update(np.ascontiguousarray(getattr(state, name)).tobytes())
    return digest.hexdigest()


def save(folder: Path | str, state: SceneState) -> None:
    """Write a state to a folder, atomically.

    Replaces an empty folder or an earlier state; raises `InputError` for any other.
    """
    path = check_replaceable(Path(folder), _NAMES, description=DESCRIPTION)
    arrays: dict[str, Any] = {name: np.ascontiguousarray(getattr(state, name)) for name in ARRAYS}
    with atomic_folder(path) as temporary:
        np.savez(temporary / POINTS, **arrays)
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
    """Read a state. Raises `InputError` if it is damaged, not a state, or of another version."""
    folder = Path(folder)
    try:
        return _load(folder)
    except InputError as error:
        raise InputError(f"{folder} is not a readable state: {error}") from error


def _load(folder: Path) -> SceneState:
    written = read_json(folder / DESCRIPTION)
    if not isinstance(written, dict) or "version" not in written:
        raise InputError(f"{DESCRIPTION} is not the description of a state.")
    check_version(written["version"], VERSION, source=DESCRIPTION)
    if sha256(folder / POINTS) != written.get("sha256"):
        raise InputError(
            f"{folder / POINTS} is damaged: its SHA-256 is not the one in {DESCRIPTION}. "
            "Use another copy."
        )
    arrays = read_arrays(folder / POINTS, _DTYPES)
    try:
        state = SceneState(**arrays, **_checked(written))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{DESCRIPTION}: {quote_text(str(error))}.") from error
    changed = written.get("description_sha256") != _sealed(_description(state))
    if changed or written.get("points") != len(state.points_m):
        raise InputError(
            f"{folder / DESCRIPTION} was changed after it was written. Use another copy."
        )
    return state


def _sealed(description: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def _checked(written: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of a state's description, with checked types.

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
        "held": _held(written.get("held", {})),
        "provenance": provenance,
    }


def _held(hands: Any) -> dict[int, int]:
    if not isinstance(hands, dict) or not all(type(number) is int for number in hands.values()):
        raise ValueError("held is not a mapping from hands to object ids")
    return {_number(hand): number for hand, number in hands.items()}


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
    held = {str(hand): int(state.held[hand]) for hand in sorted(state.held)}
    return {
        "step": int(state.step),
        "names": {str(number): state.names[number] for number in sorted(state.names)},
        "world_from_object": {
            str(number): np.asarray(state.world_from_object[number]).tolist()
            for number in sorted(state.world_from_object)
        },
        "intrinsics_px": np.asarray(state.intrinsics_px).tolist(),
        **({"held": held} if held else {}),  # a state without equals one of before the field
        "provenance": dict(state.provenance),
    }


def write_ply(path: Path, state: SceneState) -> None:
    """Write a state's points as binary PLY: x y z, red green blue, object_ids, last_seen."""
    places = dict(zip("xyz", state.points_m.T, strict=True))
    colors = dict(zip(CHANNELS, state.colors.T, strict=True))
    ids = {name: getattr(state, name) for name in ("object_ids", "last_seen")}
    write_points(path, {**places, **colors, **ids})


def read_ply(path: Path, template: SceneState | None = None) -> SceneState:
    """Read a state from a PLY file of colored points; other fields come from the template.

    Of Gaussian splats, the centers of opaque ones (at least half) are read, in their base colors.
    Raises `InputError` if it is damaged, or has no points or no colors.
    """
    points = read_points(path)
    names = points.dtype.names or ()
    channels = next((c for c in COLORS if set(c) <= set(names)), CHANNELS)
    if missing := [name for name in ("x", "y", "z", *channels) if name not in names]:
        raise InputError(
            f"{quote_path(path)} has no colored points: missing property {', '.join(missing)}. "
            "Save the points with colors (red, green, blue as uchar)."
        )
    if channels == SPLATS and "opacity" in names:
        points = points[points["opacity"] > 0]
    try:
        places = np.stack([points[name] for name in "xyz"], axis=1).astype(np.float32)
        if bad := int((~np.isfinite(places)).any(axis=1).sum()):
            raise InputError(
                f"{bad:,} of {len(points):,} points are not finite. Remove them, for instance by "
                "Open3D's remove_non_finite_points."
            )
        colors = np.stack([points[name] for name in channels], axis=1)
        arrays = {
            "points_m": places,
            "colors": _levels(np.clip(0.5 + SH0 * colors, 0, 1) if channels == SPLATS else colors),
            "object_ids": _ids(points, "object_ids"),
            "last_seen": _ids(points, "last_seen"),
        }
        if template is not None:
            return replace(template, **arrays)
        return SceneState(**arrays, intrinsics_px=np.eye(3), provenance={"read from": path.name})
    except InputError as error:
        raise InputError(named(quote_path(path), error)) from error


def _levels(values: np.ndarray) -> np.ndarray:
    """Return 8-bit levels of colors given as bytes or as floats from 0 to 1."""
    if values.dtype == np.uint8:
        return values
    if values.dtype.kind != "f" or not ((values >= 0) & (values <= 1)).all():
        raise InputError("Colors must be uchar, or float from 0 to 1. Save the PLY with uchar.")
    return np.rint(255 * values).astype(np.uint8)


def _ids(points: np.ndarray, name: str) -> np.ndarray:
    if name not in (points.dtype.names or ()):
        return np.zeros(len(points), np.int32)
    values = points[name]
    limits = np.iinfo(np.int32)
    if values.dtype.kind not in "iu" or values.max() > limits.max:
        raise InputError(f"Property {name} must be int.")
    return values.astype(np.int32)
