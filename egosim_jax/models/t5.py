"""Text encoders of the T5 family: token ids of a prompt to what the denoiser attends to.

The encoder of T5 1.1 (Raffel et al. 2020) and of umT5 (Chung et al. 2023). Each block adds

    x += O softmax(q k^T + B) v       q, k, v linear in RMSNorm(x); scores are not scaled
    x += D (gelu(G y) * U y)          y = RMSNorm(x), gelu in its tanh form

and a last RMSNorm follows; no linear has a bias. B depends on the offset of key and query only,
B[h, i, j] = table[bucket(j - i), h]. Half of the buckets are for keys after the query. Within a
half of m buckets, the first m/2 are the distances 0 ... m/2 - 1; the others widen logarithmically
up to `max_distance`:

    bucket(d) = m/2 + floor(m/2 log(2 d/m) / log(2 max_distance/m)),  at most m - 1

In umT5 every block has a table, padding is never attended to, and its embeddings are 0, as in Wan
2.1. In T5 all blocks share one table, and padding is attended to and embedded like all tokens, as
in CogVideoX.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from egosim_jax.models.attention import attention
from egosim_jax.models.layers import Embed, Linear, RMSNorm, scan_blocks, stack
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class T5Sizes:
    """Sizes of a text encoder of the T5 family; the defaults are the XXL models'."""

    per_block: ClassVar[bool]
    """True if every block has a table of biases and padding does not count, as in umT5."""

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

    def build(self, *, rngs: nnx.Rngs) -> TextEncoder:
        """Build the network with random weights."""
        return TextEncoder(self, rngs=rngs)


@dataclass(frozen=True, kw_only=True)
class UMT5Config(T5Sizes):
    """Sizes of umT5; the defaults are umT5-XXL's."""

    table: ClassVar[str] = "egosim_jax.convert.tables.umt5"
    """Module of the conversion table."""
    per_block = True

    vocab: int = 256384
    """Rows of the token table; the tokenizer may use fewer."""


@dataclass(frozen=True, kw_only=True)
class T5Config(T5Sizes):
    """Sizes of T5 1.1; the defaults are T5 1.1 XXL's."""

    table: ClassVar[str] = "egosim_jax.convert.tables.t5"
    """Module of the conversion table."""
    per_block = False

    vocab: int = 32128
    """Rows of the token table; the tokenizer may use fewer."""


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


def position_biases(config: T5Sizes, *, rngs: nnx.Rngs) -> nnx.Param:
    """Return a random table of relative position biases."""
    draw = nnx.initializers.normal(config.dim**-0.5)
    return nnx.Param(draw(rngs.params(), (config.buckets, config.heads)), axes=(None, "heads"))


class Attention(nnx.Module):
    """Self-attention with position biases; the initial scores have variance 1."""

    def __init__(self, config: T5Sizes, *, rngs: nnx.Rngs):
        dim, inner = config.dim, config.heads * config.head_dim
        self.heads = config.heads
        linear = partial(Linear, bias=False, dtype=config.dtype, rngs=rngs)
        unscaled = nnx.initializers.variance_scaling(1 / config.head_dim, "fan_in", "normal")
        self.q = linear(dim, inner, axes=("embed", "heads"), kernel_init=unscaled)
        self.k = linear(dim, inner, axes=("embed", "heads"))
        self.v = linear(dim, inner, axes=("embed", "heads"))
        self.o = linear(inner, dim, axes=("heads", "embed"))
        self.position_bias = position_biases(config, rngs=rngs) if config.per_block else None

    def __call__(
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


class Block(nnx.Module):
    """Attention, then feed-forward, each added to its input."""

    def __init__(self, config: T5Sizes, *, rngs: nnx.Rngs):
        self.norm1 = RMSNorm(config.dim, eps=config.eps)
        self.attn = Attention(config, rngs=rngs)
        self.norm2 = RMSNorm(config.dim, eps=config.eps)
        self.ffn = FeedForward(config, rngs=rngs)

    def __call__(
        self, x: Float[Array, "b n d"], bias: Float[Array, "#b h n n"]
    ) -> Float[Array, "b n d"]:
        """Advance the residual stream by one block."""
        x = x + self.attn(self.norm1(x), bias)
        return x + self.ffn(self.norm2(x))


class TextEncoder(nnx.Module):
    """Text encoder of the T5 family; token ids to embeddings of width `dim`."""

    def __init__(self, config: T5Sizes, *, rngs: nnx.Rngs):
        self.config = config
        self.embed = Embed(config.vocab, config.dim, dtype=config.dtype, rngs=rngs)
        self.position_bias = None if config.per_block else position_biases(config, rngs=rngs)
        self.blocks = stack(lambda rngs: Block(config, rngs=rngs), config.layers, rngs=rngs)
        self.norm = RMSNorm(config.dim, eps=config.eps)

    def __call__(
        self, ids: Int[Array, "b n"], mask: Bool[Array, "b n"]
    ) -> Float[Array, "b n {self.config.dim}"]:
        """Embed prompts; `mask` is True on their tokens, and counts in umT5 only."""
        config, x = self.config, self.embed(ids)
        buckets = relative_buckets(
            ids.shape[1], buckets=config.buckets, max_distance=config.max_distance
        )

        def biases(table: Any) -> Float[Array, "1 h n n"]:
            return rearrange(table[...].astype(jnp.float32)[buckets], "n m h -> 1 h n m")

        if self.position_bias is not None:
            bias = biases(self.position_bias)
            x, _ = scan_blocks(lambda block, x, _: (block(x, bias), None), self.blocks, x)
            return self.norm(x).astype(config.dtype)

        def masked(block: Block, x: Array, _: None) -> tuple[Array, None]:
            bias = biases(block.attn.position_bias)
            bias = jnp.where(mask[:, None, None, :], bias, jnp.finfo(jnp.float32).min)
            return block(x, bias), None

        x, _ = scan_blocks(masked, self.blocks, x)
        return jnp.where(mask[..., None], self.norm(x), 0.0).astype(config.dtype)
