"""Clips that are shown while they are decoded.

A causal video VAE decodes one latent frame after the other, so the first frames of a clip are known
before the last ones are decoded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from egosim_jax.conditioning.video import to_uint8
from egosim_jax.generator import Generator
from egosim_jax.program import CompiledFn
from egosim_jax.types import Action, InputError, View, check_seed

Frames = UInt8[np.ndarray, "g h w 3"]


@runtime_checkable
class CausalCodec(Protocol):
    """Video VAE that decodes one latent frame after the other (`WanVAE`)."""

    def decode_next(
        self, latents: Float[Array, "b 1 h w z"], cache: Any
    ) -> tuple[Float[Array, "b g h2 w2 3"], Any]:
        """Return the frames of the next latent frame, and the memory for the one after it."""
        ...


class Streamer:
    """Generator of single clips that shows frames as they are decoded (`VideoGenerator`)."""

    def __init__(self, generator: Generator, show: Callable[[Frames], None] = lambda _: None):
        """`show` is called with groups of frames in their order; it can be replaced at any time."""
        vae = generator.networks.vae
        if not isinstance(vae, CausalCodec):
            raise InputError(
                f"{generator.config.name} cannot be streamed: its video VAE must decode frame by "
                "frame, as Wan's does. (--config)"
            )
        self.show, self.renderer = show, generator.renderer
        self._generator = generator
        self._next = CompiledFn(_decode_next, vae, cache_key=("decode next", generator.config))

    @cached_property
    def _fingerprint(self) -> str:
        return self._generator.fingerprint()

    def fingerprint(self) -> str:
        """Return the generator's content hash: streaming is no property of a clip."""
        return self._fingerprint

    def compile(self) -> None:
        """Compile all functions before the first clip."""
        *_, (_, decode, given) = self._generator.programs(1)
        for _, program, shapes in self._generator.programs(1):
            if program is not decode:
                program.compile(*shapes)
        (whole,) = given
        latents = jax.ShapeDtypeStruct((1, 1, *whole.shape[2:]), whole.dtype)
        cache = None
        for _ in range(min(3, whole.shape[1])):
            self._next.compile(latents, cache)
            cache = self._next.shapes(latents, cache)[1]

    def __call__(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> UInt8[np.ndarray, "f h w 3"]:
        """Generate one clip; show its frames as they are decoded."""
        check_seed(seed, name="seed")
        parts = []
        for frames in self.stream(view, action, first_frame, seed):
            self.show(frames)
            parts.append(frames)
        return np.concatenate(parts)

    def stream(
        self, view: View, action: Action, first_frame: UInt8[np.ndarray, "h w 3"], seed: int
    ) -> Iterator[Frames]:
        """Yield the frames of one clip in groups: one, then four for each latent frame."""
        triplet = self._generator.condition(view, action, first_frame)
        latents = self._generator.latents([triplet], [seed])
        cache = None
        for number in range(latents.shape[1]):
            frames, cache = self._next(latents[:, number : number + 1], cache)
            yield np.asarray(frames)[0]


def _decode_next(
    vae: CausalCodec, latents: Float[Array, "b 1 h w z"], cache: Any
) -> tuple[UInt8[Array, "b g h2 w2 3"], Any]:
    frames, cache = vae.decode_next(latents, cache)
    return to_uint8(jnp.asarray(frames)), cache
