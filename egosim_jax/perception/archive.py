"""What was perceived, as one npz file without pickle."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from egosim_jax.io.atomic import atomic_write
from egosim_jax.state.filter import from_arrays, to_arrays
from egosim_jax.types import Cameras, InputError, Perceived

PIXELS = ("frames", "depth_m", "object_ids")


def save(path: Path, perceived: Perceived) -> None:
    """Write a file that ends in .npz, whole or not at all."""
    tracked = sorted(perceived.world_from_object)
    about = {
        "step": perceived.step,
        "names": {str(number): name for number, name in sorted(perceived.names.items())},
        "size": [perceived.cameras.height, perceived.cameras.width],
        "tracked": tracked,
    }
    arrays: dict[str, Any] = {
        "about": np.frombuffer(json.dumps(about).encode(), np.uint8),
        "world_from_camera": perceived.cameras.world_from_camera,
        "intrinsics_px": perceived.cameras.intrinsics_px,
        "paths": np.array([perceived.world_from_object[number] for number in tracked], float),
        **{name: getattr(perceived, name) for name in PIXELS},
        **to_arrays(perceived.touched),
    }
    with atomic_write(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


def load(path: Path) -> Perceived:
    """Read what `save` wrote. Raises `InputError` if the file is something else."""
    try:
        with np.load(path, allow_pickle=False) as file:
            about = json.loads(file["about"].tobytes())
            cameras = Cameras(
                world_from_camera=file["world_from_camera"],
                intrinsics_px=file["intrinsics_px"],
                height=about["size"][0],
                width=about["size"][1],
            )
            return Perceived(
                step=about["step"],
                cameras=cameras,
                names={int(number): name for number, name in about["names"].items()},
                world_from_object=dict(zip(about["tracked"], file["paths"], strict=True)),
                touched=from_arrays(file),
                **{name: file[name] for name in PIXELS},
            )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} does not say what was perceived: {error}.") from error
