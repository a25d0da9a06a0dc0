"""Causal video VAE of Wan 2.1: 4 x 8 x 8 pixels to one latent cell of 16 channels.

A video of 4k+1 frames becomes k+1 latent frames: the first encodes one frame, every further one
four. No layer looks ahead in time, so a clip can be coded in pieces of any length, as long as each
layer remembers the last frames of the piece before: that memory is its *cache*.

    encoder   conv_in -> levels of residual blocks, each followed by a 2D convolution of stride 2
              (and, where `temporal_downsample` says so, a temporal one) -> middle -> conv_out
    decoder   the mirror image, with one more residual block a level

Coding a whole clip with cache None (`moments`, `decode_whole`) and coding it
frame group by frame group (`encode`, `decode`) are therefore the same function; the latter's
memory does not grow with the length of the clip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar, cast

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models.conv import Conv, check_video
from egosim_jax.models.layers import Linear
from egosim_jax.models.wan.vae_layers import (
    Cache,
    Downsample,
    Input,
    Layer,
    Output,
    ResidualBlock,
    SpatialAttention,
    Upsample,
    causal_conv,
    identity_init,
    init_constant_channels,
    norm,
)
from egosim_jax.types import InputError, VideoGrid


@dataclass(frozen=True, kw_only=True)
class WanVAEConfig:
    """Sizes of the video VAE; the defaults are the release's."""

    table: ClassVar[str] = "egosim_jax.convert.tables.wan_vae"
    """Module of the conversion table."""

    dim: int = 96
    """Channels at full resolution."""
    decoder_dim: int | None = None
    """Channels of the decoder at full resolution; None: `dim`."""
    z_dim: int = 16
    """Channels of the latents."""
    dim_mult: tuple[int, ...] = (1, 2, 4, 4)
    """Channels of each level, in units of those at full resolution.

    Each level after the first halves the size."""
    res_blocks: int = 2
    """Residual blocks per level of the encoder; the decoder has one more."""
    temporal_downsample: tuple[bool, ...] = (False, True, True)
    """For each level but the last, True if the step below it also halves the frame rate."""
    latent_mean: tuple[float, ...] = (
        -0.7571, -0.7089, -0.9113, 0.1075, -0.1745, 0.9653, -0.1517, 1.5508,
        0.4134, -0.0715, 0.5517, -0.3632, -0.1922, -0.9497, 0.2503, -0.2921,
    )  # fmt: skip
    """Mean of each latent channel, subtracted by `encode`."""
    latent_std: tuple[float, ...] = (
        2.8184, 1.4541, 2.3275, 2.6558, 1.2196, 1.7708, 2.6052, 2.0743,
        3.2687, 2.1526, 2.8652, 1.5579, 1.6382, 1.1253, 2.8251, 1.9160,
    )  # fmt: skip
    """Standard deviation of each latent channel, divided out by `encode`."""
    dtype: str = "float32"
    """Dtype of the convolutions; norms are computed in float32."""

    def __post_init__(self) -> None:
        if len(self.dim_mult) != 4 or len(self.temporal_downsample) != 3:
            raise InputError(
                f"{len(self.dim_mult)} levels with {len(self.temporal_downsample)} steps between "
                "them do not give a stride of 8 pixels: dim_mult needs 4 entries "
                "and temporal_downsample 3."
            )
        if sum(self.temporal_downsample) != 2:
            raise InputError(
                f"temporal_downsample {self.temporal_downsample} does not give a stride of "
                "4 frames: exactly two entries must be True."
            )
        for name in ("latent_mean", "latent_std"):
            if len(getattr(self, name)) != self.z_dim:
                raise InputError(
                    f"{name} has {len(getattr(self, name))} entries for {self.z_dim} latent "
                    "channels (z_dim): give one number per channel."
                )

    @property
    def spatial_stride(self) -> int:
        """Pixels per latent cell, along each axis."""
        return 2 ** len(self.temporal_downsample)

    @property
    def temporal_stride(self) -> int:
        """Pixel frames per latent frame, after the first."""
        return 2 ** sum(self.temporal_downsample)

    @property
    def latent_channels(self) -> int:
        """Channels of the latents."""
        return self.z_dim

    def build(self, *, rngs: nnx.Rngs) -> WanVAE:
        """Build the network with random weights."""
        return WanVAE(self, rngs=rngs)


