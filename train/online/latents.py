"""Latents of clips made beforehand, in shards of 8 bits: 38 kB a clip.

    python -m egosim_jax.train.online.latents --out FOLDER --first SEED [--stride N] [--scenes N]

makes scenes, encodes their clips and writes shards. Every array of a shard has the clips as its
leading axis. An array of floats is stored as int8 with one scale, in 1/127 of its largest value; a
mask as bits. The encoder's 16-bit weights round latents more coarsely than that at their tails.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from flax import nnx

from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig
from egosim_jax.data.records import stacked
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.untrusted.npz import array_names, read_arrays
from egosim_jax.io.weights import load
from egosim_jax.models import abstract
from egosim_jax.runtime.command import ExitCode, run_with_exit_codes
from egosim_jax.train.online.pool import CHUNK, latent_shapes, make_encode
from egosim_jax.train.online.scenes import EndlessScenes, row_of

SCALE = "_scale"
"""Suffix of the name of an array's scale."""
SHARD = 8 * CHUNK
"""Number of clips of a shard."""


def write_shard(path: Path, rows: Mapping[str, np.ndarray]) -> None:
    """Write rows of latents as a shard, atomically."""
    arrays = {}
    for name, array in rows.items():
        if name == "mask":
            arrays[name] = np.packbits(array.astype(bool).reshape(len(array), -1), axis=1)
        elif np.issubdtype(array.dtype, np.floating):
            scale = float(np.abs(array).max()) / 127 or 1.0
            arrays[name] = np.round(array.astype(np.float32) / scale).astype(np.int8)
            arrays[name + SCALE] = np.float32(scale)
        else:
            arrays[name] = array
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **arrays)


def read_shard(path: Path, model: ModelConfig) -> dict[str, np.ndarray]:
    """Return the rows of a shard, in the dtypes of `pool.latent_shapes`."""
    arrays = read_arrays(path, {}, others=array_names(path), packed=True)
    rows = {}
    for name, shape in latent_shapes(model, len(arrays["ids"])).items():
        array = arrays[name]
        if name == "mask":
            size = int(np.prod(shape.shape[1:]))
            array = np.unpackbits(array, axis=1)[:, :size].reshape(shape.shape)
        elif name + SCALE in arrays:
            array = array.astype(np.float32) * arrays[name + SCALE]
        rows[name] = array.astype(shape.dtype)
    return rows


def read_latents(
    folder: Path, read: set[Path], model: ModelConfig, *, limit: int
) -> Iterator[dict[str, np.ndarray]]:
    """Yield chunks of rows of at most `limit` shards that are not in `read`, and add these."""
    new = sorted(path for path in folder.glob("[!.]*.npz") if path not in read)
    for path in new[:limit]:
        read.add(path)
        rows = read_shard(path, model)
        for start in range(0, len(rows["ids"]) // CHUNK * CHUNK, CHUNK):
            yield {name: array[start : start + CHUNK] for name, array in rows.items()}


def main(
    *,
    out: Path,
    first: int,
    config: str = "tabletop",
    weights: Path | None = None,
    stride: int = 1,
    scenes: int = 10**9,
    clips: int = 2,
    fused: float = 0.0,
) -> int:
    """Make latents of scenes for an online training.

    Args:
        out: Folder of the shards.
        first: First seed.
        config: Name of the model.
        weights: Folder of the VAE, by default the package's.
        stride: Distance of two seeds.
        scenes: Number of scenes.
        clips: Clips of a scene.
        fused: Fraction of scenes with fused states (Open3D).
    """
    weights = weights or configs.weights_of(config, None)
    model, began, made = configs.get(config), time.monotonic(), 0
    vae = abstract(model.vae)
    load(weights / "vae.safetensors", vae)
    encode = partial(make_encode(model, vae), nnx.state(vae))
    source = EndlessScenes(model=model, clips=clips, fused=fused)
    out.mkdir(parents=True, exist_ok=True)
    raw: list[Mapping[str, np.ndarray]] = []
    encoded: list[Mapping[str, np.ndarray]] = []
    for seed in range(first, first + stride * scenes, stride):
        raw += [row_of(triplet, model) for triplet in source.triplets(seed)]
        while len(raw) >= CHUNK:
            batch, raw = raw[:CHUNK], raw[CHUNK:]
            rows = encode(stacked(batch))
            encoded.append({name: np.asarray(array) for name, array in rows.items()})
        if len(encoded) * CHUNK >= SHARD:
            rows = {name: np.concatenate([each[name] for each in encoded]) for name in encoded[0]}
            made, encoded = made + len(rows["ids"]), []
            write_shard(out / f"{first}_{made:06d}.npz", rows)
            pace = (time.monotonic() - began) / made
            print(f"{made} clips, {pace:.2f} s each", file=sys.stderr, flush=True)
    return ExitCode.DONE


if __name__ == "__main__":
    sys.exit(run_with_exit_codes(lambda: tyro.cli(main)))
