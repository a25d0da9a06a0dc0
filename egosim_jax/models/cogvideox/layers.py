"""Layers of CogVideoX's video transformer.

Shift, scale and gate come from the time embedding: one triple for text tokens and one for video
tokens. A block is

    x <- x + gate_a · Attention((1 + scale_a) · LN(x) + shift_a)
    x <- x + gate_m · MLP((1 + scale_m) · LN(x) + shift_m)

with a layer norm of the queries and keys of each head, and rotary positions of the video's tokens.

Norms, modulation, gates and rotations are float32; matrix products and the residual stream are in
the config's `dtype`, or the factors of the blocks' products alone in bfloat16 (`products`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models import rope
from egosim_jax.models.attention import Kernel, attention
from egosim_jax.models.layers import LayerNorm, Linear, Products, modulate
from egosim_jax.models.remat import Level, name_projection
from egosim_jax.models.sinusoid import float32_sinusoid, time_sinusoid
from egosim_jax.types import InputError, check_counts

PATCH = 2
"""Latent rows and columns of a token; a token has one latent frame."""


@dataclass(frozen=True, kw_only=True)
class CogVideoXDiTSizes:
    """Sizes and numerics of the transformer; the defaults are CogVideoX-Fun V1.1 5B InP's."""

    in_channels: int = 33
    """Channels of the noisy latents and the condition together."""
    out_channels: int = 16
    """Channels of the noisy latents and the prediction."""
    dim: int = 3072
    """Width of a token's embedding, in channels."""
    heads: int = 48
    """Attention heads, each of dim / heads."""
    layers: int = 42
    """Number of transformer blocks."""
    text_dim: int = 4096
    """Width of the text encoder's tokens."""
    time_dim: int = 512
    """Width of the time embedding."""
    base_rows: int = 30
    """Rows of tokens of the images that the base model was trained with."""
    base_columns: int = 45
    """Columns of tokens of those images."""
    eps: float = 1e-5
    """Epsilon of the norms."""
    qk_eps: float = 1e-6
    """Epsilon of the norms of queries and keys."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Compute dtype of matrix products and the residual stream."""
    products: Products | None = None
    """Dtype of the factors of the blocks' matrix products, attention's included; None: `dtype`.

    With bfloat16 sums and all else stay in `dtype`."""
    attention: Kernel = "auto"
    """Attention kernel of the transformer."""
    time_angles: Literal["exact", "float32"] = "exact"
    """Angles of the time embedding: exact, or products in float32 as in diffusers."""
    remat: Level = "none"
    """Activations that the backward pass recomputes."""

    def __post_init__(self) -> None:
        sizes = (
            "out_channels", "dim", "heads", "layers", "text_dim", "time_dim",
            "base_rows", "base_columns",
        )  # fmt: skip
        check_counts({name: getattr(self, name) for name in sizes})
        if self.in_channels < self.out_channels:
            raise InputError(
                f"in_channels {self.in_channels} must hold the {self.out_channels} noisy channels "
                "(out_channels) and the condition's channels."
            )
        if self.dim % self.heads or self.head_dim % 16:
            raise InputError(
                f"dim {self.dim} does not split into {self.heads} heads of a multiple of 16: a "
                "quarter of a head turns with the frame, and three eighths each with the row and "
                "the column, in pairs. Change heads."
            )
        if self.attention in ("cudnn", "hopper") and self.dtype == "float32":
            raise InputError(
                f'The {self.attention} attention kernel needs dtype "bfloat16", not "float32".'
            )

    @property
    def ffn_dim(self) -> int:
        """Hidden width of the MLP."""
        return 4 * self.dim

    @property
    def head_dim(self) -> int:
        """Size of an attention head."""
        return self.dim // self.heads

    @property
    def attention_dtype(self) -> str:
        """Dtype of queries, keys and values."""
        return self.products or self.dtype


class Modulation(nnx.Module):
    """Layer norm with `n` vectors from the time embedding."""

    def __init__(self, config: CogVideoXDiTSizes, n: int, *, rngs: nnx.Rngs):
        self.norm = LayerNorm(config.dim, eps=config.eps)
        self.linear = Linear(
            config.time_dim, n * config.dim, axes=(None, "embed"), dtype=config.dtype, rngs=rngs
        )
        self.n = n

    def vectors(self, time: Any) -> Float[Array, "n b m d"]:
        """Return the vectors from the time embedding `b e`, one for all tokens, in float32."""
        y = self.linear(jax.nn.silu(time)).astype(jnp.float32)
        return rearrange(y, "b (n d) -> n b 1 d", n=self.n)


