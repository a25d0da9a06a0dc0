"""Video diffusion transformer of CogVideoX, with the inputs of CogVideoX-Fun's InP and of DWM.

Noisy latents of 16 channels and a condition of 17 (mask and masked video) or 33 channels (DWM:
mask, static scene, hands) are split into patches of 1 x 2 x 2 cells. Text and video are one stream
of tokens, text first, all of which attend to all, padding included. With shift, scale and gate from
the time embedding, one triple for the tokens of the text and one for those of the video, a block is

    x <- x + gate_a · Attention((1 + scale_a) · LN(x) + shift_a)
    x <- x + gate_m · MLP((1 + scale_m) · LN(x) + shift_m)

with a layer norm of the queries and keys of each head, and rotary positions of the video's tokens.

Norms, modulation, gates and rotations are float32; matrix products and the residual stream are in
the config's `dtype`, or the factors of the blocks' products alone in bfloat16 (`products`). (Yang
et al. 2024, CogVideoX; section 4.1 of DWM for the input channels.)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models import remat, rope
from egosim_jax.models.attention import attention
from egosim_jax.models.cogvideox.config import PATCH, CogVideoXDiTConfig
from egosim_jax.models.layers import LayerNorm, Linear, scan_blocks, stack, zeros
from egosim_jax.models.patch import PatchEmbedding, check_condition
from egosim_jax.models.remat import name_projection
from egosim_jax.models.sinusoid import time_sinusoid
from egosim_jax.sharding import constrain
from egosim_jax.types import InputError

TOKENS = ("batch", "tokens", None)
"""Logical axes of the residual stream."""


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
    """Rotary embedding table of all tokens; those of the text do not turn."""


def grid_positions(
    frames: int, rows: int, columns: int, config: CogVideoXDiTConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the positions of frames, rows and columns.

    The picture is fitted into the base grid, keeping its aspect ratio, and centered there; its
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


class Modulation(nnx.Module):
    """Layer norm with `n` vectors from the time embedding."""

    def __init__(self, config: CogVideoXDiTConfig, n: int, *, rngs: nnx.Rngs):
        self.norm = LayerNorm(config.dim, eps=config.eps)
        self.linear = Linear(
            config.time_dim, n * config.dim, axes=(None, "embed"), dtype=config.dtype, rngs=rngs
        )
        self.n = n

    def vectors(self, time: Any) -> Float[Array, "n b m d"]:
        """Return the vectors from the time embedding `b e`, one for all tokens, in float32."""
        y = self.linear(jax.nn.silu(time)).astype(jnp.float32)
        return rearrange(y, "b (n d) -> n b 1 d", n=self.n)


def modulate(
    x: Float[Array, "b n d"], shift: Float[Array, "b _ d"], scale: Float[Array, "b _ d"]
) -> Float[Array, "b n d"]:
    """Scale and shift normalized tokens."""
    return x * (1 + scale) + shift


class Attention(nnx.Module):
    """Self-attention of the tokens of text and video."""

    def __init__(self, config: CogVideoXDiTConfig, *, rngs: nnx.Rngs):
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

    def __init__(self, config: CogVideoXDiTConfig, *, rngs: nnx.Rngs):
        numerics: Any = {"dtype": config.dtype, "products": config.products}
        dim, hidden = config.dim, config.ffn_dim
        self.up = Linear(dim, hidden, axes=("embed", "mlp"), **numerics, rngs=rngs)
        self.down = Linear(hidden, dim, axes=("mlp", "embed"), **numerics, rngs=rngs)

    def __call__(self, x: Float[Array, "b n d"]) -> Float[Array, "b n d"]:
        """Map every token by itself."""
        return self.down(jax.nn.gelu(self.up(x), approximate=True))


class Block(nnx.Module):
    """Transformer block: attention and MLP on the residual stream of text and video."""

    def __init__(self, config: CogVideoXDiTConfig, *, rngs: nnx.Rngs):
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

        `time` is what the modulations see, the time embedding `b e`.
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

    def __init__(self, config: CogVideoXDiTConfig, *, rngs: nnx.Rngs):
        self.dim = config.dim
        dim, hidden, dtype = config.dim, config.time_dim, config.dtype
        self.up = Linear(dim, hidden, axes=("embed", None), dtype=dtype, rngs=rngs)
        self.down = Linear(hidden, hidden, axes=(None, None), dtype=dtype, rngs=rngs)

    def __call__(self, t: Float[Array, " b"]) -> Float[Array, "b e"]:
        """Embed timesteps in [0, 1000]."""
        hidden = jax.nn.silu(self.up(time_sinusoid(t, self.dim)))
        return self.down(hidden).astype(jnp.float32)


class CogVideoXDiT(nnx.Module):
    """Video diffusion transformer: prediction for noisy latents, given condition and text."""

    block: ClassVar[type[Block]] = Block
    """Class of the transformer blocks."""

    def __init__(self, config: CogVideoXDiTConfig, *, rngs: nnx.Rngs):
        self.config = config
        dtype = config.dtype
        self.patch = PatchEmbedding(
            config.in_channels,
            config.dim,
            noisy_channels=config.out_channels,
            patch=PATCH,
            dtype=dtype,
            rngs=rngs,
        )
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
        self._check(condition.shape, has_image=image is not None)
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
        """Return what the modulations of the blocks see."""
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

    def _check(self, condition: tuple[int, ...], *, has_image: bool) -> None:
        check_condition(
            condition,
            in_channels=self.config.in_channels,
            noisy_channels=self.config.out_channels,
            patch=PATCH,
        )
        if has_image:
            raise InputError("Image tokens were given to CogVideoX, which has no image branch.")
