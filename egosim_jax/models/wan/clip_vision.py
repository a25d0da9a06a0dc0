"""CLIP image encoder: an image to a grid of tokens, as Wan 2.1's image-to-video models use it.

The vision transformer of open-clip's XLM-RoBERTa-Large ViT-H/14 (Dosovitskiy et al. 2021; Radford
et al. 2021). The image is cut into patches, a class token is put before them, positions are
added and normalized, and each block adds

    x += attention(LayerNorm(x))      x += D gelu(U LayerNorm(x)), gelu with the exact erf

The video models condition on all tokens *before* the last block. So the last `skip_last` blocks
and what follows them (the final norm and the projection into the space shared with text) are
never computed; they do not exist here, and the name table ignores them in the official file.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import jax
import jax.numpy as jnp
from einops import rearrange, repeat
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models.attention import attention
from egosim_jax.models.layers import LayerNorm, Linear, lecun_normal, scan_blocks, stack
from egosim_jax.types import InputError


@dataclass(frozen=True, kw_only=True)
class CLIPVisionConfig:
    """Sizes of the image encoder; the defaults are ViT-H/14's."""

    table: ClassVar[str] = "egosim_jax.convert.tables.clip_vision"
    """Module of the conversion table."""

    image_size: int = 224
    """Rows and columns of the image in pixels, a multiple of `patch`."""
    patch: int = 14
    """Rows and columns of a patch in pixels."""
    dim: int = 1280
    """Width of the tokens."""
    layers: int = 32
    """Blocks of the original network."""
    heads: int = 16
    """Attention heads, which divide `dim`."""
    ffn_dim: int = 5120
    """Hidden width of the feed-forward layer."""
    eps: float = 1e-5
    """Added to the variance in LayerNorm."""
    skip_last: int = 1
    """Number of blocks at the end that are skipped."""
    dtype: str = "float32"
    """Dtype of the linears and of the residual stream; norms and softmax are float32."""

    def __post_init__(self) -> None:
        if self.image_size < self.patch or self.image_size % self.patch:
            raise InputError(
                f"Patches of {self.patch} pixels do not tile an image of {self.image_size}: "
                "image_size must be a multiple of patch. Nearest: "
                f"{max(1, round(self.image_size / self.patch)) * self.patch}."
            )
        if self.dim % self.heads:
            raise InputError(
                f"{self.heads} heads do not divide the width {self.dim}: dim must be a multiple "
                "of heads."
            )
        if not 0 <= self.skip_last < self.layers:
            raise InputError(
                f"skip_last {self.skip_last} does not fit {self.layers} layers: it must be at "
                "least 0 and leave a block."
            )

    def build(self, *, rngs: nnx.Rngs) -> CLIPVision:
        """Build the network with random weights."""
        return CLIPVision(self, rngs=rngs)

    @property
    def tokens(self) -> int:
        """Tokens of an image: its patches and the class token."""
        return (self.image_size // self.patch) ** 2 + 1

    @property
    def blocks(self) -> int:
        """Blocks that are computed."""
        return self.layers - self.skip_last


class PatchEmbed(nnx.Module):
    """Linear patch embedding without bias; kernel `[rows, columns, 3, d]`."""

    def __init__(self, config: CLIPVisionConfig, *, rngs: nnx.Rngs):
        self.dtype = jnp.dtype(config.dtype)
        shape = (config.patch, config.patch, 3, config.dim)
        self.kernel = nnx.Param(
            lecun_normal(rngs.params(), shape), axes=(None, None, None, "embed")
        )

    def __call__(self, pixels: Float[Array, "b h w 3"]) -> Float[Array, "b n d"]:
        """Embed the patches, row by row."""
        patch = self.kernel.shape[0]
        x = rearrange(pixels, "b (i p) (j q) c -> b (i j) (p q c)", p=patch, q=patch)
        kernel = rearrange(self.kernel[...], "p q c d -> (p q c) d")
        return x.astype(self.dtype) @ kernel.astype(self.dtype)


class SelfAttention(nnx.Module):
    """Multi-head attention among all tokens."""

    def __init__(self, config: CLIPVisionConfig, *, rngs: nnx.Rngs):
        self.heads = config.heads
        linear = partial(Linear, config.dim, config.dim, dtype=config.dtype, rngs=rngs)
        self.q = linear(axes=("embed", "heads"))
        self.k = linear(axes=("embed", "heads"))
        self.v = linear(axes=("embed", "heads"))
        self.o = linear(axes=("heads", "embed"))

    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b n d"]:
        """Attend from all tokens to all tokens."""
        split = partial(rearrange, pattern="b n (h k) -> b n h k", h=self.heads)
        y = attention(split(self.q(x)), split(self.k(x)), split(self.v(x)))
        return self.o(rearrange(y, "b n h k -> b n (h k)"))


class Block(nnx.Module):
    """Attention, then feed-forward, each added to its input."""

    def __init__(self, config: CLIPVisionConfig, *, rngs: nnx.Rngs):
        dim, ffn_dim, dtype = config.dim, config.ffn_dim, config.dtype
        self.norm1 = LayerNorm(dim, eps=config.eps)
        self.attn = SelfAttention(config, rngs=rngs)
        self.norm2 = LayerNorm(dim, eps=config.eps)
        self.up = Linear(dim, ffn_dim, axes=("embed", "mlp"), dtype=dtype, rngs=rngs)
        self.down = Linear(ffn_dim, dim, axes=("mlp", "embed"), dtype=dtype, rngs=rngs)

    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b n d"]:
        """Advance the residual stream by one block."""
        x = x + self.attn(self.norm1(x))
        return x + self.down(jax.nn.gelu(self.up(self.norm2(x)), approximate=False))


class CLIPVision(nnx.Module):
    """CLIP image encoder; the class token comes first, then the patches row by row."""

    def __init__(self, config: CLIPVisionConfig, *, rngs: nnx.Rngs):
        self.config = config
        normal = nnx.initializers.normal(config.dim**-0.5)
        self.patch_embed = PatchEmbed(config, rngs=rngs)
        self.class_token = nnx.Param(normal(rngs.params(), (config.dim,)), axes=("embed",))
        self.positions = nnx.Param(
            normal(rngs.params(), (config.tokens, config.dim)), axes=(None, "embed")
        )
        self.norm = LayerNorm(config.dim, eps=config.eps)
        self.blocks = stack(lambda rngs: Block(config, rngs=rngs), config.blocks, rngs=rngs)

    def __call__(
        self, pixels: Float[Array, "b {self.config.image_size} {self.config.image_size} 3"]
    ) -> Float[Array, "b {self.config.tokens} {self.config.dim}"]:
        """Encode images whose channels have been normalized with CLIP's mean and deviation."""
        dtype = jnp.dtype(self.config.dtype)
        patches = self.patch_embed(pixels)
        first = repeat(self.class_token[...].astype(dtype), "d -> b 1 d", b=len(pixels))
        x = jnp.concatenate([first, patches], axis=1) + self.positions[...].astype(dtype)
        x = self.norm(x).astype(dtype)
        x, _ = scan_blocks(lambda block, x, _: (block(x), None), self.blocks, x)
        return x
