"""Clips generated while a model is trained, beside their truth: what a loss does not show."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx
from jax.experimental import multihost_utils

from egosim_jax.conditioning.video import to_uint8
from egosim_jax.data.shards import Record, ShardReader
from egosim_jax.data.sheet import Block, draw_sheet
from egosim_jax.generator import ModelConfig, denoise
from egosim_jax.io import weights
from egosim_jax.io.video import write_video
from egosim_jax.models.wan_vae import WanVAE
from egosim_jax.sharding import batch_sharding, parts

MOMENTS = 6
"""Frames of a clip on the contact sheet."""


@dataclass(frozen=True, kw_only=True)
class Samples:
    """The first records of a folder of latents, generated from the same noise each time."""

    model: ModelConfig
    """The model that is trained."""
    latents: Path
    """Shards, as a rule those of the validation."""
    vae: Path
    """Weights folder with the autoencoder that made them."""
    count: int = 2
    """How many clips."""

    def write(self, networks: nnx.Module, out: Path, step: int) -> None:
        """Write OUT/step_N.mp4 and .png: each clip generated and, beside it, its truth.

        Called under the mesh of the training, by all of its processes.
        """
        graph, params = nnx.split(networks)
        generated = self._frames(_generate(graph, params, self._batch, self.model))
        truth = self._truth
        if jax.process_index() != 0:
            return
        pairs = [np.concatenate(pair, axis=2) for pair in zip(generated, truth, strict=True)]
        path = out / f"step_{step:06d}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_video(path, np.concatenate(pairs, axis=1), self.model.video.fps)
        moments = np.linspace(0, self.model.video.frames - 1, MOMENTS).round().astype(int).tolist()
        names = [record.metadata["video_id"] for record in self._records]
        blocks = [
            Block(f"{name}, step {step}: generated, truth", list(pair))
            for name, *pair in zip(names, generated, truth, strict=True)
        ]
        draw_sheet(blocks, path.with_suffix(".png"), moments=moments)

    def _frames(self, latents: jax.Array) -> np.ndarray:
        frames = _decode(*self._vae, latents)
        return multihost_utils.process_allgather(frames, tiled=True)[: len(self._records)]

    @cached_property
    def _truth(self) -> np.ndarray:
        return self._frames(self._batch["target"])

    @cached_property
    def _vae(self) -> tuple[nnx.GraphDef, nnx.State]:
        vae = nnx.eval_shape(lambda: WanVAE(self.model.vae, rngs=nnx.Rngs(0)))
        weights.load(self.vae / "vae.safetensors", vae)
        return nnx.split(vae)

    @cached_property
    def _records(self) -> list[Record]:
        reader = ShardReader(self.latents)
        return [reader[i] for i in range(min(self.count, len(reader)))]

    @cached_property
    def _batch(self) -> dict[str, jax.Array]:
        """The records, repeated until the devices can share them."""
        found = [record.arrays for record in self._records]
        size = -(-len(found) // parts("batch")) * parts("batch")
        where = batch_sharding(jax.sharding.get_mesh())
        rows = list(islice(cycle(found), size))
        arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        return {
            name: jax.make_array_from_callback(array.shape, where, array.__getitem__)
            for name, array in arrays.items()
        }


@jax.jit(static_argnums=(0, 3))
def _generate(
    graph: nnx.GraphDef, params: nnx.State, batch: dict[str, jax.Array], model: ModelConfig
) -> Any:
    networks: Any = nnx.merge(graph, params)
    keys = jax.random.split(jax.random.key(0), len(batch["target"]))
    noise = jax.vmap(lambda key: jax.random.normal(key, batch["target"].shape[1:]))(keys)
    return denoise(networks.dit, networks.condition(batch), noise, model)


@jax.jit(static_argnums=0)
def _decode(graph: nnx.GraphDef, params: nnx.State, latents: jax.Array) -> jax.Array:
    vae: Any = nnx.merge(graph, params)
    return to_uint8(vae.decode(latents))
