"""Video diffusion transformer of CogVideoX, with the inputs of CogVideoX-Fun's InP and of DWM.

Noisy latents of 16 channels and a condition of 17 (mask and masked video) or 33 channels (DWM:
mask, static scene, hands) are split into patches of 1 x 2 x 2 cells. Text and video are one stream
of tokens, text first. All tokens attend to all, padding included. The blocks are in `layers`. (Yang
et al. 2024, CogVideoX; section 4.1 of DWM for the input channels.)
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Any, ClassVar, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models import Flops, remat, rope
from egosim_jax.models.cogvideox.layers import (
    PATCH,
    Block,
    CogVideoXDiTSizes,
    Modulation,
    TimeEmbedding,
)
from egosim_jax.models.layers import LayerNorm, Linear, modulate, scan_blocks, stack, zeros
from egosim_jax.models.patch import PatchEmbedding
from egosim_jax.sharding import constrain
from egosim_jax.types import InputError

TOKENS = ("batch", "tokens", None)
"""Logical axes of the residual stream."""


@dataclass(frozen=True, kw_only=True)
class CogVideoXDiTConfig(CogVideoXDiTSizes):
    """Config of the transformer; the defaults are CogVideoX-Fun V1.1 5B InP's."""

    table: ClassVar[str] = "egosim_jax.convert.tables.cogvideox_dit"
    """Module of the conversion table."""
    numerics_only: ClassVar[tuple[str, ...]] = (
        "dtype",
        "products",
        "attention",
        "remat",
        "time_angles",
    )
    """Fields that change only how values are computed, which a resumed training may change."""
    remat_levels: ClassVar[tuple[str, ...]] = remat.LEVELS
    """Values of `remat`, by the memory that they take, ascending."""
    lora_targets: ClassVar[tuple[str, ...]] = tuple(f"blocks.attn.{name}" for name in "qkvo")
    """Patterns of the linear layers that a LoRA adapts."""
    also_train: ClassVar[tuple[str, ...]] = ("patch.*",)
    """Patterns of the weights that are trained in full along with a LoRA."""

    def build(self, *, rngs: nnx.Rngs) -> CogVideoXDiT:
        """Build the network with random weights."""
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
    def image_dim(self) -> int | None:
        """Width of the image encoder's tokens; None: the model has no image branch."""
        return None


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class CogVideoXContext:
    """Context that all denoising steps share."""

    patches: Float[Array, "b v d"]
    """Contribution of the condition to the patch embedding, with the bias."""
    text: Float[Array, "b m d"]
    """Tokens of the text in the denoiser's width."""
    rotation: Float[Array, "n k 2"]
    """Rotary embedding table of all tokens; text tokens are not rotated."""


def grid_positions(
    frames: int, rows: int, columns: int, config: CogVideoXDiTConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions of frames, rows and columns.

    The image is fitted into the base grid, keeping its aspect ratio, and centered there; its
    tokens are spread over that region.
    """
    if rows * config.base_columns > columns * config.base_rows:
        height, width = config.base_rows, round(config.base_rows / rows * columns)
    else:
        height, width = round(config.base_columns / columns * rows), config.base_columns
    top, left = round((config.base_rows - height) / 2), round((config.base_columns - width) / 2)
    return (
        np.arange(frames, dtype=float),
        np.linspace(top, (top + height) * (rows - 1) / rows, rows),
        np.linspace(left, (left + width) * (columns - 1) / columns, columns),
    )


class CogVideoXDiT(nnx.Module):
    """Video diffusion transformer: prediction for noisy latents, given condition and text."""

    block: ClassVar[type[Block]] = Block
    """Class of the transformer blocks."""

    def __init__(self, config: CogVideoXDiTConfig, *, rngs: nnx.Rngs):
        self.config = config
        dtype = config.dtype
        self.patch = PatchEmbedding(config, patch=PATCH, rngs=rngs)
        axes = (None, "embed")
        self.text = Linear(config.text_dim, config.dim, axes=axes, dtype=dtype, rngs=rngs)
        self.time = TimeEmbedding(config, rngs=rngs)
        self.blocks = stack(lambda rngs: self.block(config, rngs=rngs), config.layers, rngs=rngs)
        self.norm = LayerNorm(config.dim, eps=config.eps)
        self.modulation = Modulation(config, 2, rngs=rngs)
        out = config.out_channels * PATCH**2
        self.out = Linear(
            config.dim, out, axes=("embed", None), dtype=dtype, kernel_init=zeros, rngs=rngs
        )

    def prepare(
        self,
        condition: Float[Array, "b f h w c"],
        text: Float[Array, "b m e"],
        image: Float[Array, "b k i"] | None = None,
    ) -> CogVideoXContext:
        """Compute the context that all denoising steps share.

        `condition` holds the channels after the noisy ones, `text` the text encoder's tokens;
        there is no image branch. Raises `InputError` for other channels, sizes or an image.
        """
        self.patch.check(condition.shape)
        if image is not None:
            raise InputError("Image tokens were given to CogVideoX, which has no image branch.")
        _, f, h, w, _ = condition.shape
        rows, columns, eighth = h // PATCH, w // PATCH, self.config.head_dim // 16
        positions = grid_positions(f, rows, columns, self.config)
        rotation = rope.rotations_at(positions, (2 * eighth, 3 * eighth, 3 * eighth))
        still = jnp.broadcast_to(jnp.array([1.0, 0.0]), (text.shape[1], *rotation.shape[1:]))
        return CogVideoXContext(
            patches=self.patch.condition(condition),
            text=self.text(text),
            rotation=jnp.concatenate([still, rotation]),
        )

    def denoise(
        self, noisy: Float[Array, "b f h w c"], t: Float[Array, " b"], context: CogVideoXContext
    ) -> Float[Array, "b f h w c"]:
        """Return the prediction, in float32, for noisy latents at timesteps in [0, 1000]."""
        _, _, h, w, _ = noisy.shape
        time, texts = self.time(t), context.text.shape[1]
        modulators = self.modulators(time, context)
        is_text = (jnp.arange(len(context.rotation)) < texts).astype(jnp.float32)[None, :, None]

        def step(block: Block, x: jax.Array, _: None) -> tuple[jax.Array, None]:
            x = block(remat.name_input(x), modulators, context.rotation, is_text)
            return constrain(x, TOKENS), None

        video = self.patch.noisy(noisy) + context.patches
        x = constrain(jnp.concatenate([context.text, video], axis=1), TOKENS)
        x, _ = scan_blocks(step, self.blocks, x, remat=remat.wrapper(self.config.remat))
        x = self.norm(x[:, texts:])
        shift, scale = self.modulation.vectors(time)
        x = self.out(modulate(self.modulation.norm(x), shift, scale)).astype(jnp.float32)
        return rearrange(
            x,
            "b (f h w) (c i j) -> b f (h i) (w j) c",
            h=h // PATCH,
            w=w // PATCH,
            i=PATCH,
            j=PATCH,
        )

    def modulators(self, time: Float[Array, "b e"], context: CogVideoXContext) -> Any:
        """Return the input of the blocks' modulations."""
        return time

    def __call__(
        self,
        latents: Float[Array, "b f h w c"],
        t: Float[Array, " b"],
        text: Float[Array, "b m e"],
    ) -> Float[Array, "b f h w v"]:
        """Return the prediction for noisy latents and condition in one array."""
        noisy, condition = jnp.split(latents, [self.config.out_channels], axis=-1)
        return self.denoise(noisy, t, self.prepare(condition, text))
