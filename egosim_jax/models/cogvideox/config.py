"""Config of CogVideoX's video transformer."""

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
    from egosim_jax.models.cogvideox.dit import CogVideoXDiT

PATCH = 2
"""Latent rows and columns of a token; a token has one latent frame."""


@dataclass(frozen=True, kw_only=True)
class CogVideoXDiTConfig:
    """Shape and numerics of the transformer; the defaults are CogVideoX-Fun V1.1 5B InP's."""

    table: ClassVar[str] = "egosim_jax.convert.tables.cogvideox_dit"
    """Module of the conversion table."""
    numerics_only: ClassVar[tuple[str, ...]] = ("dtype", "products", "attention", "remat")
    """Fields that change only how values are computed, which a resumed training may change."""
    remat_levels: ClassVar[tuple[str, ...]] = LEVELS
    """Values of `remat`, by the memory that they take, ascending."""
    lora_targets: ClassVar[tuple[str, ...]] = tuple(f"blocks.attn.{name}" for name in "qkvo")
    """Patterns of the linear layers that a LoRA adapts."""
    also_train: ClassVar[tuple[str, ...]] = ("patch.*",)
    """Patterns of the weights that are trained in full along with a LoRA."""

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
    """Rows of tokens of the pictures that the base model was trained with."""
    base_columns: int = 45
    """Columns of tokens of those pictures."""
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
    remat: Level = "none"
    """Activations that the backward pass recomputes."""

    def __post_init__(self) -> None:
        """Check that the sizes fit each other and the kernel fits the dtype."""
        sizes = (
            "out_channels", "dim", "heads", "layers", "text_dim", "time_dim",
            "base_rows", "base_columns",
        )  # fmt: skip
        check_counts({name: getattr(self, name) for name in sizes})
        if self.in_channels < self.out_channels:
            raise InputError(
                f"in_channels {self.in_channels} must hold the {self.out_channels} noisy channels "
                "(out_channels) and those of the condition."
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

    def build(self, *, rngs: nnx.Rngs) -> CogVideoXDiT:
        """Build the network with random weights."""
        from egosim_jax.models.cogvideox.dit import CogVideoXDiT

        return CogVideoXDiT(self, rngs=rngs)

    def forward_flops(self, *, latents: tuple[int, int, int], text: int, image: int) -> Flops:
        """Count a forward pass of one sample, of so many latent cells and text tokens.

        With N tokens of width d, text's included, an MLP of width f, a time embedding of width e
        and L blocks, it has

            attention    L (8 N d^2 + 4 N^2 d)
            MLP          L 4 N d f
            modulation   L 24 e d

        and the embeddings and the head. Norms and activations do not count; `image` is ignored.
        """
        d, e, depth = self.dim, self.time_dim, self.layers
        video = prod(latents) // PATCH**2
        n = video + text
        block = 8 * n * d**2 + 4 * n * d * self.ffn_dim + 24 * e * d
        embeddings = 2 * video * PATCH**2 * (self.in_channels + self.out_channels) * d
        embeddings += 2 * text * self.text_dim * d + 2 * (d * e + e**2) + 4 * e * d
        return Flops(
            weights=float(depth * block + embeddings), attention=float(depth * 4 * n * n * d)
        )

    @property
    def patch(self) -> tuple[int, int, int]:
        """Latent frames, rows and columns of a token."""
        return 1, PATCH, PATCH

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

    @property
    def image_dim(self) -> int | None:
        """Width of the image encoder's tokens; None: the model has no image branch."""
        return None

    @property
    def condition_channels(self) -> int:
        """Channels of the condition that is concatenated to the noisy latents."""
        return self.in_channels - self.out_channels
