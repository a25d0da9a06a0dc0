"""Writing of bundles: code, cached latents and weights, to train on a machine with few packages.

    egosim_jax/                  the code
    latents/train-000.npz, ...   records, stacked by name, in shards of at most 30 MiB
    weights/                     the autoencoder, and the weights to start from
    recipe.json                  the model, the task and the hyper-parameters, for a CPU and a GPU
    files.json                   the SHA-256 of all other files

`train/bundle.py` trains in it. Latents are stored as float16, half of their size in the records;
their channels have standard deviation 1.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

import egosim_jax
from egosim_jax import configs
from egosim_jax.data.records import stacked
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.atomic import atomic_folder
from egosim_jax.io.digest import sha256
from egosim_jax.io.run import plain, write_json
from egosim_jax.train.bundle import FILES, LATENTS, RECIPE, SHARD_BYTES, WEIGHTS
from egosim_jax.train.config import TrainConfig
from egosim_jax.train.task import Stage
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.types import InputError

WIDER: dict[str, Any] = {
    "model": {
        "dit": {"dim": 288, "ffn_dim": 864, "heads": 4, "dtype": "bfloat16", "products": None},
    },
    "training": {
        "steps": 8000,
        "batch_size": 64,
        "optimizer": {"learning_rate": 2e-3, "warmup_steps": 500, "ema_decay": 0.999},
        "log_every": 50,
        "save_every": 1000,
        "validate_every": 1000,
    },
}
"""Changes of model and training on a GPU: as wide as 25 MB of float16 weights permit.

It trains on eight times the samples of the recipe for a CPU; take more scenes (`--scenes`) rather
than more epochs. An H100 should need minutes; estimated, not measured.
"""
HEADER_BYTES = 1 << 16
"""Room for the headers of a shard's arrays."""


def write_bundle(
    out: Path, stage: Stage, *, latents: Mapping[str, Path], weights: Path, dtype: str
) -> None:
    """Write the bundle of a denoiser's training, with its cached latents by split.

    `weights` holds the autoencoder and, to train further, the other networks. The training will
    write weights of `dtype`. Raises `InputError` if `out` exists.
    """
    check_new(out)
    task = stage.task
    if not isinstance(task, Denoising):
        raise TypeError("only the training of a denoiser can be bundled")
    with atomic_folder(out) as folder:
        package = Path(egosim_jax.__file__).parent
        unused = shutil.ignore_patterns("__pycache__", WEIGHTS)
        shutil.copytree(package, folder / package.name, ignore=unused)
        (folder / WEIGHTS).mkdir()
        for path in sorted(weights.glob("[!.]*.safetensors")):
            shutil.copyfile(path, folder / WEIGHTS / path.name)
        (folder / LATENTS).mkdir()
        for split, source in latents.items():
            for number, arrays in enumerate(_shards(ShardReader(source))):
                path = folder / LATENTS / f"{split}-{number:03d}.npz"
                np.savez(path, **arrays)
        changes = changed_fields(task, Denoising(model=configs.get(task.model.name)))
        recipe = {
            "config": task.model.name,
            "task": changes,
            "training": changed_fields(stage.training, TrainConfig(steps=1)),
            "dtype": dtype,
            "cpu": {},
            "gpu": WIDER,
        }
        write_json(folder / RECIPE, recipe)
        files = sorted(path for path in folder.rglob("*") if path.is_file())
        hashes = {str(path.relative_to(folder)): sha256(path) for path in files}
        write_json(folder / FILES, {"sha256": hashes})


def changed_fields(value: Any, other: Any) -> dict[str, Any]:
    """Return the fields in which a config differs from another, as JSON values."""
    found = {}
    for field in fields(value):
        ours, theirs = getattr(value, field.name), getattr(other, field.name)
        if is_dataclass(ours) and type(ours) is type(theirs):
            if below := changed_fields(ours, theirs):
                found[field.name] = below
        elif ours != theirs:
            found[field.name] = plain(ours)
    return found


def check_new(out: Path) -> None:
    """Raise `InputError` if the folder of a bundle exists."""
    if out.exists():
        raise InputError(f"{out} exists: a bundle is written to a new folder. (--bundle)")


def _shards(source: ShardReader) -> Iterator[dict[str, Any]]:
    """Yield the stacked records of each shard of a split."""
    rows: list[Mapping[str, np.ndarray]] = []
    size = 0
    for record in source:
        arrays = {name: _stored(array) for name, array in record.arrays.items()}
        row = sum(array.nbytes for array in arrays.values())
        if rows and size + row > SHARD_BYTES - HEADER_BYTES:
            yield stacked(rows)
            rows, size = [], 0
        rows.append(arrays)
        size += row
    yield stacked(rows)


def _stored(array: np.ndarray) -> np.ndarray:
    """Return an array in its stored dtype: float16 for float32."""
    return array.astype(np.float16) if array.dtype == np.float32 else array
