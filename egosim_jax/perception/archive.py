"""Storage of a `Perceived` in one npz file, without pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import parse_json, quote_path, quote_text
from egosim_jax.io.untrusted.npz import read_arrays
from egosim_jax.types import Cameras, InputError, Perceived

PIXELS = ("frames", "depth_m", "object_ids")
_DTYPES = {
    "about": "uint8", "world_from_camera": "float64", "intrinsics_px": "float64",
    "paths": "float64", "frames": "uint8", "depth_m": "float32", "object_ids": "int32",
    "interacted_ids": "int32", "interacted_frames": "bool", "new_points_m": "float32",
}  # fmt: skip


def save(path: Path, perceived: Perceived) -> None:
    """Write a `Perceived` atomically to a file that ends in .npz."""
    tracked, interacted = sorted(perceived.world_from_object), sorted(perceived.interacted_frames)
    new = perceived.new_objects
    about = {
        "step": perceived.step,
        "names": {str(number): name for number, name in sorted(perceived.names.items())},
        "size": [perceived.cameras.height, perceived.cameras.width],
        "tracked": tracked,
        "new": {str(number): len(points) for number, points in sorted(new.items())},
        "held": {str(hand): number for hand, number in sorted(perceived.held.items())},
        "notes": list(perceived.notes),
    }
    arrays: dict[str, Any] = {
        "about": np.frombuffer(json.dumps(about).encode(), np.uint8),
        "world_from_camera": np.asarray(perceived.cameras.world_from_camera, float),
        "intrinsics_px": np.asarray(perceived.cameras.intrinsics_px, float),
        "paths": np.array([perceived.world_from_object[number] for number in tracked], float),
        "new_points_m": np.concatenate([np.zeros((0, 3)), *(new[n] for n in sorted(new))]).astype(
            np.float32
        ),
        **{name: getattr(perceived, name) for name in PIXELS},
        "interacted_ids": np.array(interacted, np.int32),
        "interacted_frames": np.array([perceived.interacted_frames[n] for n in interacted], bool),
    }
    with atomic_write(path) as temporary:
        np.savez(temporary, **arrays)


def load(path: Path) -> Perceived:
    """Read a `Perceived` written by `save`. Raises `InputError` for other or damaged files."""
    arrays = read_arrays(path, _DTYPES)
    about = parse_json(arrays.pop("about").tobytes(), source=quote_path(path))
    try:
        cameras = Cameras(
            world_from_camera=arrays.pop("world_from_camera"),
            intrinsics_px=arrays.pop("intrinsics_px"),
            height=about["size"][0],
            width=about["size"][1],
        )
        counts, points = about["new"], arrays["new_points_m"].reshape(-1, 3)
        pieces = np.split(points, np.cumsum(list(counts.values()))[:-1]) if counts else []
        interacted = arrays["interacted_ids"].tolist(), arrays["interacted_frames"]
        return Perceived(
            step=about["step"],
            cameras=cameras,
            names={int(number): name for number, name in about["names"].items()},
            world_from_object=dict(zip(about["tracked"], arrays.pop("paths"), strict=True)),
            interacted_frames=dict(zip(*interacted, strict=True)),
            new_objects={int(n): piece for n, piece in zip(counts, pieces, strict=True)},
            held={int(hand): int(number) for hand, number in about.get("held", {}).items()},
            notes=tuple(str(note) for note in about["notes"]),
            **{name: arrays[name] for name in PIXELS},
        )
    except (ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
        why = quote_text(str(error))
        raise InputError(f"{quote_path(path)} is not a perception archive: {why}.") from error
