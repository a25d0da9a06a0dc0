"""T5 1.1 text encoder, as CogVideoX uses it: padding is attended to and embedded like all tokens.

It is umT5 (`wan/umt5.py`) with one table of relative position biases for all blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from egosim_jax.models.layers import Embed, RMSNorm, scan_blocks, stack
from egosim_jax.models.t5 import Attention, FeedForward, T5Sizes, relative_buckets


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


class Block(nnx.Module):
    """Attention, then feed-forward, each added to its input."""

    def __init__(self, config: T5Config, *, rngs: nnx.Rngs):
        self.norm1 = RMSNorm(config.dim, eps=config.eps)
        self.attn = Attention(config, rngs=rngs)
        self.norm2 = RMSNorm(config.dim, eps=config.eps)
        self.ffn = FeedForward(config, rngs=rngs)

    def __call__(
        self, x: Float[Array, "b n d"], bias: Float[Array, "1 h n n"]
    ) -> Float[Array, "b n d"]:
        """Advance the residual stream by one block."""
        x = x + self.attn.attend(self.norm1(x), bias)
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
