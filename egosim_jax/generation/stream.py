"""Streaming: frames of a clip as soon as they are decoded.

A causal video VAE decodes one latent frame after the other, so the first frames of a clip are ready
before the last ones are decoded. They are the frames that decoding the whole clip gives.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from egosim_jax.conditioning.pixels import to_uint8
from egosim_jax.generation.compiled import CompiledFn
from egosim_jax.generation.generator import Generator
from egosim_jax.types import Action, Triplet, View, check_seed


@runtime_checkable
class CausalCodec(Protocol):
    """Video VAE that decodes one latent frame after the other (`WanVAE`)."""

    def decode_next(
        self, latents: Float[Array, "b 1 h w z"], cache: Any
    ) -> tuple[Float[Array, "b g h2 w2 3"], Any]:
        """Return the frames of the next latent frame, and the cache for the one after it."""
        ...


class Streamer:
    """Generator that yields frames as they are decoded (`simulator.StreamedGenerator`)."""

    def __init__(self, generator: Generator):
        """Stream a generator's clips; if its VAE is not causal, all frames are one group."""
        self.renderer = generator.renderer
        self.point_px = generator.point_px
        self._generator = generator
        vae = generator.networks.vae
        self._next = (
            CompiledFn(
                _decode_next,
                vae,
                mesh=generator.mesh,
                cache_key=("decode next", generator.config),
            )
            if isinstance(vae, CausalCodec)
            else None
        )

    @cached_property
    def _fingerprint(self) -> str:
        return self._generator.fingerprint()

    def fingerprint(self) -> str:
        """Return the generator's content hash: streaming does not change a clip."""
        return self._fingerprint

    def compile(self, batch: int = 1) -> None:
        """Compile all functions for batches of this size before the first clip."""
        if self._next is None:
            self._generator.compile(batch)
            return
        *others, (_, _, (whole,)) = self._generator.programs(batch)
        for _, program, shapes in others:
            program.compile(*shapes)
        latents = jax.ShapeDtypeStruct((batch, 1, *whole.shape[2:]), whole.dtype)
        cache = None
        # The shapes of the cache are constant from the third latent frame on.
        for _ in range(min(3, whole.shape[1])):
            self._next.compile(latents, cache)
            cache = self._next.shapes(latents, cache)[1]

    def condition(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"]
    ) -> Triplet:
        """Return the conditions of a clip; raises the errors of `Generator.condition`."""
        return self._generator.condition(view, action, first_frame)

    def groups(
        self, triplets: Sequence[Triplet], seeds: Sequence[int]
    ) -> Iterator[UInt8[np.ndarray, "b g h w 3"]]:
        """Yield groups of frames of one clip per triplet: one frame, then four per latent frame.

        Raises the errors of `Generator.generate`, before the first group.
        """
        if self._next is None:
            clips = self._generator.generate(triplets, seeds)
            yield np.stack([clip.frames for clip in clips])
            return
        latents, cache = self._generator.latents(triplets, seeds), None
        for number in range(latents.shape[1]):
            frames, cache = self._next(latents[:, number : number + 1], cache)
            yield np.asarray(frames)

    def stream(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> Iterator[UInt8[np.ndarray, "g h w 3"]]:
        """Yield the frames of one clip in groups."""
        check_seed(seed, name="seed")
        for frames in self.groups([self.condition(view, action, first_frame)], [seed]):
            yield frames[0]

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """Generate one clip."""
        return np.concatenate(list(self.stream(view, action, first_frame, seed)))


def _decode_next(
    vae: CausalCodec, latents: Float[Array, "b 1 h w z"], cache: Any
) -> tuple[UInt8[Array, "b g h2 w2 3"], Any]:
    frames, cache = vae.decode_next(latents, cache)
    return to_uint8(jnp.asarray(frames)), cache
