"""Fuzzing targets: states, journals, configs, checkpoints, compiled programs."""

from __future__ import annotations

import functools
import json
import logging
import warnings
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from egosim_jax.io import run
from egosim_jax.io.journal import Journal
from egosim_jax.io.private import PrivateCache
from egosim_jax.perception import archive
from egosim_jax.state import snapshot
from egosim_jax.types import Cameras, InputError, Perceived, SceneState
from tests.fuzz.mutations import json_value
from tests.fuzz.target import Target

FRAMES, SIZE = 2, (16, 24)


def a_state() -> SceneState:
    """Twenty points, an object and its pose."""
    rng = np.random.default_rng(0)
    return SceneState(
        points_m=rng.normal(size=(20, 3)).astype(np.float32),
        colors=rng.integers(0, 256, (20, 3)).astype(np.uint8),
        object_ids=rng.integers(0, 3, 20).astype(np.int32),
        last_seen=rng.integers(0, 5, 20).astype(np.int32),
        intrinsics_px=np.array([[100.0, 0, 49.5], [0, 100, 29.5], [0, 0, 1]]),
        step=4,
        names={1: "red cup", 2: "lid"},
        world_from_object={2: np.diag([-1.0, -1, 1, 1])},
        provenance={"world": "tabletop"},
    )


def _read_state(folder: Path) -> Any:
    return snapshot.fingerprint(snapshot.load(folder / "state"))


def _make_perceived(folder: Path) -> None:
    rng = np.random.default_rng(0)
    cameras = Cameras(
        world_from_camera=np.tile(np.eye(4), (FRAMES, 1, 1)),
        intrinsics_px=np.array([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]]),
        height=SIZE[0],
        width=SIZE[1],
    )
    perceived = Perceived(
        step=1,
        cameras=cameras,
        frames=rng.integers(0, 256, (FRAMES, *SIZE, 3)).astype(np.uint8),
        depth_m=rng.uniform(0.3, 2, (FRAMES, *SIZE)).astype(np.float32),
        object_ids=rng.integers(0, 3, (FRAMES, *SIZE)).astype(np.int32),
        names={1: "cup", 2: "lid"},
        world_from_object={1: np.tile(np.eye(4), (FRAMES, 1, 1))},
        interacted_frames={1: np.array([True, False])},
    )
    archive.save(folder / "perceived.npz", perceived)


def _make_journal(folder: Path) -> None:
    journal = Journal(folder)
    journal.require("run", {"state": "3f" * 32, "seed": "0"})
    for number in range(3):
        path = folder / f"clip_{number}" / "frames.npz"
        journal.phase(
            f"{number} generate", path, make=lambda: 7, save=_save_number, load=_load_number
        )


def _save_number(path: Path, value: int) -> None:
    path.write_text(str(value), "ascii")


def _load_number(path: Path) -> int:
    return int(path.read_text("ascii"))


def _read_journal(folder: Path) -> Any:
    """Continue the run; its phases that are done are read, the others made: 7 in any case."""
    journal = Journal(folder, outputs=("clip_*",))
    journal.require("run", {"state": "3f" * 32, "seed": "0"})
    return [
        journal.phase(
            f"{number} generate",
            folder / f"clip_{number}" / "frames.npz",
            make=lambda: 7,
            save=_save_number,
            load=_load_number,
        )
        for number in range(3)
    ]


CONFIG = {
    "task": {"model": {"dim": 1536, "shift": 5.0, "name": "tiny"}, "dropout": [0.1, 0.2]},
    "weights": None,
    "seed": 3,
}


def _make_config(folder: Path) -> None:
    run.open_folder(folder, CONFIG)


def _read_config(folder: Path) -> Any:
    """Continue the run of that config: another one is refused."""
    run.open_folder(folder, CONFIG)
    return json.loads((folder / run.CONFIG).read_text("utf-8"))


def _cache(folder: Path) -> PrivateCache:
    return PrivateCache(folder, most=8)


def _make_program(folder: Path) -> None:
    _cache(folder).put("program", bytes(range(256)) * 8)


def _read_program(folder: Path) -> Any:
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        data = _cache(folder).get("program")
    if data is None:  # which means that it is compiled again
        raise InputError(str(said[0].message))
    return data


def _checkpoints(folder: Path) -> Any:
    from egosim_jax.io.checkpoint import Checkpoints

    logging.getLogger("absl").setLevel(logging.CRITICAL)
    return Checkpoints(folder / "checkpoints")


def _numbers() -> Any:
    import grain

    return iter(grain.MapDataset.range(100).shuffle(seed=1).repeat().to_iter_dataset())


def _make_checkpoint(folder: Path) -> None:
    import jax.numpy as jnp

    data, checkpoints = _numbers(), _checkpoints(folder)
    next(data)
    checkpoints.save(7, {"weights": jnp.arange(64.0), "step": jnp.int32(7)}, data)
    checkpoints.close()


def _read_checkpoint(folder: Path) -> Any:
    data, checkpoints = _numbers(), _checkpoints(folder)
    try:
        state = checkpoints.restore(_abstract(), data)
    finally:
        checkpoints.close()
    return {name: np.asarray(leaf) for name, leaf in state.items()}, int(next(data))


@functools.cache
def _abstract() -> Any:
    import jax
    import jax.numpy as jnp
    from jax.sharding import SingleDeviceSharding

    place = SingleDeviceSharding(jax.devices()[0])
    return {
        "weights": jax.ShapeDtypeStruct((64,), jnp.float32, sharding=place),
        "step": jax.ShapeDtypeStruct((), jnp.int32, sharding=place),
    }


def json_line(data: bytes, random: Random) -> bytes:
    """Drop, repeat or exchange lines."""
    lines = data.splitlines(keepends=True)
    if not lines:
        return data
    place = random.randrange(len(lines))
    return b"".join(lines[:place] + random.choice(([], lines[place:] * 2, lines[place:][::-1])))


TARGETS = [
    Target(
        name="npz snapshot",
        make=lambda folder: snapshot.save(folder / "state", a_state()),
        read=_read_state,
        files=("state/points.npz",),
        sealed=True,
    ),
    Target(
        name="state.json",
        make=lambda folder: snapshot.save(folder / "state", a_state()),
        read=_read_state,
        files=("state/state.json",),
        sealed=True,
        mutations=(json_value, json_line),
    ),
    Target(
        name="npz perceived",
        make=_make_perceived,
        read=lambda folder: archive.load(folder / "perceived.npz"),
        files=("perceived.npz",),
        sealed=True,
    ),
    Target(
        name="journal",
        make=_make_journal,
        read=_read_journal,
        files=("journal.jsonl", "clip_*/*"),
        sealed=True,
        mutations=(json_value, json_line),
    ),
    Target(
        name="config.json",
        make=_make_config,
        read=_read_config,
        files=("config.json",),
        sealed=True,
        mutations=(json_value, json_line),
    ),
    Target(
        name="kept executable",
        make=_make_program,
        read=_read_program,
        files=("program",),
        sealed=True,
    ),
    Target(
        name="checkpoint",
        make=_make_checkpoint,
        read=_read_checkpoint,
        files=("checkpoints/**/*",),
        sealed=True,
    ),
]
