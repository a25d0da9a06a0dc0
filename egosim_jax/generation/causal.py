"""Generation chunk by chunk, by a causal student (`models.CausalDenoiser`).

    text, image --share--> what the chunks share, empty cache
    condition of chunk n, noise, cache --denoise--> latents of chunk n, cache with chunk n

Each arrow is a compiled program; the one below has a version for each chunk, because the number of
keys that a chunk attends to is fixed in it. The cache is donated, so its memory is written in
place. The condition of a chunk may depend on the chunks before it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh
from jaxtyping import Array, Float, Key, UInt32

from egosim_jax.conditioning.condition import Condition
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion.solver import integrate_keeping
from egosim_jax.generation.compiled import BATCH, Axes, CompiledFn
from egosim_jax.generation.encoding import SOLVER_NOISE, keys_for
from egosim_jax.models import CausalDenoiser
from egosim_jax.models.chunks import Chunks
from egosim_jax.types import InputError

SHARED: Axes = (None, "batch")
"""Logical axes of what the chunks share, by layer."""
CACHE: Axes = (None, "batch", None, "heads")
"""Logical axes of the cache."""


def chunks_of(config: ModelConfig) -> Chunks:
    """Return the chunks of a causal student. Raises `InputError` for another model."""
    if config.chunks is None:
        raise InputError(
            f"{config.name} makes clips at once, not chunk by chunk. Give a causal student. "
            "(--config)"
        )
    return config.chunks


def steps_of(config: ModelConfig, number: int) -> Any:
    """Return the denoising steps of a chunk by number: their number, or the timesteps to visit."""
    first = chunks_of(config).first_steps
    return config.steps if number or first is None else first


def denoise_chunk(
    dit: CausalDenoiser,
    channels: Float[Array, "b f h w c"],
    noise: Float[Array, "b f h w z"],
    shared: Any,
    cache: Any,
    config: ModelConfig,
    number: int,
    keys: Key[Array, " b"] | None = None,
) -> tuple[Float[Array, "b f h w z"], Any]:
    """Return the latents of a clip's chunk by number, and the cache for the next chunk.

    `channels` are the condition channels of the chunk. `keys`, one for each item, draw the noise
    that a stochastic solver adds.
    """
    chunks = chunks_of(config)
    context = dit.prepare_chunk(channels, shared, chunks.bounds[number])
    step_keys = None if keys is None else jax.vmap(jax.random.fold_in, (0, None))(keys, number)
    latents, kept = integrate_keeping(
        lambda x, t: dit.denoise_chunk(x, t, context, cache),
        noise,
        process=config.process,
        solver=config.solver,
        steps=steps_of(config, number),
        keys=step_keys,
    )
    if number == len(chunks.sizes) - 1:  # no later chunk sees the last one
        return latents, cache
    if chunks.refresh:
        _, kept = dit.denoise_chunk(latents, jnp.zeros(len(latents)), context, cache)
    return latents, cache.put(kept)


def denoise_chunks(
    dit: CausalDenoiser,
    condition: Condition,
    noise: Float[Array, "b f h w z"],
    config: ModelConfig,
    keys: Key[Array, " b"] | None = None,
) -> Float[Array, "b f h w z"]:
    """Return the latents of clips, whose chunks are made one after the other in one program."""
    channels = config.layout.condition_channels(condition, noise)
    shared = dit.share(jnp.asarray(condition.text), condition.image)
    cache, chunks = dit.empty_cache(len(noise), config.latent_shape), []
    for number, (start, end) in enumerate(pairwise(chunks_of(config).bounds)):
        given = channels[:, start:end], noise[:, start:end], shared, cache
        latents, cache = denoise_chunk(dit, *given, config, number, keys)
        chunks.append(latents)
    return jnp.concatenate(chunks, axis=1)


class ChunkDenoiser:
    """Compiled programs of a causal student, on one device or on a mesh."""

    def __init__(self, config: ModelConfig, dit: CausalDenoiser, mesh: Mesh | None = None):
        """Take weights that `shard_params` has placed on the mesh."""
        self.config, self.chunks = config, chunks_of(config)

        def share(dit: CausalDenoiser, text: Array, image: Array | None) -> tuple[Any, Any]:
            return dit.share(text, image), dit.empty_cache(len(text), config.latent_shape)

        self._share = CompiledFn(
            share,
            dit,
            mesh=mesh,
            cache_key=("share", config),
            out_axes=(SHARED, CACHE),
        )
        self._denoise = [
            CompiledFn(
                self._program(number),
                dit,
                mesh=mesh,
                cache_key=("denoise chunk", number, config),
                in_axes=(BATCH, BATCH, SHARED, CACHE, *([BATCH] * config.solver.stochastic)),
                out_axes=(BATCH, CACHE),
                donate_argnums=4,
            )
            for number in range(len(self.chunks.sizes))
        ]

    def _program(self, number: int) -> Any:
        def run(dit: CausalDenoiser, *given: Any) -> tuple[Array, Any]:
            channels, noise, shared, cache, *seeds = given
            keys = keys_for(seeds[0], SOLVER_NOISE) if seeds else None
            return denoise_chunk(dit, channels, noise, shared, cache, self.config, number, keys)

        return run

    def programs(
        self, text: Any, image: Any, noise: Any, *seeds: Any
    ) -> Iterator[tuple[str, CompiledFn, tuple]]:
        """Yield name, function and input shapes of each program, by the shapes of a clip."""
        yield "share", self._share, (text, image)
        shared, cache = self._share.shapes(text, image)
        layout = self.config.layout
        width = layout.channels - layout.count("noisy")
        channels = jax.ShapeDtypeStruct((*noise.shape[:-1], width), noise.dtype)
        for number, (program, size) in enumerate(
            zip(self._denoise, self.chunks.sizes, strict=True)
        ):
            of_chunk = (
                jax.ShapeDtypeStruct((x.shape[0], size, *x.shape[2:]), x.dtype)
                for x in (channels, noise)
            )
            given = (*of_chunk, shared, cache, *seeds)
            yield f"chunk {number + 1}", program, given
            _, cache = program.shapes(*given)

    def count_programs(self) -> int:
        """Return the number of `programs`, without tracing any."""
        return 1 + len(self.chunks.sizes)

    def latents(
        self,
        text: Float[Any, "b n d"],
        image: Float[Any, "b m e"] | None,
        conditions: Iterable[Float[Any, "b _ h w c"]],
        noise: Float[Any, "b f h w z"],
        seeds: UInt32[Any, " b"] | None = None,
    ) -> Iterator[Float[Array, "b f h w z"]]:
        """Yield the latents of each chunk, without waiting until they are computed.

        `conditions` are the condition channels of each chunk; one is taken when the chunk before
        it is yielded. `seeds` draw the noise that a stochastic solver adds. Raises `InputError`
        for conditions of another number or length.
        """
        shared, cache = self._share(text, image)
        step_seeds = (seeds,) if self.config.solver.stochastic else ()
        number = 0
        for number, channels in enumerate(conditions, start=1):
            self._check(number, channels.shape[1])
            start, end = self.chunks.bounds[number - 1 : number + 1]
            program = self._denoise[number - 1]
            latents, cache = program(channels, noise[:, start:end], shared, cache, *step_seeds)
            yield latents
        if number != len(self.chunks.sizes):
            self._check(number, 0)

    def _check(self, number: int, frames: int) -> None:
        """Raise `InputError` unless a clip has a chunk of this number and latent frames."""
        sizes = self.chunks.sizes
        if number > len(sizes) or not frames:
            raise InputError(
                f"A clip of {self.config.name} has {len(sizes)} chunks of {self.chunks} latent "
                f"frames, but there are {'only' if not frames else 'at least'} {number} "
                "conditions. Give one for each chunk."
            )
        if frames != sizes[number - 1]:
            raise InputError(
                f"Chunk {number} of {self.config.name} has {sizes[number - 1]} latent frames, but "
                f"its condition has {frames}. The chunks of a clip have {self.chunks}."
            )
