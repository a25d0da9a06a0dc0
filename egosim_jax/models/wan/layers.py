"""Layers of Wan 2.1's video transformer.

With e = modulation + time embedding, six vectors shift, scale, gate for attention and for the MLP,
a block is

    x <- x + gate_a · SelfAttention((1 + scale_a) · LN(x) + shift_a)
    x <- x + CrossAttention(LN(x) · g + b, text, image)
    x <- x + gate_m · MLP((1 + scale_m) · LN(x) + shift_m)

with RMS norm of queries and keys over the full width, rotary positions in self-attention, and one
query for two cross-attentions, to the text and to the image, whose outputs are summed.

Norms, modulation, gates and rotations are float32; matrix products and the residual stream are in
the config's `dtype`, or the products' factors alone in bfloat16 (`products`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial, reduce
from typing import Any, Literal

import jax
import jax.numpy as jnp
from einops import rearrange, repeat
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models import rope
from egosim_jax.models.attention import Kernel, attention
from egosim_jax.models.layers import (
    Axes,
    Initializer,
    LayerNorm,
    Linear,
    Products,
    RMSNorm,
    modulate,
    zeros,
)
from egosim_jax.models.remat import Level, name_projection
from egosim_jax.models.sinusoid import time_sinusoid
from egosim_jax.types import InputError, check_counts

PATCH = 2
"""Latent rows and columns of a token; a token has one latent frame."""
IMAGE_NORM_EPS = 1e-5
"""Epsilon of the image embedding's norms, which differ from all others in Wan 2.1."""

Activation = Callable[[jax.Array], jax.Array]
KeysValues = tuple[Float[Array, "*l b _ heads k"], Float[Array, "*l b _ heads k"]]
Attend = Callable[[jax.Array, jax.Array, jax.Array], tuple[Float[Array, "b n h k"], Any]]
"""Self-attention of queries, keys and values by head: the result, and what to keep of the layer."""

xavier = nnx.initializers.xavier_uniform()
normal = nnx.initializers.normal(0.02)


# Functions of this module, unlike `jax.nn.silu` or a partial function, are pickled by their names
# (`executables.cached_trace`), so that a network from the cache equals a traced one.
def silu(x: Array) -> Array:
    """Return x · sigmoid(x)."""
    return jax.nn.silu(x)


def gelu_tanh(x: Array) -> Array:
    """Return the approximation of GELU by tanh."""
    return jax.nn.gelu(x, approximate=True)


def gelu_erf(x: Array) -> Array:
    """Return the exact GELU."""
    return jax.nn.gelu(x, approximate=False)


@dataclass(frozen=True, kw_only=True)
class WanDiTSizes:
    """Sizes and numerics of the transformer; the defaults are EgoSim's 14B."""

    in_channels: int = 52
    """Channels of the noisy latents and the condition together."""
    out_channels: int = 16
    """Channels of the noisy latents and the velocity."""
    dim: int = 5120
    """Width of a token's embedding, in channels."""
    ffn_dim: int = 13824
    """Hidden width of the MLP."""
    heads: int = 40
    """Attention heads, each of dim / heads."""
    layers: int = 40
    """Number of transformer blocks."""
    text_dim: int = 4096
    """Width of the text encoder's tokens."""
    image_dim: int | None = 1280
    """Width of the image encoder's tokens; None for a model without the image branch."""
    freq_dim: int = 256
    """Width of the time sinusoid."""
    eps: float = 1e-6
    """Epsilon of the norms."""
    dtype: Literal["float32", "bfloat16"] = "float32"
    """Compute dtype of matrix products and the residual stream."""
    products: Products | None = None
    """Dtype of the factors of matrix products, attention's included; None: `dtype`.

    With bfloat16 sums and all else stay in `dtype`."""
    attention: Kernel = "auto"
    """Attention kernel of the transformer."""
    remat: Level = "none"
    """Activations that the backward pass recomputes."""

    def __post_init__(self) -> None:
        sizes = ("out_channels", "dim", "ffn_dim", "heads", "layers", "text_dim", "freq_dim")
        check_counts({name: getattr(self, name) for name in sizes})
        if self.in_channels < self.out_channels:
            raise InputError(
                f"in_channels {self.in_channels} must hold the {self.out_channels} noisy channels "
                "(out_channels) and the condition's channels."
            )
        if self.dim % self.heads or self.head_dim % 2 or self.head_dim < 6:
            raise InputError(
                f"dim {self.dim} does not split into {self.heads} heads: a head needs an even size "
                "of at least 6, so that frames, rows and columns each turn a pair. Change heads."
            )
        if self.freq_dim % 2:
            raise InputError(f"freq_dim must be even (cosines and sines), not {self.freq_dim}.")
        if self.attention in ("cudnn", "hopper") and self.dtype == "float32":
            raise InputError(
                f'The {self.attention} attention kernel needs dtype "bfloat16", not "float32".'
            )

    @property
    def head_dim(self) -> int:
        """Size of an attention head."""
        return self.dim // self.heads

    @property
    def attention_dtype(self) -> str:
        """Dtype of queries, keys and values."""
        return self.products or self.dtype


