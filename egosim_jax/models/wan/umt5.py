"""umT5 text encoder: token ids of a prompt to the embeddings that the denoiser attends to.

The encoder of T5 1.1 (Raffel et al. 2020) as trained in umT5 (Chung et al. 2023). Each block adds

    x += O softmax(q k^T + B) v       q, k, v linear in RMSNorm(x); scores are not scaled
    x += D (gelu(G y) * U y)          y = RMSNorm(x), gelu in its tanh form

and a last RMSNorm follows; no linear has a bias. B depends on the offset of key and query only,
B[h, i, j] = table[bucket(j - i), h], and every block has its own table (in T5 all share one).
Half of the buckets are for keys after the query. Within a half of m buckets, the first m/2 are the
distances 0 ... m/2 - 1; the others widen logarithmically up to `max_distance`:

    bucket(d) = m/2 + floor(m/2 log(2 d/m) / log(2 max_distance/m)),  at most m - 1

Padding is never attended to, and its embeddings are 0, as in Wan 2.1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from egosim_jax.models.layers import Embed, RMSNorm, scan_blocks, stack
from egosim_jax.models.t5 import Attention, FeedForward, T5Sizes, relative_buckets


@dataclass(frozen=True, kw_only=True)
class UMT5Config(T5Sizes):
    """Sizes of the text encoder; the defaults are umT5-XXL's."""

    table: ClassVar[str] = "egosim_jax.convert.tables.umt5"
    """Module of the conversion table."""

    vocab: int = 256384
    """Rows of the token table; the tokenizer may use fewer."""

    def build(self, *, rngs: nnx.Rngs) -> UMT5:
        """Build the network with random weights."""
        return UMT5(self, rngs=rngs)


class SelfAttention(Attention):
    """Attention with a table of relative position biases; the initial scores have variance 1."""

    def __init__(self, config: UMT5Config, *, rngs: nnx.Rngs):
        super().__init__(config, rngs=rngs)
        table = nnx.initializers.normal(config.dim**-0.5)
        self.position_bias = nnx.Param(
            table(rngs.params(), (config.buckets, config.heads)), axes=(None, "heads")
        )

    def __call__(
        self,
        x: Float[Array, "b n d"],
        buckets: Int[np.ndarray, "n n"],
        mask: Bool[Array, "b n"],
    ) -> Float[Array, "b n d"]:
        """Attend to the tokens of `mask`."""
        bias = self.position_bias[...].astype(jnp.float32)[buckets]
        bias = rearrange(bias, "n m h -> 1 h n m")
        bias = jnp.where(mask[:, None, None, :], bias, jnp.finfo(jnp.float32).min)
        return self.attend(x, bias)


class Block(nnx.Module):
    """Attention, then feed-forward, each added to its input."""

    def __init__(self, config: UMT5Config, *, rngs: nnx.Rngs):
        self.norm1 = RMSNorm(config.dim, eps=config.eps)
        self.attn = SelfAttention(config, rngs=rngs)
        self.norm2 = RMSNorm(config.dim, eps=config.eps)
        self.ffn = FeedForward(config, rngs=rngs)

    def __call__(
        self,
        x: Float[Array, "b n d"],
        buckets: Int[np.ndarray, "n n"],
        mask: Bool[Array, "b n"],
    ) -> Float[Array, "b n d"]:
        """Advance the residual stream by one block."""
        x = x + self.attn(self.norm1(x), buckets, mask)
        return x + self.ffn(self.norm2(x))


class UMT5(nnx.Module):
    """umT5 text encoder; token ids to embeddings of width `dim`."""

    def __init__(self, config: UMT5Config, *, rngs: nnx.Rngs):
        self.config = config
        self.embed = Embed(config.vocab, config.dim, dtype=config.dtype, rngs=rngs)
        self.blocks = stack(lambda rngs: Block(config, rngs=rngs), config.layers, rngs=rngs)
        self.norm = RMSNorm(config.dim, eps=config.eps)

    def __call__(
        self, ids: Int[Array, "b n"], mask: Bool[Array, "b n"]
    ) -> Float[Array, "b n {self.config.dim}"]:
        """Embed prompts; `mask` is True on their tokens, and the embeddings are 0 elsewhere."""
        buckets = relative_buckets(
            ids.shape[1], buckets=self.config.buckets, max_distance=self.config.max_distance
        )
        x, _ = scan_blocks(
            lambda block, x, _: (block(x, buckets, mask), None), self.blocks, self.embed(ids)
        )
        return jnp.where(mask[..., None], self.norm(x), 0.0).astype(self.config.dtype)