class Encoder(nnx.Module):
    """Encoder of videos to 2 `z_dim` channels of moments, before the quantization convolution."""

    def __init__(self, config: WanVAEConfig, *, rngs: nnx.Rngs):
        dtype = config.dtype
        dims = [config.dim * m for m in (1, *config.dim_mult)]
        cube, now = (3, 3, 3), identity_init((2, 1, 1))
        self.conv_in = Conv(cube, 3, dims[0], dtype=dtype, kernel_init=now, rngs=rngs)
        init_constant_channels(self.conv_in)
        layers = []
        for level, (dim, out) in enumerate(pairwise(dims)):
            for block in range(config.res_blocks):
                layers.append(ResidualBlock(out if block else dim, out, dtype=dtype, rngs=rngs))
            if level < len(config.temporal_downsample):
                temporal = config.temporal_downsample[level]
                layers.append(Downsample(out, temporal=temporal, dtype=dtype, rngs=rngs))
        self.levels = nnx.List(layers)
        self.middle = nnx.List(_middle(dims[-1], dtype=dtype, rngs=rngs))
        self.norm_out = norm(dims[-1])
        moments = 2 * config.z_dim
        self.conv_out = Conv(cube, dims[-1], moments, dtype=dtype, kernel_init=now, rngs=rngs)

    def __call__(self, x: Input, cache: Cache) -> Output:
        """Encode the frames that follow the cached ones."""
        return _run(self, [*self.levels, *self.middle], x, cache)


class Decoder(nnx.Module):
    """Decoder of latents, after the quantization convolution, to videos."""

    def __init__(self, config: WanVAEConfig, *, rngs: nnx.Rngs):
        dtype = config.dtype
        mults, base = config.dim_mult[::-1], config.decoder_dim or config.dim
        layers, dim = [], base * mults[0]
        cube, now = (3, 3, 3), identity_init((2, 1, 1))
        self.conv_in = Conv(cube, config.z_dim, dim, dtype=dtype, kernel_init=now, rngs=rngs)
        init_constant_channels(self.conv_in)
        self.middle = nnx.List(_middle(dim, dtype=dtype, rngs=rngs))
        for level, mult in enumerate(mults):
            out = base * mult
            for _ in range(config.res_blocks + 1):
                layers.append(ResidualBlock(dim, out, dtype=dtype, rngs=rngs))
                dim = out
            if level < len(config.temporal_downsample):
                temporal = config.temporal_downsample[-1 - level]
                layers.append(Upsample(dim, temporal=temporal, dtype=dtype, rngs=rngs))
                dim //= 2
        self.levels = nnx.List(layers)
        self.norm_out = norm(dim)
        self.conv_out = Conv(cube, dim, 3, dtype=dtype, kernel_init=now, rngs=rngs)

    def __call__(self, x: Input, cache: Cache) -> Output:
        """Decode the latent frames that follow the cached ones."""
        return _run(self, [*self.middle, *self.levels], x, cache)


def _middle(dim: int, *, dtype: str, rngs: nnx.Rngs) -> list[nnx.Module]:
    return [
        ResidualBlock(dim, dim, dtype=dtype, rngs=rngs),
        SpatialAttention(dim, dtype=dtype, rngs=rngs),
        ResidualBlock(dim, dim, dtype=dtype, rngs=rngs),
    ]


def _run(net: Encoder | Decoder, layers: Sequence[Layer], x: Input, cache: Cache) -> Output:
    """Run an encoder or decoder: convolution, layers, norm, convolution."""
    first, *inner, last = cache or (None,) * (len(layers) + 2)
    x, first = causal_conv(net.conv_in, x, first)
    after = []
    for layer, memory in zip(layers, inner, strict=True):
        x, memory = layer(x, memory)
        after.append(memory)
    x, last = causal_conv(net.conv_out, jax.nn.silu(net.norm_out(x)), last)
    return x, (first, *after, last)