def linear(
    config: WanDiTSizes,
    sizes: tuple[int, int],
    axes: Axes,
    rngs: nnx.Rngs,
    init: Initializer = xavier,
) -> Linear:
    """Make a linear layer in the compute dtype."""
    return Linear(
        *sizes,
        axes=axes,
        dtype=config.dtype,
        products=config.products,
        kernel_init=init,
        rngs=rngs,
    )


def modulation_table(rows: int, dim: int, rngs: nnx.Rngs) -> nnx.Param:
    """Make learned shifts, scales and gates, which are added to the time embedding's."""
    table = jax.random.normal(rngs.params(), (rows, dim)) / dim**0.5
    return nnx.Param(table, axes=(None, "embed"))


class MLP(nnx.Module):
    """Multilayer perceptron of a linear layer, an activation and a linear layer."""

    def __init__(
        self,
        config: WanDiTSizes,
        sizes: tuple[int, int, int],
        activation: Activation,
        *,
        init: Initializer = xavier,
        rngs: nnx.Rngs,
    ):
        self.up = linear(config, sizes[:2], ("embed", "mlp"), rngs, init)
        self.down = linear(config, sizes[1:], ("mlp", "embed"), rngs, init)
        self.activation = activation

    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b o"]:
        """Map the last axis."""
        return self.down(self.activation(self.up(x)))


class TimeEmbedding(nnx.Module):
    """Embedding of timesteps: one vector for the head and six for the blocks, in float32."""

    def __init__(self, config: WanDiTSizes, *, rngs: nnx.Rngs):
        sizes = (config.freq_dim, config.dim, config.dim)
        self.freq_dim = config.freq_dim
        self.mlp = MLP(config, sizes, silu, init=normal, rngs=rngs)
        self.modulation = linear(config, (config.dim, 6 * config.dim), ("embed", None), rngs)

    def __call__(
        self, t: Float[Array, "b g"]
    ) -> tuple[Float[Array, "b g d"], Float[Array, "b g 6 d"]]:
        """Embed timesteps in [0, 1000]."""
        vector = self.mlp(time_sinusoid(t.reshape(-1), self.freq_dim))
        modulation = self.modulation(jax.nn.silu(vector)).astype(jnp.float32)
        return (
            rearrange(vector, "(b g) d -> b g d", b=len(t)).astype(jnp.float32),
            rearrange(modulation, "(b g) (k d) -> b g k d", b=len(t), k=6),
        )


class ImageEmbedding(nnx.Module):
    """Projection of the image encoder's tokens to the model's width."""

    def __init__(self, config: WanDiTSizes, width: int, *, rngs: nnx.Rngs):
        self.norm_in = LayerNorm(width, eps=IMAGE_NORM_EPS)
        self.mlp = MLP(config, (width, width, config.dim), gelu_erf, rngs=rngs)
        self.norm_out = LayerNorm(config.dim, eps=IMAGE_NORM_EPS)

    def __call__(self, image: Float[Array, "b m e"]) -> Float[Array, "b m d"]:
        """Embed; the result is float32."""
        return self.norm_out(self.mlp(self.norm_in(image)))


class KeyValue(nnx.Module):
    """Projections to keys, normalized over the full width, and to values, by head."""

    def __init__(self, config: WanDiTSizes, *, rngs: nnx.Rngs):
        sizes, axes = (config.dim, config.dim), ("embed", "heads")
        self.heads, self.dtype = config.heads, jnp.dtype(config.attention_dtype)
        self.k = linear(config, sizes, axes, rngs)
        self.v = linear(config, sizes, axes, rngs)
        self.norm_k = RMSNorm(config.dim, eps=config.eps, axes=("heads",))

    def keys(self, tokens: Float[Array, "b m d"]) -> Float[Array, "b m h k"]:
        """Return the keys, in float32."""
        return self._by_head(self.norm_k(name_projection(self.k(tokens))))

    def values(self, tokens: Float[Array, "b m d"]) -> Float[Array, "b m h k"]:
        """Return the values, in the dtype of the attention's products."""
        return self._by_head(name_projection(self.v(tokens))).astype(self.dtype)

    def keys_values(self, tokens: Float[Array, "b m d"]) -> KeysValues:
        """Return keys and values, both in the dtype of the attention's products."""
        return self.keys(tokens).astype(self.dtype), self.values(tokens)

    def _by_head(self, x: Float[Array, "b m d"]) -> Float[Array, "b m h k"]:
        return rearrange(x, "b m (h k) -> b m h k", h=self.heads)


