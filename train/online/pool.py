"""Pools of clips on the accelerator, from which updates draw.

One pool has the denoiser's examples, with all latents. Another has the decoder's: the newest clips'
frames, their latents, and the latents that the denoiser generates for them. A full pool forgets its
oldest clips. Every clip is encoded once, in the training process.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from egosim_jax.conditioning.pixels import to_model
from egosim_jax.configs.model import ModelConfig
from egosim_jax.generation.encoding import batch_shapes

CHUNK = 16
"""Number of clips that are encoded and stored at a time."""
Rows = Mapping[str, Any]


def videos_of(model: ModelConfig) -> list[str]:
    """Return the names of a clip's videos, in the order in which they are encoded."""
    return ["target", *(name for name in ("prior", "hands") if name in model.layout)]


def raw_shapes(model: ModelConfig, count: int) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shapes of clips that are not encoded (`scenes.row_of`)."""
    video, shapes = model.video, batch_shapes(count, model)
    frames = (count, video.frames, video.height, video.width, 3)
    return {**shapes, "target": jax.ShapeDtypeStruct(frames, np.uint8)}


def latent_shapes(model: ModelConfig, count: int) -> dict[str, jax.ShapeDtypeStruct]:
    """Return the shapes of clips whose videos are latents, floats as float16."""
    latents = (count, *model.latent_shape, model.vae.latent_channels)
    shapes = {}
    for name, shape in raw_shapes(model, count).items():
        shape = latents if name in videos_of(model) else shape.shape
        kind = raw_shapes(model, count)[name].dtype
        halved = name in videos_of(model) or np.issubdtype(kind, np.floating)
        shapes[name] = jax.ShapeDtypeStruct(shape, np.float16 if halved else kind)
    return shapes


class Pool:
    """Rows of arrays on the device in a ring, appended in chunks of `CHUNK`."""

    def __init__(self, shapes: Mapping[str, jax.ShapeDtypeStruct]):
        self.arrays = {name: jnp.zeros(s.shape, s.dtype) for name, s in shapes.items()}
        self.capacity = next(iter(self.arrays.values())).shape[0]
        if self.capacity % CHUNK:
            raise ValueError(f"a pool's capacity must be a multiple of {CHUNK}")
        self.appended = 0

    def __len__(self) -> int:
        return min(self.appended, self.capacity)

    @property
    def position(self) -> np.int32:
        """Row of the next chunk."""
        return np.int32(self.appended % self.capacity)

    def append(self, rows: Rows) -> None:
        """Store a chunk in place of the oldest one."""
        self.arrays = store(self.arrays, rows, self.position)
        self.appended += CHUNK


@partial(jax.jit, donate_argnums=0)
def store(arrays: Rows, rows: Rows, at: Any) -> dict[str, jax.Array]:
    """Return arrays in which `rows` begin at row `at`."""
    return {
        name: jax.lax.dynamic_update_slice_in_dim(array, rows[name].astype(array.dtype), at, 0)
        for name, array in arrays.items()
    }


def make_encode(model: ModelConfig, vae: Any) -> Any:
    """Return the jitted function from raw rows to rows of latents, one video after the other.

    It takes the VAE's weights and the rows.
    """
    graph = nnx.graphdef(vae)

    @jax.jit
    def encode(params: Any, rows: Rows) -> dict[str, jax.Array]:
        # Full precision: the shipped encoder's latents, as they are on a CPU.
        with jax.default_matmul_precision("highest"):
            codec = nnx.merge(graph, params)
            names = videos_of(model)
            videos = jnp.stack([rows[name] for name in names])
            latents = jax.lax.map(lambda video: codec.encode(to_model(video)), videos)
        return {**rows, **dict(zip(names, latents, strict=True))}

    return encode


def as_floats(rows: Rows) -> dict[str, jax.Array]:
    """Return rows with float16 arrays as float32."""
    return {n: v.astype(jnp.float32) if v.dtype == jnp.float16 else v for n, v in rows.items()}
