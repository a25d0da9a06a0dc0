"""Config of Wan 2.1's video transformer."""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import TYPE_CHECKING, ClassVar, Literal

from flax import nnx

from egosim_jax.models import Flops
from egosim_jax.models.attention import Kernel
from egosim_jax.models.layers import Products
from egosim_jax.models.remat import LEVELS, Level
from egosim_jax.types import InputError, check_counts

if TYPE_CHECKING:
    from egosim_jax.models.wan.dit import WanDiT

PATCH = 2
"""Latent rows and columns of a token; a token has one latent frame."""


@dataclass(frozen=True, kw_only=True)
class WanDiTConfig:
    """Shape and numerics of the transformer; the defaults are EgoSim's 14B."""

    table: ClassVar[str] = "egosim_jax.convert.tables.wan_dit"
    """Module of the conversion table."""
    numerics_only: ClassVar[tuple[str, ...]] = ("dtype", "products", "attention", "remat")
    """Fields that change only how values are computed, which a resumed training may change."""
    remat_levels: ClassVar[tuple[str, ...]] = LEVELS
    """Values of `remat`, by the memory that they take, ascending."""
    lora_targets: ClassVar[tuple[str, ...]] = ("blocks.*",)
    """Patterns of the linear layers that a LoRA adapts."""
    also_train: ClassVar[tuple[str, ...]] = ()
    """Patterns of the weights that are trained in full along with a LoRA."""

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
    """Dtype of the factors of matrix products, attention's included; None: that of the others.

    With bfloat16 sums and all else stay in `dtype`."""
    attention: Kernel = "auto"
    """Attention kernel of the transformer."""
    remat: Level = "none"
    """Activations that the backward pass recomputes."""

    def __post_init__(self) -> None:
        """Check that the sizes fit each other and the kernel fits the dtype."""
        sizes = ("out_channels", "dim", "ffn_dim", "heads", "layers", "text_dim", "freq_dim")
        check_counts({name: getattr(self, name) for name in sizes})
        if self.in_channels < self.out_channels:
            raise InputError(
                f"in_channels {self.in_channels} must hold the {self.out_channels} noisy channels "
                "(out_channels) and those of the condition."
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

    def build(self, *, rngs: nnx.Rngs) -> WanDiT:
        """Build the network with random weights."""
        from egosim_jax.models.wan.dit import WanDiT

        return WanDiT(self, rngs=rngs)

    def forward_flops(self, *, latents: tuple[int, int, int], text: int, image: int) -> Flops:
        """Count a forward pass of one sample, of so many latent cells, text and image tokens.

        With N tokens of width d, an MLP of width f, T text and I image tokens and L blocks, it has

            self-attention    L (8 N d^2 + 4 N^2 d)
            cross-attention   L (4 N d^2 + 4 (T + I) d^2 + 4 N (T + I) d)
            MLP               L 4 N d f

        and the embeddings and the head. Norms and activations do not count.
        """
        d, f, depth = self.dim, self.ffn_dim, self.layers
        n = prod(latents) // PATCH**2
        image = image if self.image_dim is not None else 0
        block = 12 * n * d**2 + 4 * (text + image) * d**2 + 4 * n * d * f
        embeddings = 2 * n * PATCH**2 * (self.in_channels + self.out_channels) * d
        embeddings += 2 * text * (self.text_dim * d + d**2)
        embeddings += 2 * (self.freq_dim * d + 7 * d**2)
        if self.image_dim is not None:
            embeddings += 2 * image * (self.image_dim**2 + self.image_dim * d)
        return Flops(
            weights=float(depth * block + embeddings),
            attention=float(depth * 4 * n * (n + text + image) * d),
        )

    @property
    def patch(self) -> tuple[int, int, int]:
        """Latent frames, rows and columns of a token."""
        return 1, PATCH, PATCH

    @property
    def head_dim(self) -> int:
        """Size of an attention head."""
        return self.dim // self.heads

    @property
    def attention_dtype(self) -> str:
        """Dtype of queries, keys and values."""
        return self.products or self.dtype

    @property
    def condition_channels(self) -> int:
        """Channels of the condition that is concatenated to the noisy latents."""
        return self.in_channels - self.out_channels
