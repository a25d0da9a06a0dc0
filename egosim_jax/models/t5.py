"""Parts that the text encoders of the T5 family share (Raffel et al. 2020, T5 1.1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import jax
import numpy as np
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float, Int

from egosim_jax.models.attention import attention
from egosim_jax.models.layers import Linear
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class T5Sizes:
    """Sizes of a text encoder of the T5 family; the defaults are the XXL models'."""

    vocab: int
    """Rows of the token table; the tokenizer may use fewer."""
    dim: int = 4096
    """Width of the embeddings."""
    ffn_dim: int = 10240
    """Hidden width of the gated feed-forward layer."""
    heads: int = 64
    """Attention heads; heads x head_dim need not be `dim`."""
    head_dim: int = 64
    """Width of a head."""
    layers: int = 24
    """Number of transformer blocks."""
    buckets: int = 32
    """Relative-position buckets, of both directions together."""
    max_distance: int = 128
    """Distance in tokens from which on all positions share the last bucket of their direction."""
    eps: float = 1e-6
    """Added to the mean square in RMSNorm."""
    dtype: str = "float32"
    """Dtype of the linears and of the residual stream; norms and softmax are float32."""

    def __post_init__(self) -> None:
        """Check that each direction has exact and logarithmic buckets."""
        if self.buckets < 4 or self.buckets % 4:
            raise InputError(
                f"{self.buckets} buckets cannot be split into two directions of exact and "
                "logarithmic ones: buckets must be a multiple of 4."
            )
        if self.max_distance <= self.buckets // 4:
            raise InputError(
                f"max_distance {self.max_distance} leaves no room for logarithmic buckets: it must "
                f"be above buckets / 4 = {self.buckets // 4}."
            )


def relative_buckets(
    tokens: int, *, buckets: int, max_distance: int
) -> Int[np.ndarray, "{tokens} {tokens}"]:
    """Return the bucket of every (query, key) pair of positions, a constant of the traced program.

    The logarithm is taken in float32, in which the official weights were trained: a distance on
    the border of two buckets must round the same way.
    """
    positions = np.arange(tokens)
    offset = positions[None, :] - positions[:, None]
    half, exact = buckets // 2, buckets // 4
    distance = np.maximum(np.abs(offset), 1).astype(np.float32)
    octaves = np.log(distance / exact) / np.float32(np.log(max_distance / exact))
    far = np.minimum(exact + (octaves * (half - exact)).astype(np.int32), half - 1)
    bucket = np.where(np.abs(offset) < exact, np.abs(offset), far)
    return (bucket + half * (offset > 0)).astype(np.int32)


class Attention(nnx.Module):
    """Self-attention with given position biases; the initial scores have variance 1."""

    def __init__(self, config: T5Sizes, *, rngs: nnx.Rngs):
        dim, inner = config.dim, config.heads * config.head_dim
        self.heads = config.heads
        linear = partial(Linear, bias=False, dtype=config.dtype, rngs=rngs)
        unscaled = nnx.initializers.variance_scaling(1 / config.head_dim, "fan_in", "normal")
        self.q = linear(dim, inner, axes=("embed", "heads"), kernel_init=unscaled)
        self.k = linear(dim, inner, axes=("embed", "heads"))
        self.v = linear(dim, inner, axes=("embed", "heads"))
        self.o = linear(inner, dim, axes=("heads", "embed"))

    def attend(
        self, x: Float[Array, "b n d"], bias: Float[Array, "#b h n n"]
    ) -> Float[Array, "b n d"]:
        """Attend to all tokens, with `bias` added to the scores."""
        split = partial(rearrange, pattern="b n (h k) -> b n h k", h=self.heads)
        y = attention(split(self.q(x)), split(self.k(x)), split(self.v(x)), bias=bias, scale=1.0)
        return self.o(rearrange(y, "b n h k -> b n (h k)"))


class FeedForward(nnx.Module):
    """Two linears, one through a GELU, multiplied and projected back."""

    def __init__(self, config: T5Sizes, *, rngs: nnx.Rngs):
        linear = partial(Linear, bias=False, dtype=config.dtype, rngs=rngs)
        self.gate = linear(config.dim, config.ffn_dim, axes=("embed", "mlp"))
        self.up = linear(config.dim, config.ffn_dim, axes=("embed", "mlp"))
        self.down = linear(config.ffn_dim, config.dim, axes=("mlp", "embed"))

    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b n d"]:
        """Transform every token by itself."""
        return self.down(jax.nn.gelu(self.gate(x), approximate=True) * self.up(x))