class Attention(nnx.Module):
    """Self-attention of the tokens of text and video."""

    def __init__(self, config: CogVideoXDiTSizes, *, rngs: nnx.Rngs):
        sizes = (config.dim, config.dim)
        self.config = config

        def linear(axes: tuple[str, str]) -> Linear:
            return Linear(
                *sizes, axes=axes, dtype=config.dtype, products=config.products, rngs=rngs
            )

        self.q = linear(("embed", "heads"))
        self.k = linear(("embed", "heads"))
        self.v = linear(("embed", "heads"))
        self.o = linear(("heads", "embed"))
        self.norm_q = LayerNorm(config.head_dim, eps=config.qk_eps, axes=(None,))
        self.norm_k = LayerNorm(config.head_dim, eps=config.qk_eps, axes=(None,))

    def __call__(
        self, x: Float[Array, "b n d"], rotation: Float[Array, "n k 2"]
    ) -> Float[Array, "b n d"]:
        """Attend from all tokens to all tokens."""
        q, k, v = (
            rearrange(name_projection(linear(x)), "b n (h k) -> b n h k", h=self.config.heads)
            for linear in (self.q, self.k, self.v)
        )
        q, k = (
            rope.rotate(norm(heads), rotation)
            for norm, heads in ((self.norm_q, q), (self.norm_k, k))
        )
        q, k, v = (heads.astype(self.config.attention_dtype) for heads in (q, k, v))
        y = attention(q, k, v, kernel=self.config.attention, over="heads")
        return name_projection(self.o(rearrange(y, "b n h k -> b n (h k)")))


class MLP(nnx.Module):
    """Linear, GELU in its tanh form, linear."""

    def __init__(self, config: CogVideoXDiTSizes, *, rngs: nnx.Rngs):
        numerics: Any = {"dtype": config.dtype, "products": config.products}
        dim, hidden = config.dim, config.ffn_dim
        self.up = Linear(dim, hidden, axes=("embed", "mlp"), **numerics, rngs=rngs)
        self.down = Linear(hidden, dim, axes=("mlp", "embed"), **numerics, rngs=rngs)

    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b n d"]:
        """Map every token by itself."""
        return self.down(jax.nn.gelu(self.up(x), approximate=True))


class Block(nnx.Module):
    """Transformer block: attention and MLP on the residual stream of text and video."""

    def __init__(self, config: CogVideoXDiTSizes, *, rngs: nnx.Rngs):
        self.modulation_a = Modulation(config, 6, rngs=rngs)
        self.attn = Attention(config, rngs=rngs)
        self.modulation_m = Modulation(config, 6, rngs=rngs)
        self.mlp = MLP(config, rngs=rngs)

    def __call__(
        self,
        x: Float[Array, "b n d"],
        time: Any,
        rotation: Float[Array, "n k 2"],
        is_text: Float[Array, "1 n 1"],
    ) -> Float[Array, "b n d"]:
        """Update the residual stream; sums are taken in float32 and kept in x's dtype.

        `time` is the input of the modulations, the time embedding `b e`.
        """
        for modulation, layer in (
            (self.modulation_a, lambda y: self.attn(y, rotation)),
            (self.modulation_m, self.mlp),
        ):
            video, text = jnp.split(modulation.vectors(time), 2)
            shift, scale, gate = jnp.where(is_text > 0, text, video)
            y = layer(modulate(modulation.norm(x), shift, scale))
            x = (x + gate * y).astype(x.dtype)
        return x


class TimeEmbedding(nnx.Module):
    """Embedding of timesteps in float32."""

    def __init__(self, config: CogVideoXDiTSizes, *, rngs: nnx.Rngs):
        self.sinusoid = {"exact": time_sinusoid, "float32": float32_sinusoid}[config.time_angles]
        self.dim = config.dim
        dim, hidden, dtype = config.dim, config.time_dim, config.dtype
        self.up = Linear(dim, hidden, axes=("embed", None), dtype=dtype, rngs=rngs)
        self.down = Linear(hidden, hidden, axes=(None, None), dtype=dtype, rngs=rngs)

    def __call__(self, t: Float[Array, " b"]) -> Float[Array, "b e"]:
        """Embed timesteps in [0, 1000]."""
        hidden = jax.nn.silu(self.up(self.sinusoid(t, self.dim)))
        return self.down(hidden).astype(jnp.float32)
