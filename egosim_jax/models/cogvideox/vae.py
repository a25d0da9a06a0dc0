"""Causal video VAE of CogVideoX: 4 x 8 x 8 pixels to one latent cell of 16 channels.

A video of 8k+1 frames becomes 2k+1 latent frames. It is coded in chunks: 9 frames, then 8 at a
time, to 3 latent frames, then 2; a single frame is a chunk by itself. VideoX-Fun has decoded 1
latent frame, then 2 at a time, since December 2024 (`decode_first`). The chunks are part of the
numerics: group norms take their statistics over a chunk, and only the convolutions over time see
the frames before it, in their cache. So memory does not grow with the length of a clip.

    encoder   conv_in -> levels of residual blocks, each but the last followed by an average of
              pairs of frames, for the first levels, and a 2D convolution of stride 2
              -> middle -> norm, conv_out
    decoder   the mirror image, with one more residual block a level; its norms are scaled and
              shifted by the latents

(Yang et al. 2024, CogVideoX, section 2.1.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models.cogvideox.vae_layers import (
    Cache,
    Downsample,
    GroupNorm,
    Upsample,
    causal_conv,
    fit,
)
from egosim_jax.models.conv import Conv, check_video
from egosim_jax.models.layers import Linear
from egosim_jax.types import InputError, check_counts

CHUNK = 2
"""Latent frames of a chunk after the first, which has one more."""
CUBE = (3, 3, 3)


@dataclass(frozen=True, kw_only=True)
class CogVideoXVAEConfig:
    """Sizes of the video VAE; the defaults are CogVideoX 5B's."""

    table: ClassVar[str] = "egosim_jax.convert.tables.cogvideox_vae"
    """Module of the conversion table."""

    dims: tuple[int, ...] = (128, 256, 256, 512)
    """Channels of each level; each level after the first halves rows and columns."""
    z_dim: int = 16
    """Channels of the latents."""
    res_blocks: int = 3
    """Residual blocks per level of the encoder; the decoder has one more."""
    temporal_levels: int = 2
    """Number of levels, from the first, that halve the frame rate."""
    groups: int = 32
    """Groups of channels of the norms."""
    eps: float = 1e-6
    """Epsilon of the norms."""
    scale: float = 0.7
    """Factor of the latents that `encode` gives."""
    decode_first: Literal[1, 3] = 3
    """Latent frames of the first decoded chunk: 3 in diffusers, 1 in VideoX-Fun."""
    dtype: str = "float32"
    """Dtype of the convolutions; norms are computed in float32."""

    def __post_init__(self) -> None:
        check_counts({name: getattr(self, name) for name in ("z_dim", "res_blocks", "groups")})
        if len(self.dims) != 4 or self.temporal_levels != 2:
            raise InputError(
                f"{len(self.dims)} levels with {self.temporal_levels} that halve the frame rate "
                "do not give strides of 4 frames and 8 pixels: dims needs 4 entries and "
                "temporal_levels must be 2."
            )
        if any(dim % self.groups for dim in self.dims):
            raise InputError(
                f"dims {self.dims} do not divide into {self.groups} groups: each must be a "
                "multiple. Change groups."
            )

    def check_frames(self, frames: int) -> None:
        """Raise `InputError` unless the number of frames divides into chunks."""
        unit = CHUNK * self.temporal_stride
        if frames % unit != 1:
            below = max(1, (frames - 1) // unit * unit + 1)
            raise InputError(
                f"A video of {frames} frames cannot be encoded: CogVideoX's VAE needs {unit}k+1 "
                f"frames. Nearest: {below} or {below + unit}. (--num-frames)"
            )

    @property
    def spatial_stride(self) -> int:
        """Pixels per latent cell, along each axis."""
        return 2 ** (len(self.dims) - 1)

    @property
    def temporal_stride(self) -> int:
        """Pixel frames per latent frame, after the first."""
        return 2**self.temporal_levels

    @property
    def latent_channels(self) -> int:
        """Channels of the latents."""
        return self.z_dim

    def build(self, *, rngs: nnx.Rngs) -> CogVideoXVAE:
        """Build the network with random weights."""
        return CogVideoXVAE(self, rngs=rngs)


class SpatialNorm(nnx.Module):
    """Group norm whose output is scaled and shifted by the latents (Zheng et al. 2022, MoVQ)."""

    def __init__(self, dim: int, config: CogVideoXVAEConfig, *, rngs: nnx.Rngs):
        sizes, axes = (config.z_dim, dim), (None, "mlp")
        self.norm = GroupNorm(dim, groups=config.groups, eps=config.eps)
        self.scale = Linear(*sizes, axes=axes, dtype=config.dtype, rngs=rngs)
        self.shift = Linear(*sizes, axes=axes, dtype=config.dtype, rngs=rngs)

    def __call__(
        self, x: Float[Array, "b f h w c"], z: Float[Array, "b f2 h2 w2 z"]
    ) -> Float[Array, "b f h w c"]:
        """Normalize; each pixel reads the latent cell that it is in."""
        return self.norm(x) * fit(self.scale(z), x.shape) + fit(self.shift(z), x.shape)


class ResidualBlock(nnx.Module):
    """Twice (norm, SiLU, causal convolution), added to the input."""

    def __init__(
        self,
        in_dim: int,
        out_dim: int,
        config: CogVideoXVAEConfig,
        *,
        spatial_norm: bool,
        rngs: nnx.Rngs,
    ):
        dtype = config.dtype

        def norm(dim: int) -> SpatialNorm | GroupNorm:
            if spatial_norm:
                return SpatialNorm(dim, config, rngs=rngs)
            return GroupNorm(dim, groups=config.groups, eps=config.eps)

        self.norm1, self.norm2 = norm(in_dim), norm(out_dim)
        self.conv1 = Conv(CUBE, in_dim, out_dim, dtype=dtype, rngs=rngs)
        self.conv2 = Conv(CUBE, out_dim, out_dim, dtype=dtype, rngs=rngs)
        axes = (None, "mlp")
        self.shortcut = (
            None
            if in_dim == out_dim
            else Linear(in_dim, out_dim, axes=axes, dtype=dtype, rngs=rngs)
        )

    def __call__(
        self, x: Float[Array, "b f h w i"], z: Float[Array, "b f2 h2 w2 z"] | None, cache: Cache
    ) -> tuple[Float[Array, "b f h w o"], Cache]:
        """Add the two convolutions to the (projected) input; `z` are the decoder's latents."""
        cache1, cache2 = cache or (None, None)
        latents = () if z is None else (z,)
        y, cache1 = causal_conv(self.conv1, jax.nn.silu(self.norm1(x, *latents)), cache1)
        y, cache2 = causal_conv(self.conv2, jax.nn.silu(self.norm2(y, *latents)), cache2)
        return (x if self.shortcut is None else self.shortcut(x)) + y, (cache1, cache2)


class Encoder(nnx.Module):
    """Encoder of a chunk to 2 `z_dim` channels of moments."""

    def __init__(self, config: CogVideoXVAEConfig, *, rngs: nnx.Rngs):
        dims, dtype = config.dims, config.dtype
        self.conv_in = Conv(CUBE, 3, dims[0], dtype=dtype, rngs=rngs)
        layers: list[ResidualBlock | Downsample] = []
        for level, (dim, out) in enumerate(pairwise((dims[0], *dims))):
            layers += _blocks(dim, out, config.res_blocks, config, spatial_norm=False, rngs=rngs)
            if level < len(dims) - 1:
                temporal = level < config.temporal_levels
                layers.append(Downsample(out, temporal=temporal, dtype=dtype, rngs=rngs))
        self.levels = nnx.List(layers)
        middle = _blocks(dims[-1], dims[-1], 2, config, spatial_norm=False, rngs=rngs)
        self.middle = nnx.List(middle)
        self.norm_out = GroupNorm(dims[-1], groups=config.groups, eps=config.eps)
        self.conv_out = Conv(CUBE, dims[-1], 2 * config.z_dim, dtype=dtype, rngs=rngs)

    def __call__(
        self, x: Float[Array, "b f h w 3"], cache: Cache
    ) -> tuple[Float[Array, "b g y x m"], Cache]:
        """Encode the chunk that follows the cached ones."""
        return _run(self, [*self.levels, *self.middle], x, None, cache)


class Decoder(nnx.Module):
    """Decoder of a chunk of latents."""

    def __init__(self, config: CogVideoXVAEConfig, *, rngs: nnx.Rngs):
        dims, dtype = config.dims[::-1], config.dtype
        self.conv_in = Conv(CUBE, config.z_dim, dims[0], dtype=dtype, rngs=rngs)
        middle = _blocks(dims[0], dims[0], 2, config, spatial_norm=True, rngs=rngs)
        self.middle = nnx.List(middle)
        layers: list[ResidualBlock | Upsample] = []
        for level, (dim, out) in enumerate(pairwise((dims[0], *dims))):
            count = config.res_blocks + 1
            layers += _blocks(dim, out, count, config, spatial_norm=True, rngs=rngs)
            if level < len(dims) - 1:
                temporal = level < config.temporal_levels
                layers.append(Upsample(out, temporal=temporal, dtype=dtype, rngs=rngs))
        self.levels = nnx.List(layers)
        self.norm_out = SpatialNorm(dims[-1], config, rngs=rngs)
        self.conv_out = Conv(CUBE, dims[-1], 3, dtype=dtype, rngs=rngs)

    def __call__(
        self, z: Float[Array, "b f h w z"], cache: Cache
    ) -> tuple[Float[Array, "b g y x 3"], Cache]:
        """Decode the chunk that follows the cached ones."""
        return _run(self, [*self.middle, *self.levels], z, z, cache)


def _blocks(
    dim: int,
    out: int,
    count: int,
    config: CogVideoXVAEConfig,
    *,
    spatial_norm: bool,
    rngs: nnx.Rngs,
) -> list[ResidualBlock]:
    """Build residual blocks; the first one changes the number of channels."""
    return [
        ResidualBlock(out if block else dim, out, config, spatial_norm=spatial_norm, rngs=rngs)
        for block in range(count)
    ]


def _run(
    net: Encoder | Decoder, layers: Sequence[Any], x: Array, z: Array | None, cache: Cache
) -> tuple[Array, Cache]:
    """Run an encoder or decoder: convolution, layers, norm, convolution."""
    first, *inner, last = cache or (None,) * (len(layers) + 2)
    x, first = causal_conv(net.conv_in, x, first)
    after = []
    for layer, memory in zip(layers, inner, strict=True):
        if isinstance(layer, ResidualBlock):
            x, memory = layer(x, z, memory)
        else:
            x = layer(x)
        after.append(memory)
    latents = () if z is None else (z,)
    x, last = causal_conv(net.conv_out, jax.nn.silu(net.norm_out(x, *latents)), last)
    return x, (first, *after, last)


class CogVideoXVAE(nnx.Module):
    """Causal video VAE; RGB in [-1, 1], `f = 8 k + 1` frames, `f2 = 2 k + 1` latent frames."""

    def __init__(self, config: CogVideoXVAEConfig, *, rngs: nnx.Rngs):
        self.config = config
        self.encoder = Encoder(config, rngs=rngs)
        self.decoder = Decoder(config, rngs=rngs)

    def moments(
        self, video: Float[Array, "b f h w 3"]
    ) -> tuple[Float[Array, "b f2 h2 w2 z"], Float[Array, "b f2 h2 w2 z"]]:
        """Return mean and log variance of the latents, not scaled, in float32.

        Raises `InputError` unless the video has floats (in [-1, 1]) and 8k+1 frames with a height
        and width in multiples of 8.
        """
        config = self.config
        check_video(video, stride=config.spatial_stride, check_frames=config.check_frames)
        size = CHUNK * self.config.temporal_stride
        hidden = _by_chunk(self.encoder, video, first=size + 1, size=size)
        mean, logvar = jnp.split(hidden.astype(jnp.float32), 2, axis=-1)
        return mean, jnp.clip(logvar, -30.0, 20.0)

    def encode(self, video: Float[Array, "b f h w 3"]) -> Float[Array, "b f2 h2 w2 z"]:
        """Return scaled mean latents, float32; raises as `moments` does."""
        return self.normalize(self.moments(video)[0])

    def decode(self, latents: Float[Array, "b f h w z"]) -> Float[Array, "b f2 h2 w2 3"]:
        """Return the video of scaled latents, float32 in [-1, 1].

        Raises `InputError` unless the number of latent frames is odd.
        """
        if latents.shape[1] % CHUNK != 1:
            raise InputError(
                f"{latents.shape[1]} latent frames cannot be decoded: CogVideoX's VAE needs an odd "
                "number, of videos of 8k+1 frames. Change the number of frames. (--num-frames)"
            )
        latents = self.denormalize(latents.astype(jnp.float32))
        return jnp.clip(self.decode_whole(latents), -1.0, 1.0)

    def decode_whole(self, latents: Float[Array, "b f h w z"]) -> Float[Array, "b f2 h2 w2 3"]:
        """Return the video of unscaled latents, not clipped, for training; also in chunks."""
        video = _by_chunk(self.decoder, latents, first=self.config.decode_first, size=CHUNK)
        return video.astype(jnp.float32)

    def normalize(self, mean: Float[Array, "*b z"]) -> Float[Array, "*b z"]:
        """Scale latents."""
        return self.config.scale * mean

    def denormalize(self, latents: Float[Array, "*b z"]) -> Float[Array, "*b z"]:
        """Undo the scaling of latents (`normalize`)."""
        return latents / self.config.scale

    def standardize(self, mean: Float[Any, " z"], std: Float[Any, " z"]) -> None:
        """Fold a measured deviation of the latents into the layers before and after them.

        `mean` and `std` are statistics, over a data set, of the posterior means that `moments`
        returns. Afterwards the latents of `encode` have a mean square of 1 in each channel, and
        encoding then decoding gives the same video as before. Their mean stays: the decoder's first
        convolution pads with zeros, so no bias could replace it.
        """
        size = self.config.scale * jnp.sqrt(jnp.square(mean) + jnp.square(std))
        out, shift = self.encoder.conv_out, jnp.concatenate([0 * size, -2 * jnp.log(size)])
        scale = jnp.concatenate([1 / size, jnp.ones_like(size)])
        out.kernel[...] = out.kernel[...] * scale
        out.bias[...] = out.bias[...] * scale + shift
        readers = [self.decoder.conv_in]
        for _, layer in nnx.iter_modules(self.decoder):
            if isinstance(layer, SpatialNorm):
                readers += [layer.scale, layer.shift]
        for layer in readers:
            layer.kernel[...] = size[:, None] * layer.kernel[...]


def _by_chunk(net: Encoder | Decoder, x: Array, *, first: int, size: int) -> Array:
    """Run a network over a first chunk and the following ones, one after the other."""
    y, cache = net(x[:, :first], None)
    rest = rearrange(x[:, first:], "b (n f) h w c -> n b f h w c", f=size)
    if not len(rest):
        return y

    def step(cache: Cache, chunk: Array) -> tuple[Cache, Array]:
        y, cache = net(chunk, cache)
        return cache, y

    _, more = jax.lax.scan(step, cache, rest)
    return jnp.concatenate([y, rearrange(more, "n b f h w c -> b (n f) h w c")], axis=1)