class Attention(KeyValue):
    """Base of self- and cross-attention."""

    def __init__(self, config: WanDiTSizes, *, rngs: nnx.Rngs):
        super().__init__(config, rngs=rngs)
        sizes = (config.dim, config.dim)
        self.kernel: Kernel = config.attention
        self.q = linear(config, sizes, ("embed", "heads"), rngs)
        self.norm_q = RMSNorm(config.dim, eps=config.eps, axes=("heads",))
        self.o = linear(config, sizes, ("heads", "embed"), rngs)

    def queries(self, x: Float[Array, "b n d"]) -> Float[Array, "b n h k"]:
        """Return the normalized queries, in float32."""
        return self._by_head(self.norm_q(name_projection(self.q(x))))

    def output(self, heads: Float[Array, "b n h k"]) -> Float[Array, "b n d"]:
        """Join the heads and project them."""
        return name_projection(self.o(rearrange(heads, "b n h k -> b n (h k)")))


class SelfAttention(Attention):
    """Self-attention of the video's tokens, with rotary positions."""

    def __call__(
        self, x: Float[Array, "b n d"], rotation: Float[Array, "n k 2"], attend: Attend
    ) -> tuple[Float[Array, "b n d"], Any]:
        """Attend by `attend`, with rotated queries and keys."""
        q, k = (rope.rotate(heads, rotation) for heads in (self.queries(x), self.keys(x)))
        out, kept = attend(q.astype(self.dtype), k.astype(self.dtype), self.values(x))
        return self.output(out), kept


class CrossAttention(Attention):
    """Cross-attention to the text and, in models that have the branch, to the image."""

    def __init__(self, config: WanDiTSizes, *, rngs: nnx.Rngs):
        super().__init__(config, rngs=rngs)
        self.image = None if config.image_dim is None else KeyValue(config, rngs=rngs)

    @property
    def branches(self) -> tuple[KeyValue, ...]:
        """Key-value projections of the text and, if any, of the image."""
        return (self,) if self.image is None else (self, self.image)

    def __call__(
        self, x: Float[Array, "b n d"], sources: tuple[KeysValues, ...]
    ) -> Float[Array, "b n d"]:
        """Attend to each source separately and add the results."""
        q = self.queries(x).astype(self.dtype)
        attend = partial(attention, q, kernel=self.kernel, over="queries")
        return self.output(reduce(jnp.add, (attend(k, v) for k, v in sources)))


class Block(nnx.Module):
    """Transformer block: self-attention, cross-attention and MLP on the residual stream.

    The tokens are g equal runs. All tokens of a run have the same timestep.
    """

    def __init__(self, config: WanDiTSizes, *, rngs: nnx.Rngs):
        sizes = (config.dim, config.ffn_dim, config.dim)
        self.norm = LayerNorm(config.dim, eps=config.eps, affine=False)
        self.self_attn = SelfAttention(config, rngs=rngs)
        self.cross_norm = LayerNorm(config.dim, eps=config.eps)
        self.cross_attn = CrossAttention(config, rngs=rngs)
        self.mlp = MLP(config, sizes, gelu_tanh, rngs=rngs)
        self.modulation = modulation_table(6, config.dim, rngs)

    def __call__(
        self,
        x: Float[Array, "b n d"],
        modulation: Float[Array, "b g 6 d"],
        rotation: Float[Array, "n k 2"],
        sources: tuple[KeysValues, ...],
        attend: Attend,
    ) -> tuple[Float[Array, "b n d"], Any]:
        """Update the residual stream; sums are taken in float32 and kept in x's dtype.

        Also returns the second result of `attend`.
        """
        shifts = self.modulation[...].astype(jnp.float32) + modulation
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = by_token(shifts, x.shape[1])
        attended, kept = self.self_attn(modulate(self.norm(x), shift_a, scale_a), rotation, attend)
        x = (x + gate_a * attended).astype(x.dtype)
        x = x + self.cross_attn(self.cross_norm(x), sources)
        mapped = self.mlp(modulate(self.norm(x), shift_m, scale_m))
        return (x + gate_m * mapped).astype(x.dtype), kept


def by_token(
    vectors: Float[Array, "b g k d"], tokens: int
) -> Float[Array, "k b 1 d"] | list[Float[Array, "b n d"]]:
    """Return k vectors of each token, by g equal runs of tokens; one run has them once."""
    groups = vectors.shape[1]
    if groups == 1:
        return rearrange(vectors, "b 1 k d -> k b 1 d")
    each = rearrange(vectors, "b g k d -> k b g d")
    return [repeat(vector, "b g d -> b (g n) d", n=tokens // groups) for vector in each]


class Head(nnx.Module):
    """Projection of tokens to velocity patches, in the order (row, column, channel)."""

    def __init__(self, config: WanDiTSizes, *, rngs: nnx.Rngs):
        sizes = (config.dim, config.out_channels * PATCH**2)
        self.norm = LayerNorm(config.dim, eps=config.eps, affine=False)
        self.modulation = modulation_table(2, config.dim, rngs)
        self.linear = linear(config, sizes, ("embed", None), rngs, zeros)

    def __call__(
        self, x: Float[Array, "b n d"], time: Float[Array, "b g d"]
    ) -> Float[Array, "b n o"]:
        """Project; zero at initialization."""
        shifts = self.modulation[...].astype(jnp.float32) + time[:, :, None]
        shift, scale = by_token(shifts, x.shape[1])
        return self.linear(modulate(self.norm(x), shift, scale)).astype(jnp.float32)
