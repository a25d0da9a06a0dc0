"""T5 1.1 text encoder, as CogVideoX uses it: padding is attended to and embedded like all tokens.

It is umT5 (`wan/umt5.py`) with one table of relative position biases for all blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from egosim_jax.models.attention import attention
from egosim_jax.models.layers import Embed, Linear, RMSNorm, scan_blocks, stack
from egosim_jax.models.t5 import FeedForward, T5Sizes, relative_buckets


@dataclass(frozen=True, kw_only=True)
class T5Config(T5Sizes):
    """Sizes of the text encoder; the defaults are T5 1.1 XXL's."""

    table: ClassVar[str] = "egosim_jax.convert.tables.t5"
    """Module of the conversion table."""

    vocab: int = 32128
    """Rows of the token table; the tokenizer may use fewer."""

    def build(self, *, rngs: nnx.Rngs) -> T5:
        """Build the network with random weights."""
        return T5(self, rngs=rngs)


class SelfAttention(nnx.Module):
    """Attention with position biases that are given; the initial scores have variance 1."""

    def __init__(self, config: T5Config, *, rngs: nnx.Rngs):
        dim, inner = config.dim, config.heads * config.head_dim
        self.heads = config.heads
        linear = partial(Linear, bias=False, dtype=config.dtype, rngs=rngs)
        unscaled = nnx.initializers.variance_scaling(1 / config.head_dim, "fan_in", "normal")
        self.q = linear(dim, inner, axes=("embed", "heads"), kernel_init=unscaled)
        self.k = linear(dim, inner, axes=("embed", "heads"))
        self.v = linear(dim, inner, axes=("embed", "heads"))
        self.o = linear(inner, dim, axes=("heads", "embed"))

    def __call__(
        self, x: Float[Array, "b n d"], bias: Float[Array, "1 h n n"]
    ) -> Float[Array, "b n d"]:
        """Attend to all tokens."""
        split = partial(rearrange, pattern="b n (h k) -> b n h k", h=self.heads)
        y = attention(split(self.q(x)), split(self.k(x)), split(self.v(x)), bias=bias, scale=1.0)
        return self.o(rearrange(y, "b n h k -> b n (h k)"))


class Block(nnx.Module):
    """Attention, then feed-forward, each added to its input."""

    def __init__(self, config: T5Config, *, rngs: nnx.Rngs):
        self.norm1 = RMSNorm(config.dim, eps=config.eps)
        self.attn = SelfAttention(config, rngs=rngs)
        self.norm2 = RMSNorm(config.dim, eps=config.eps)
        self.ffn = FeedForward(config, rngs=rngs)

    def __call__(
        self, x: Float[Array, "b n d"], bias: Float[Array, "1 h n n"]
    ) -> Float[Array, "b n d"]:
        """Advance the residual stream by one block."""
        x = x + self.attn(self.norm1(x), bias)
        return x + self.ffn(self.norm2(x))


class T5(nnx.Module):
    """T5 text encoder; token ids to embeddings of width `dim`."""

    def __init__(self, config: T5Config, *, rngs: nnx.Rngs):
        self.config = config
        self.embed = Embed(config.vocab, config.dim, dtype=config.dtype, rngs=rngs)
        table = nnx.initializers.normal(config.dim**-0.5)
        self.position_bias = nnx.Param(
            table(rngs.params(), (config.buckets, config.heads)), axes=(None, "heads")
        )
        self.blocks = stack(lambda rngs: Block(config, rngs=rngs), config.layers, rngs=rngs)
        self.norm = RMSNorm(config.dim, eps=config.eps)

    def __call__(
        self, ids: Int[Array, "b n"], mask: Bool[Array, "b n"]
    ) -> Float[Array, "b n {self.config.dim}"]:
        """Embed prompts, padding included, whatever `mask` says."""
        buckets = relative_buckets(
            ids.shape[1], buckets=self.config.buckets, max_distance=self.config.max_distance
        )
        bias = rearrange(self.position_bias[...].astype(jnp.float32)[buckets], "n m h -> 1 h n m")
        x, _ = scan_blocks(lambda block, x, _: (block(x, bias), None), self.blocks, self.embed(ids))
        return self.norm(x).astype(self.config.dtype)