class WanVAE(nnx.Module):
    """Causal video VAE; RGB in [-1, 1], `f = 4 k + 1` frames, `f' = k + 1` latent frames."""

    def __init__(self, config: WanVAEConfig, *, rngs: nnx.Rngs):
        self.config = config
        z, dtype = config.z_dim, config.dtype
        axes = (None, "mlp")
        self.encoder = Encoder(config, rngs=rngs)
        same = identity_init(())
        self.to_moments = Linear(2 * z, 2 * z, axes=axes, dtype=dtype, kernel_init=same, rngs=rngs)
        # Untrained, the samples are close to their means: noise as strong as the signal would
        # first have to be unlearnt.
        bias = cast(nnx.Param, self.to_moments.bias)
        bias[...] = bias[...].at[z:].set(-5.0)
        self.from_latents = Linear(z, z, axes=axes, dtype=dtype, kernel_init=same, rngs=rngs)
        self.decoder = Decoder(config, rngs=rngs)

    def moments(
        self, video: Float[Array, "b f h w 3"]
    ) -> tuple[Float[Array, "b f2 h2 w2 z"], Float[Array, "b f2 h2 w2 z"]]:
        """Return mean and log variance of the latents, not normalized, in one pass."""
        self._check(video)
        hidden, _ = self.encoder(video, None)
        mean, logvar = jnp.split(self.to_moments(hidden).astype(jnp.float32), 2, axis=-1)
        return mean, jnp.clip(logvar, -30.0, 20.0)

    def decode_whole(self, latents: Float[Array, "b f h w z"]) -> Float[Array, "b f2 h2 w2 3"]:
        """Return the video of latents not normalized, in one pass, not clipped: for training."""
        video, _ = self.decoder(self.from_latents(latents), None)
        return video.astype(jnp.float32)

    def encode(self, video: Float[Array, "b f h w 3"]) -> Float[Array, "b f2 h2 w2 z"]:
        """Return normalized mean latents, float32; frames are coded in groups of 1, 4, 4, ...

        Raises `InputError` unless the video has floats (in [-1, 1]) and 4k+1 frames with a height
        and width in multiples of 8.
        """
        self._check(video)
        return self.encode_next(video, None)[0]

    def encode_next(
        self, video: Float[Array, "b f h w 3"], cache: Cache
    ) -> tuple[Float[Array, "b f2 h2 w2 z"], Cache]:
        """Return the latents of the next frames of a video, and the cache for those after them.

        The first frames have no cache and number 4k+1; all others number 4k.
        """
        found = []
        if cache is None:
            first, cache = self.encoder(video[:, :1], None)
            found, video = [first], video[:, 1:]

        def step(cache: Cache, frames: Array) -> tuple[Cache, Array]:
            hidden, cache = self.encoder(frames, cache)
            return cache, hidden

        groups = rearrange(video, "b (n f) h w c -> n b f h w c", f=self.config.temporal_stride)
        cache, rest = jax.lax.scan(step, cache, groups)
        found.append(rearrange(rest, "n b f h w c -> b (n f) h w c"))
        moments = self.to_moments(jnp.concatenate(found, axis=1))
        return self.normalize(moments[..., : self.config.z_dim].astype(jnp.float32)), cache

    def decode(self, latents: Float[Array, "b f h w z"]) -> Float[Array, "b f2 h2 w2 3"]:
        """Return the video of normalized latents, float32 in [-1, 1], frame by latent frame."""
        first, cache = self.decode_next(latents[:, :1], None)

        def step(cache: Cache, frame: Array) -> tuple[Cache, Array]:
            video, cache = self.decode_next(frame, cache)
            return cache, video

        _, rest = jax.lax.scan(step, cache, rearrange(latents[:, 1:], "b n h w c -> n b 1 h w c"))
        rest = rearrange(rest, "n b f h w c -> b (n f) h w c")
        return jnp.concatenate([first, rest], axis=1)

    def decode_next(
        self, latents: Float[Array, "b 1 h w z"], cache: Cache
    ) -> tuple[Float[Array, "b g h2 w2 3"], Cache]:
        """Return the frames of the next latent frame, and the cache for the one after it.

        The first latent frame has no cache and gives one frame; all others give four.
        """
        hidden = self.from_latents(self.denormalize(latents.astype(jnp.float32)))
        video, cache = self.decoder(hidden, cache)
        return jnp.clip(video.astype(jnp.float32), -1.0, 1.0), cache

    def normalize(self, mean: Float[Array, "*b z"]) -> Float[Array, "*b z"]:
        """Normalize latents with the configured mean and standard deviation."""
        return (mean - jnp.array(self.config.latent_mean)) / jnp.array(self.config.latent_std)

    def denormalize(self, latents: Float[Array, "*b z"]) -> Float[Array, "*b z"]:
        """Undo the normalization of latents by channel (`normalize`)."""
        return latents * jnp.array(self.config.latent_std) + jnp.array(self.config.latent_mean)

    def standardize(self, mean: Float[Any, " z"], std: Float[Any, " z"]) -> None:
        """Fold a measured latent mean and deviation into the two quantization convolutions.

        `mean` and `std` are statistics, over a data set, of the posterior means that `moments`
        returns. Afterwards the means have mean 0 and deviation 1, the log variances shrink by 2 log
        std, and a decoded encoding is the same video as before.
        """
        encode, decode = self.to_moments, self.from_latents
        encode_bias, decode_bias = cast(nnx.Param, encode.bias), cast(nnx.Param, decode.bias)
        scale = jnp.concatenate([1 / std, jnp.ones_like(std)])
        shift = jnp.concatenate([-mean / std, -2 * jnp.log(std)])
        encode.kernel[...] = encode.kernel[...] * scale
        encode_bias[...] = encode_bias[...] * scale + shift
        decode_bias[...] = decode_bias[...] + mean @ decode.kernel[...]
        decode.kernel[...] = std[:, None] * decode.kernel[...]

    def _check(self, video: Array) -> None:
        time, space = self.config.temporal_stride, self.config.spatial_stride
        grid = VideoGrid(temporal_stride=time, spatial_stride=space, patch=1)
        check_video(video, stride=space, check_frames=grid.check_frames)
