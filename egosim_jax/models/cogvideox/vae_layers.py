"""Layers of CogVideoX's video VAE: convolutions over time, norms and resampling."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from einops import rearrange, repeat
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models.conv import Conv

Cache = Any
"""Last input frames of a layer's convolutions over time; None at the start of a video."""


def causal_conv(
    conv: Conv, x: Float[Array, "b f h w i"], cache: Cache
) -> tuple[Float[Array, "b f h w o"], Cache]:
    """Convolve each frame with the two before it; before the first, it is repeated."""
    x = x.astype(conv.dtype)
    if cache is None:
        cache = jnp.repeat(x[:, :1], 2, axis=1)
    x = jnp.concatenate([cache, x], axis=1)
    return conv(x), x[:, -2:]


class GroupNorm(nnx.Module):
    """Group norm over the frames of a chunk, rows, columns and a group's channels, in float32."""

    def __init__(self, dim: int, *, groups: int, eps: float):
        self.groups, self.eps = groups, eps
        self.scale = nnx.Param(jnp.ones(dim), axes=(None,))
        self.bias = nnx.Param(jnp.zeros(dim), axes=(None,))

    def __call__(self, x: Float[Array, "b f h w c"]) -> Float[Array, "b f h w c"]:
        """Normalize; the result is float32."""
        y = rearrange(x.astype(jnp.float32), "b f h w (g c) -> b f h w g c", g=self.groups)
        y = y - _group_mean(y)
        y = y * jax.lax.rsqrt(_group_mean(jnp.square(y)) + self.eps)
        y = rearrange(y, "b f h w g c -> b f h w (g c)")
        return y * self.scale[...].astype(jnp.float32) + self.bias[...].astype(jnp.float32)


def _group_mean(y: Float[Array, "b f h w g c"]) -> Float[Array, "b 1 1 1 g 1"]:
    """Return the means of groups; rows first, as one long sum in float32 loses digits on CPUs."""
    rows = jax.lax.optimization_barrier(y.mean((3, 5), keepdims=True))  # else XLA joins the sums
    return rows.mean((1, 2), keepdims=True)


def fit(z: Float[Array, "b f h w c"], shape: tuple[int, ...]) -> Float[Array, "b f2 h2 w2 c"]:
    """Repeat latent cells to the frames, rows and columns of a shape.

    With an odd number of frames above one, the first latent frame is not repeated in time.
    """
    _, frames, height, width, _ = shape
    z = repeat(z, "b f h w c -> b f (h i) (w j) c", i=height // z.shape[2], j=width // z.shape[3])
    if frames > 1 and frames % 2:
        times = (frames - 1) // (z.shape[1] - 1)
        return jnp.concatenate([z[:, :1], jnp.repeat(z[:, 1:], times, axis=1)], axis=1)
    return jnp.repeat(z, frames // z.shape[1], axis=1)


class Downsample(nnx.Module):
    """Average pairs of frames, if `temporal`, and halve rows and columns by a convolution."""

    def __init__(self, dim: int, *, temporal: bool, dtype: str, rngs: nnx.Rngs):
        self.conv = Conv((3, 3), dim, dim, dtype=dtype, rngs=rngs)
        self.temporal = temporal

    def __call__(self, x: Float[Array, "b f h w c"]) -> Float[Array, "b g y x c"]:
        """Downsample; of an odd number of frames the first stays as it is."""
        if self.temporal:
            odd = x.shape[1] % 2
            pairs = rearrange(x[:, odd:], "b (f two) h w c -> b f two h w c", two=2).mean(axis=2)
            x = jnp.concatenate([x[:, :odd], pairs], axis=1)
        return self.conv.downsample2x(x)


class Upsample(nnx.Module):
    """Double rows and columns and, if `temporal`, frames; then convolve images."""

    def __init__(self, dim: int, *, temporal: bool, dtype: str, rngs: nnx.Rngs):
        self.conv = Conv((3, 3), dim, dim, dtype=dtype, rngs=rngs)
        self.temporal = temporal

    def __call__(self, x: Float[Array, "b f h w c"]) -> Float[Array, "b g y x c"]:
        """Upsample; of an odd number of frames the first is not doubled."""
        if self.temporal:
            odd = x.shape[1] % 2
            x = jnp.concatenate([x[:, :odd], jnp.repeat(x[:, odd:], 2, axis=1)], axis=1)
        return self.conv(repeat(x, "b f h w c -> b f (h i) (w j) c", i=2, j=2))
