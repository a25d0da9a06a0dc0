"""Video diffusion transformer of Wan 2.1, in all its published shapes, and EgoSim's.

Noisy latents of 16 channels and a condition of 0 (text to video), 20 (image to video) or 36
channels (EgoSim) are split into patches of 1 x 2 x 2 cells, one token each, which pass through the
blocks of `layers` and become the velocity of the noisy latents.

Everything that does not depend on the step is computed once by `prepare`: the patch embedding is
linear, so the condition's contribution is separate; keys and values of the cross-attentions depend
on text and image only. A solver calls `denoise` at each step.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import ClassVar, no_type_check

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models import Flops, remat, rope
from egosim_jax.models.layers import scan_blocks, stack
from egosim_jax.models.patch import PatchEmbedding, check_condition
from egosim_jax.models.wan.layers import (
    MLP,
    PATCH,
    Block,
    CrossAttention,
    Head,
    ImageEmbedding,
    KeysValues,
    TimeEmbedding,
    WanDiTSizes,
    gelu_tanh,
    normal,
)
from egosim_jax.sharding import constrain
from egosim_jax.types import InputError

TOKENS, VECTORS = ("batch", "tokens", None), ("batch", None, None)
"""Logical axes of the residual stream, and of arrays that all tokens share."""


@dataclass(frozen=True, kw_only=True)
class WanDiTConfig(WanDiTSizes):
    """Config of the transformer; the defaults are EgoSim's 14B."""

    table: ClassVar[str] = "egosim_jax.convert.tables.wan_dit"
    """Module of the conversion table."""
    numerics_only: ClassVar[tuple[str, ...]] = ("dtype", "products", "attention", "remat")
    """Fields that change only how values are computed, which a resumed training may change."""
    remat_levels: ClassVar[tuple[str, ...]] = remat.LEVELS
    """Values of `remat`, by the memory that they take, ascending."""
    lora_targets: ClassVar[tuple[str, ...]] = ("blocks.*",)
    """Patterns of the linear layers that a LoRA adapts."""
    also_train: ClassVar[tuple[str, ...]] = ()
    """Patterns of the weights that are trained in full along with a LoRA."""

    def build(self, *, rngs: nnx.Rngs) -> WanDiT:
        """Build the network with random weights."""
        return WanDiT(self, rngs=rngs)

    def forward_flops(self, *, latents: tuple[int, int, int], text: int, image: int) -> Flops:
        """Return the FLOPs of a forward pass of one sample, by its latent cells and tokens.

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


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class DiTContext:
    """Context that all denoising steps share."""

    patches: Float[Array, "b n d"]
    """Contribution of the condition to the patch embedding, with the bias."""
    sources: tuple[KeysValues, ...]
    """Cross-attention keys and values of all layers: of the text, then of the image if any."""
    rotation: Float[Array, "n k 2"]
    """Rotary embedding table of the tokens."""


class WanDiT(nnx.Module):
    """Video diffusion transformer: velocity of noisy latents, given condition, text and image."""

    def __init__(self, config: WanDiTConfig, *, rngs: nnx.Rngs):
        self.config = config
        self.patch = PatchEmbedding(
            config.in_channels,
            config.dim,
            noisy_channels=config.out_channels,
            patch=PATCH,
            dtype=config.dtype,
            rngs=rngs,
        )
        self.time = TimeEmbedding(config, rngs=rngs)
        sizes = (config.text_dim, config.dim, config.dim)
        self.text = MLP(config, sizes, gelu_tanh, init=normal, rngs=rngs)
        width = config.image_dim
        self.image = None if width is None else ImageEmbedding(config, width, rngs=rngs)
        self.blocks = stack(lambda rngs: Block(config, rngs=rngs), config.layers, rngs=rngs)
        self.head = Head(config, rngs=rngs)

    def prepare(
        self,
        condition: Float[Array, "b f h w c"],
        text: Float[Array, "b n e"],
        image: Float[Array, "b m i"] | None = None,
    ) -> DiTContext:
        """Compute the context that all denoising steps share.

        `condition` holds the channels after the noisy ones (none for text to video), `text` the
        text encoder's tokens, `image` the image encoder's, for models with the image branch.
        """
        self._check(condition.shape, has_image=image is not None)
        _, f, h, w, _ = condition.shape
        tokens = [self.text(text)]
        if self.image is not None and image is not None:
            tokens.append(self.image(image))

        def step(layer: CrossAttention, x: None, _: None) -> tuple:
            branches = zip(layer.branches, tokens, strict=True)
            return x, tuple(branch.keys_values(y) for branch, y in branches)

        _, sources = scan_blocks(
            step, self.blocks.cross_attn, None, remat=remat.wrapper(self.config.remat)
        )
        return DiTContext(
            patches=self.patch.condition(condition),
            sources=sources,
            rotation=rope.rotations(f, h // PATCH, w // PATCH, self.config.head_dim),
        )

    def denoise(
        self, noisy: Float[Array, "b f h w c"], t: Float[Array, " b"], context: DiTContext
    ) -> Float[Array, "b f h w c"]:
        """Return the velocity, in float32, of noisy latents at timesteps in [0, 1000]."""
        _, _, h, w, _ = noisy.shape
        time, modulation = (constrain(x, VECTORS) for x in self.time(t))

        def step(block: Block, x: jax.Array, sources: tuple[KeysValues, ...]) -> tuple:
            x = remat.name_input(x)
            x = block(x, modulation, context.rotation, sources)
            return constrain(x, TOKENS), None

        x = constrain(self.patch.noisy(noisy) + context.patches, TOKENS)
        x, _ = scan_blocks(
            step, self.blocks, x, context.sources, remat=remat.wrapper(self.config.remat)
        )
        return rearrange(
            self.head(x, time),
            "b (f h w) (i j c) -> b f (h i) (w j) c",
            h=h // PATCH,
            w=w // PATCH,
            i=PATCH,
            j=PATCH,
        )

    def __call__(
        self,
        latents: Float[Array, "b f h w c"],
        t: Float[Array, " b"],
        text: Float[Array, "b n e"],
        image: Float[Array, "b m i"] | None = None,
    ) -> Float[Array, "b f h w v"]:
        """Return the velocity for noisy latents and condition in one array."""
        noisy, condition = jnp.split(latents, [self.config.out_channels], axis=-1)
        return self.denoise(noisy, t, self.prepare(condition, text, image))

    def _check(self, condition: tuple[int, ...], *, has_image: bool) -> None:
        config = self.config
        check_condition(
            condition,
            in_channels=config.in_channels,
            noisy_channels=config.out_channels,
            patch=PATCH,
        )
        if has_image != (config.image_dim is not None):
            given, fix = ("were", "Omit them") if has_image else ("were not", "Pass them")
            raise InputError(
                f"Image tokens {given} given to a model with image_dim {config.image_dim}. {fix}."
            )
