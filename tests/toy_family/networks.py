"""A second family of networks, as unlike Wan's as the seams allow, and small.

A codec of 2 x 4 x 4 pixels to 6 channels, a denoiser without patches, stacks or image branch, which
mixes tokens by their mean, and a text encoder that looks its tokens up.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import prod
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from einops import rearrange, reduce
from flax import nnx
from jaxtyping import Array, Bool, Float, Int

from egosim_jax.models import Flops
from egosim_jax.models.layers import Embed, LayerNorm, Linear
from egosim_jax.models.sinusoid import time_sinusoid

TIME, SPACE = 2, 4
CELL = "b (f t) (h i) (w j) c -> b f h w (t i j c)"


@dataclass(frozen=True, kw_only=True)
class ToyCodecConfig:
    """Linear video codec; the first latent frame encodes the first frame, repeated."""

    table: ClassVar[str] = "tests.toy_family.tables.codec"

    latent_channels: int = 6
    spatial_stride: int = SPACE
    temporal_stride: int = TIME
    dtype: str = "float32"

    def build(self, *, rngs: nnx.Rngs) -> ToyCodec:
        return ToyCodec(self, rngs=rngs)


class ToyCodec(nnx.Module):
    def __init__(self, config: ToyCodecConfig, *, rngs: nnx.Rngs):
        pixels, z = TIME * SPACE**2 * 3, config.latent_channels
        self.down = Linear(pixels, z, axes=(None, None), rngs=rngs)
        self.up = Linear(z, pixels, axes=(None, None), rngs=rngs)

    def encode(self, video: Float[Array, "b f h w 3"]) -> Float[Array, "b f2 h2 w2 z"]:
        return self.moments(video)[0]

    def moments(self, video: Float[Array, "b f h w 3"]) -> tuple[jax.Array, jax.Array]:
        padded = jnp.concatenate([video[:, :1], video], axis=1)
        mean = self.down(rearrange(padded, CELL, t=TIME, i=SPACE, j=SPACE))
        return mean, jnp.zeros_like(mean)

    def decode(self, latents: Float[Array, "b f h w z"]) -> Float[Array, "b f2 h2 w2 3"]:
        there, back = CELL.split(" -> ")
        video = rearrange(self.up(latents), f"{back} -> {there}", t=TIME, i=SPACE, j=SPACE, c=3)
        return jnp.clip(video[:, 1:], -1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class ToyTextConfig:
    """Table of token embeddings."""

    table: ClassVar[str] = "tests.toy_family.tables.text"

    vocab: int = 384
    dim: int = 8
    dtype: str = "float32"

    def build(self, *, rngs: nnx.Rngs) -> ToyText:
        return ToyText(self, rngs=rngs)


class ToyText(nnx.Module):
    def __init__(self, config: ToyTextConfig, *, rngs: nnx.Rngs):
        self.embed = Embed(config.vocab, config.dim, rngs=rngs)

    def __call__(self, ids: Int[Array, "b n"], mask: Bool[Array, "b n"]) -> Float[Array, "b n d"]:
        return self.embed(ids) * mask[..., None]


@dataclass(frozen=True, kw_only=True)
class ToyDenoiserConfig:
    """Denoiser of single latent cells."""

    table: ClassVar[str] = "tests.toy_family.tables.denoiser"
    numerics_only: ClassVar[tuple[str, ...]] = ()
    remat_levels: ClassVar[tuple[str, ...]] = ()
    lora_targets: ClassVar[tuple[str, ...]] = ("blocks.*.up",)
    also_train: ClassVar[tuple[str, ...]] = ("input.*",)

    in_channels: int = 19
    out_channels: int = 6
    text_dim: int = 8
    image_dim: int | None = None
    dim: int = 16
    heads: int = 1
    layers: int = 2
    patch: tuple[int, int, int] = (1, 1, 1)
    dtype: str = "float32"

    def build(self, *, rngs: nnx.Rngs) -> ToyDenoiser:
        return ToyDenoiser(self, rngs=rngs)

    def forward_flops(self, *, latents: tuple[int, int, int], text: int, image: int) -> Flops:
        cells, d = prod(latents), self.dim
        inner = self.layers * 8 * d**2 + (self.in_channels + self.out_channels) * d
        return Flops(weights=2.0 * (cells * inner + text * self.text_dim * d), attention=0.0)


class ToyBlock(nnx.Module):
    def __init__(self, dim: int, *, rngs: nnx.Rngs):
        self.norm = LayerNorm(dim, eps=1e-5)
        self.up = Linear(dim, 4 * dim, axes=("embed", "mlp"), rngs=rngs)
        self.down = Linear(4 * dim, dim, axes=("mlp", "embed"), rngs=rngs)

    def __call__(self, x: Float[Array, "b f h w d"]) -> Float[Array, "b f h w d"]:
        y = self.norm(x + x.mean(axis=(1, 2, 3), keepdims=True))
        return x + self.down(jax.nn.gelu(self.up(y)))


class ToyDenoiser(nnx.Module):
    def __init__(self, config: ToyDenoiserConfig, *, rngs: nnx.Rngs):
        dim = config.dim
        self.dim, self.noisy_channels = dim, config.out_channels
        self.input = Linear(config.in_channels, dim, axes=(None, "embed"), rngs=rngs)
        self.text = Linear(config.text_dim, dim, axes=(None, "embed"), rngs=rngs)
        self.blocks = nnx.List([ToyBlock(dim, rngs=rngs) for _ in range(config.layers)])
        self.output = Linear(dim, config.out_channels, axes=("embed", None), rngs=rngs)

    def prepare(
        self,
        condition: Float[Array, "b f h w c"],
        text: Float[Array, "b n d"],
        image: Float[Array, "b m e"] | None = None,
    ) -> Any:
        prompt = reduce(self.text(text), "b n d -> b 1 1 1 d", "mean")
        return condition @ self.input.kernel[...][self.noisy_channels :] + prompt

    def denoise(
        self, noisy: Float[Array, "b f h w c"], t: Float[Array, " b"], context: Any
    ) -> Float[Array, "b f h w c"]:
        time = rearrange(time_sinusoid(t, self.dim), "b d -> b 1 1 1 d")
        x = noisy @ self.input.kernel[...][: self.noisy_channels] + self.input.bias[...]
        x = x + context + time
        for block in self.blocks:
            x = block(x)
        return self.output(x)
