"""Causal use of Wan's video transformer: chunks of a clip attend to the clean chunks before them.

A chunk is denoised with the keys and values of the chunks before it, which are kept (`cached`), or
all chunks of a clip are trained at once (`packed`). With C chunks, the packed tokens are

    clean 1 ... clean C-1 | noisy 1 ... noisy C

Clean chunk c attends to clean chunks 1 to c; noisy chunk c to clean chunks 1 to c-1 and to itself.
Each is one call of the attention kernel, so there is no mask.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from egosim_jax.models.attention import Kernel, attention, by_heads, split_tokens
from egosim_jax.models.wan.layers import Attend, KeysValues
from egosim_jax.sharding import constrain, parts, several_devices
from egosim_jax.types import InputError

CACHE = (None, "batch", None, "heads", None)
"""Logical axes of cached keys and values."""


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class KeyValueCache:
    """Self-attention keys and values of the finished chunks of a clip, for all layers.

    The arrays have room for the clip.
    """

    keys: Float[Array, "l b n h k"]
    """Keys, rotated by their positions in the clip."""
    values: Float[Array, "l b n h k"]
    """Values by token and head, not rotated."""
    latents: tuple[int, int, int] = field(metadata={"static": True})
    """Latent frames, rows and columns of the clip."""
    frames: int = field(default=0, metadata={"static": True})
    """Latent frames of the finished chunks."""

    def put(self, chunk: KeysValues) -> KeyValueCache:
        """Return the cache with the keys and values of one more chunk."""
        tokens = self.keys.shape[2] // self.latents[0]
        start = self.frames * tokens
        keys, values = (
            constrain(jax.lax.dynamic_update_slice_in_dim(old, new, start, axis=2), CACHE)
            for old, new in zip((self.keys, self.values), chunk, strict=True)
        )
        frames = self.frames + chunk[0].shape[2] // tokens
        return replace(self, keys=keys, values=values, frames=frames)

    def check(self, noisy: tuple[int, ...], first_frame: int) -> None:
        """Raise `InputError` unless the next chunk of this clip is `noisy` at `first_frame`."""
        batch, frames, *cells, _ = noisy
        if (batch, *cells) != (self.keys.shape[1], *self.latents[1:]):
            raise InputError(
                f"A chunk of {batch} clips of {cells[0]} x {cells[1]} latent cells does not fit "
                f"cached keys of {self.keys.shape[1]} clips of {self.latents[1]} x "
                f"{self.latents[2]}. Begin a clip with an empty cache of its size."
            )
        if first_frame != self.frames or self.frames + frames > self.latents[0]:
            raise InputError(
                f"A chunk of the latent frames {first_frame} to {first_frame + frames - 1} does "
                f"not continue cached keys of the first {self.frames} of {self.latents[0]}: they "
                "are another clip's, or a chunk is missing. Denoise the chunks of a clip in order, "
                "each with the cache that the one before it returned."
            )


def whole(kernel: Kernel) -> Attend:
    """Return the attention of all tokens to all tokens, which keeps nothing."""
    return lambda q, k, v: (attention(q, k, v, kernel=kernel, over="heads"), None)


def packed(bounds: Sequence[int], kernel: Kernel) -> Attend:
    """Return the attention of packed chunks, which keeps nothing.

    `bounds` are the first token of each chunk of a clip, and the number of the clip's tokens.
    """
    one, clean = partial(attention, kernel=kernel), bounds[-2]

    def attend(q: jax.Array, k: jax.Array, v: jax.Array) -> jax.Array:
        found = [
            one(q[:, start:end], k[:, :end], v[:, :end]) for start, end in pairwise(bounds[:-1])
        ]
        for start, end in pairwise(bounds):
            own = slice(clean + start, clean + end)
            seen = (jnp.concatenate([x[:, :start], x[:, own]], axis=1) for x in (k, v))
            found.append(one(q[:, own], *seen))
        return jnp.concatenate(found, axis=1)

    return lambda q, k, v: (split_tokens(by_heads(attend, q, k, v)), None)


def cached(past: KeysValues | None, start: int, kernel: Kernel) -> Attend:
    """Return the attention of a chunk to a clip's first `start` tokens and itself.

    It keeps the keys and values of the chunk, whose heads are split over the devices along context.
    """

    def attend(q: jax.Array, k: jax.Array, v: jax.Array, *past: jax.Array) -> tuple[Any, Any]:
        joined = [
            jnp.concatenate([old[:, :start], new], axis=1)
            for old, new in zip(past, (k, v), strict=False)  # the first chunk has no past
        ]
        seen = joined or (k, v)
        return attention(q, *seen, kernel=kernel), (k, v)

    def split(q: jax.Array, k: jax.Array, v: jax.Array) -> tuple[Any, Any]:
        out, kept = by_heads(attend, q, k, v, *(past or ()))
        return split_tokens(out), kept

    return split


def by_run(x: Float[Array, "b g *d"], lengths: Sequence[int]) -> Float[Array, "b u *d"]:
    """Return the vectors of runs of tokens of these lengths as the vectors of equal runs.

    Each device along context has whole equal runs.
    """
    if len(lengths) == 1:
        return x
    devices = parts("tokens") if several_devices() else 1
    x = constrain(x, ("batch", *[None] * (x.ndim - 1)))  # not by channels, as runs are cut out
    unit = math.gcd(*lengths, sum(lengths) // devices)
    rows = [
        jnp.broadcast_to(x[:, n : n + 1], (len(x), length // unit, *x.shape[2:]))
        for n, length in enumerate(lengths)
    ]
    return jnp.concatenate(rows, axis=1)
