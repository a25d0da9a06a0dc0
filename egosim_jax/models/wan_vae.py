"""The causal video VAE of Wan 2.1: 4 x 8 x 8 pixels to one latent cell of 16 channels.

A video of 4k+1 frames becomes k+1 latent frames: the first encodes one frame, every further one
four. No layer looks ahead in time, so a clip can be coded in pieces of any length, as long as each
layer remembers the last frames of the piece before: that memory is its *cache*.

    encoder   conv_in -> levels of residual blocks, each followed by a 2D convolution of stride 2
              (and, where `temporal_downsample` says so, a temporal one) -> middle -> conv_out
    decoder   the mirror image, with one more residual block a level

Every layer is called as `layer(x, cache) -> (y, new cache)`. A cache of None marks the start of
the video, where the three stateful layers follow these rules (x_t = 0 for t < 0):

    causal convolution     y_t = sum_k W_k x_(t-K+1+k), k < K
    temporal downsample    y_0 = x_0,  y_j = sum_k W_k x_(2j-2+k), k < 3
    temporal upsample      y_0 = x_0,  (y_(2j-1), y_2j) = the two halves of sum_k W_k x'_(j-2+k),
                           where x' is x with x_0 replaced by 0

Coding a whole clip with cache None (`encode_whole`, `decode_whole`, `moments`) and coding it
frame group by frame group (`encode`, `decode`) are therefore the same function; the latter's
memory does not grow with the length of the clip.

Kernels are stored `[t, h, w, in, out]`, `[h, w, in, out]` or, for 1 x 1 x 1, `[in, out]`. Of their
logical axes only the output channels have a name, `mlp`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, cast

import jax
import jax.numpy as jnp
from einops import rearrange, repeat
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models.attention import attention
from egosim_jax.models.causal_conv import convolve
from egosim_jax.models.layers import Initializer, Linear, RMSNorm, lecun_normal
from egosim_jax.types import SPATIAL_STRIDE, TEMPORAL_STRIDE, InputError, check_frame_count

Cache = Any
"""What a layer remembers of the frames before: an array, a tuple of caches, or None."""
Input = Float[Array, "b f h w i"]
Output = tuple[Float[Array, "b g y x o"], Cache]
Layer = Callable[[Array, Cache], tuple[Array, Cache]]
# Residual branches start small, not at zero: that gave 10.4 instead of 13.2 dB after 60 steps
# (one seed, width 16).
_small = nnx.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
_noise = nnx.initializers.variance_scaling(0.09, "fan_in", "truncated_normal")


@dataclass(frozen=True, kw_only=True)
class WanVAEConfig:
    """Sizes of the video VAE; the defaults are the released one's."""

    dim: int = 96
    """Channels at full resolution."""
    z_dim: int = 16
    """Latent channels."""
    dim_mult: tuple[int, ...] = (1, 2, 4, 4)
    """Channels of each level, in units of `dim`; each level after the first halves the size."""
    res_blocks: int = 2
    """Residual blocks per level of the encoder; the decoder has one more."""
    temporal_downsample: tuple[bool, ...] = (False, True, True)
    """Whether the step below each level also halves the frame rate."""
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
        """Check that the strides are 4 x 8 x 8 and that the statistics fit the latents."""
        if len(self.dim_mult) != 4 or len(self.temporal_downsample) != 3:
            raise InputError(
                f"{len(self.dim_mult)} levels with {len(self.temporal_downsample)} steps between "
                f"them do not give a stride of {SPATIAL_STRIDE} pixels: dim_mult needs 4 entries "
                "and temporal_downsample 3."
            )
        if sum(self.temporal_downsample) != 2:
            raise InputError(
                f"temporal_downsample {self.temporal_downsample} does not give a stride of "
                f"{TEMPORAL_STRIDE} frames: exactly two entries must be True."
            )
        for name in ("latent_mean", "latent_std"):
            if len(getattr(self, name)) != self.z_dim:
                raise InputError(
                    f"{name} has {len(getattr(self, name))} entries for {self.z_dim} latent "
                    "channels (z_dim): give one number per channel."
                )


def _copy(*taps: tuple[int, ...], times: int = 1) -> Initializer:
    """Weights that hand each channel on as the mean over `taps`, with a little noise.

    With them, residual branches that start small and `_offsets`, the untrained network is already
    a pyramid of averages and its inverse, and training has only the detail to learn: 22.5 instead
    of 16.9 dB after 200 and 100 steps (one seed, width 8).
    """

    def init(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32, **_: Any) -> Array:
        same = jnp.tile(jnp.eye(shape[-2], shape[-1] // times, dtype=dtype), (1, times))
        kernel = _noise(key, shape, dtype)
        for tap in taps:
            kernel = kernel.at[tap].add(same / len(taps))
        return kernel

    return init


def _offsets(conv: Conv) -> None:
    """Give the channels that do not carry colour the constants 1 and -1.

    The norms divide by the length of all channels: without a constant among them, dark and bright
    would look the same.
    """
    channel = jnp.arange(conv.bias.shape[0])
    conv.bias[...] = jnp.where(channel < 3, 0.0, 1.0 - 2.0 * (channel % 2))


class Conv(nnx.Module):
    """A convolution with bias; kernel `[h, w, in, out]` or, over time too, `[t, h, w, in, out]`."""

    def __init__(
        self,
        size: tuple[int, ...],
        in_dim: int,
        out_dim: int,
        *,
        dtype: str,
        kernel_init: Initializer = lecun_normal,
        rngs: nnx.Rngs,
    ):
        self.dtype = jnp.dtype(dtype)
        kernel = kernel_init(rngs.params(), (*size, in_dim, out_dim))
        self.kernel = nnx.Param(kernel, axes=(*(None for _ in size), None, "mlp"))
        self.bias = nnx.Param(jnp.zeros(out_dim), axes=("mlp",))

    def __call__(self, x: Input) -> Float[Array, "b g h w o"]:
        """Convolve, SAME in space and, with a kernel over time, VALID in time."""
        kernel = self.kernel[...].astype(self.dtype)
        y = convolve(x.astype(self.dtype), kernel if kernel.ndim == 5 else kernel[None])
        return y + self.bias[...].astype(self.dtype)

    def halve(self, x: Input) -> Float[Array, "b f y x o"]:
        """Convolve images with stride 2, padded by a row below and a column on the right."""
        images = rearrange(x.astype(self.dtype), "b f h w i -> (b f) h w i")
        y = jax.lax.conv_general_dilated(
            images,
            self.kernel[...].astype(self.dtype),
            (2, 2),
            ((0, 1), (0, 1)),
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )
        y = rearrange(y, "(b f) h w o -> b f h w o", b=x.shape[0])
        return y + self.bias[...].astype(self.dtype)


def causal(conv: Conv, x: Input, cache: Cache) -> Output:
    """Convolve each frame with the two before it, or zeros; the cache is the last two."""
    if cache is None:
        cache = jnp.zeros((x.shape[0], 2, *x.shape[2:]), conv.dtype)
    x = jnp.concatenate([cache, x.astype(conv.dtype)], axis=1)
    return conv(x), x[:, -2:]


class ResidualBlock(nnx.Module):
    """Twice (norm, SiLU, causal convolution), added to the input."""

    def __init__(self, in_dim: int, out_dim: int, *, dtype: str, rngs: nnx.Rngs):
        cube = (3, 3, 3)
        self.norm1 = _norm(in_dim)
        self.conv1 = Conv(cube, in_dim, out_dim, dtype=dtype, rngs=rngs)
        self.norm2 = _norm(out_dim)
        self.conv2 = Conv(cube, out_dim, out_dim, dtype=dtype, kernel_init=_small, rngs=rngs)
        self.shortcut = (
            Linear(
                in_dim, out_dim, axes=(None, "mlp"), dtype=dtype, kernel_init=_copy(()), rngs=rngs
            )
            if in_dim != out_dim
            else None
        )

    def __call__(self, x: Input, cache: Cache) -> Output:
        """Add the two convolutions to the (projected) input."""
        cache1, cache2 = cache or (None, None)
        y, cache1 = causal(self.conv1, jax.nn.silu(self.norm1(x)), cache1)
        y, cache2 = causal(self.conv2, jax.nn.silu(self.norm2(y)), cache2)
        return (x if self.shortcut is None else self.shortcut(x)) + y, (cache1, cache2)


class SpatialAttention(nnx.Module):
    """Single-head attention among the cells of each frame, added to the input."""

    def __init__(self, dim: int, *, dtype: str, rngs: nnx.Rngs):
        axes = (None, "mlp")
        self.norm = _norm(dim)
        self.qkv = Linear(dim, 3 * dim, axes=axes, dtype=dtype, rngs=rngs)
        self.out = Linear(dim, dim, axes=axes, dtype=dtype, kernel_init=_small, rngs=rngs)

    def __call__(self, x: Input, cache: Cache) -> Output:
        """Attend frame by frame; there is nothing to remember."""
        _, f, h, _, _ = x.shape
        qkv = self.qkv(self.norm(x))
        q, k, v = rearrange(qkv, "b f h w (three c) -> three (b f) (h w) 1 c", three=3)
        y = rearrange(attention(q, k, v), "(b f) (h w) 1 c -> b f h w c", f=f, h=h)
        return x + self.out(y), cache


class Downsample(nnx.Module):
    """Halve rows and columns and, if `temporal`, the frames after the first."""

    def __init__(self, dim: int, *, temporal: bool, dtype: str, rngs: nnx.Rngs):
        quad, pair = _copy((0, 0), (0, 1), (1, 0), (1, 1)), _copy((1, 0, 0), (2, 0, 0))
        self.space = Conv((3, 3), dim, dim, dtype=dtype, kernel_init=quad, rngs=rngs)
        self.time = (
            Conv((3, 1, 1), dim, dim, dtype=dtype, kernel_init=pair, rngs=rngs)
            if temporal
            else None
        )

    def __call__(self, x: Input, cache: Cache) -> Output:
        """Downsample; the cache is that of the temporal convolution."""
        x = self.space.halve(x)
        if self.time is None:
            return x, None
        y, after = causal(self.time, x, cache)
        if cache is None:
            return jnp.concatenate([x[:, :1], y[:, 2::2]], axis=1), after
        return y[:, 1::2], after


class Upsample(nnx.Module):
    """Double rows and columns, halve the channels and, if `temporal`, double the later frames."""

    def __init__(self, dim: int, *, temporal: bool, dtype: str, rngs: nnx.Rngs):
        twice, once = _copy((2, 0, 0), times=2), _copy((1, 1))
        self.time = (
            Conv((3, 1, 1), dim, 2 * dim, dtype=dtype, kernel_init=twice, rngs=rngs)
            if temporal
            else None
        )
        self.space = Conv((3, 3), dim, dim // 2, dtype=dtype, kernel_init=once, rngs=rngs)

    def __call__(self, x: Input, cache: Cache) -> Output:
        """Upsample; the cache is that of the temporal convolution, which never sees frame 0."""
        if self.time is not None:
            first, rest = (x[:, :1], x[:, 1:]) if cache is None else (x[:, :0], x)
            rest, cache = causal(self.time, rest, cache)
            rest = rearrange(rest, "b f h w (two c) -> b (f two) h w c", two=2)
            x = jnp.concatenate([first, rest], axis=1)
        x = repeat(x, "b f h w c -> b f (h two) (w too) c", two=2, too=2)
        return self.space(x), cache


class Encoder(nnx.Module):
    """Video to twice `z_dim` channels of latent moments, before the quantisation convolution."""

    def __init__(self, config: WanVAEConfig, *, rngs: nnx.Rngs):
        dtype = config.dtype
        dims = [config.dim * m for m in (1, *config.dim_mult)]
        cube, now = (3, 3, 3), _copy((2, 1, 1))
        self.conv_in = Conv(cube, 3, dims[0], dtype=dtype, kernel_init=now, rngs=rngs)
        _offsets(self.conv_in)
        layers = []
        for level, (dim, out) in enumerate(pairwise(dims)):
            for block in range(config.res_blocks):
                layers.append(ResidualBlock(out if block else dim, out, dtype=dtype, rngs=rngs))
            if level < len(config.temporal_downsample):
                temporal = config.temporal_downsample[level]
                layers.append(Downsample(out, temporal=temporal, dtype=dtype, rngs=rngs))
        self.levels = nnx.List(layers)
        self.middle = nnx.List(_middle(dims[-1], dtype=dtype, rngs=rngs))
        self.norm_out = _norm(dims[-1])
        moments = 2 * config.z_dim
        self.conv_out = Conv(cube, dims[-1], moments, dtype=dtype, kernel_init=now, rngs=rngs)

    def __call__(self, x: Input, cache: Cache) -> Output:
        """Encode the frames that follow those of the cache."""
        return _run(self, [*self.levels, *self.middle], x, cache)


class Decoder(nnx.Module):
    """Latents, after the quantisation convolution, to video."""

    def __init__(self, config: WanVAEConfig, *, rngs: nnx.Rngs):
        dtype = config.dtype
        mults = config.dim_mult[::-1]
        layers, dim = [], config.dim * mults[0]
        cube, now = (3, 3, 3), _copy((2, 1, 1))
        self.conv_in = Conv(cube, config.z_dim, dim, dtype=dtype, kernel_init=now, rngs=rngs)
        _offsets(self.conv_in)
        self.middle = nnx.List(_middle(dim, dtype=dtype, rngs=rngs))
        for level, mult in enumerate(mults):
            out = config.dim * mult
            for _ in range(config.res_blocks + 1):
                layers.append(ResidualBlock(dim, out, dtype=dtype, rngs=rngs))
                dim = out
            if level < len(config.temporal_downsample):
                temporal = config.temporal_downsample[-1 - level]
                layers.append(Upsample(dim, temporal=temporal, dtype=dtype, rngs=rngs))
                dim //= 2
        self.levels = nnx.List(layers)
        self.norm_out = _norm(dim)
        self.conv_out = Conv(cube, dim, 3, dtype=dtype, kernel_init=now, rngs=rngs)

    def __call__(self, x: Input, cache: Cache) -> Output:
        """Decode the latent frames that follow those of the cache."""
        return _run(self, [*self.middle, *self.levels], x, cache)


def _norm(dim: int) -> RMSNorm:
    return RMSNorm(dim, eps=1e-12, axes=(None,))


def _middle(dim: int, *, dtype: str, rngs: nnx.Rngs) -> list[nnx.Module]:
    return [
        ResidualBlock(dim, dim, dtype=dtype, rngs=rngs),
        SpatialAttention(dim, dtype=dtype, rngs=rngs),
        ResidualBlock(dim, dim, dtype=dtype, rngs=rngs),
    ]


def _run(net: Encoder | Decoder, layers: Sequence[Layer], x: Input, cache: Cache) -> Output:
    """The way through both halves: convolution, layers, norm, convolution."""
    first, *inner, last = cache or (None,) * (len(layers) + 2)
    x, first = causal(net.conv_in, x, first)
    after = []
    for layer, memory in zip(layers, inner, strict=True):
        x, memory = layer(x, memory)
        after.append(memory)
    x, last = causal(net.conv_out, jax.nn.silu(net.norm_out(x)), last)
    return x, (first, *after, last)


class WanVAE(nnx.Module):
    """The video VAE; RGB in [-1, 1], `f = 4 k + 1` frames, `f' = k + 1` latent frames."""

    def __init__(self, config: WanVAEConfig, *, rngs: nnx.Rngs):
        self.config = config
        z, dtype = config.z_dim, config.dtype
        axes = (None, "mlp")
        self.encoder = Encoder(config, rngs=rngs)
        same = _copy(())
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
        """Mean and log variance of the latents, not normalised, in one pass: for training."""
        self._check(video)
        hidden, _ = self.encoder(video, None)
        mean, logvar = jnp.split(self.to_moments(hidden).astype(jnp.float32), 2, axis=-1)
        return mean, jnp.clip(logvar, -30.0, 20.0)

    def encode_whole(self, video: Float[Array, "b f h w 3"]) -> Float[Array, "b f2 h2 w2 z"]:
        """`encode` in one pass; memory grows with the length."""
        return self.normalise(self.moments(video)[0])

    def decode_whole(self, latents: Float[Array, "b f h w z"]) -> Float[Array, "b f2 h2 w2 3"]:
        """The video of latents not normalised, in one pass and not clipped: for training."""
        video, _ = self.decoder(self.from_latents(latents), None)
        return video.astype(jnp.float32)

    def encode(self, video: Float[Array, "b f h w 3"]) -> Float[Array, "b f2 h2 w2 z"]:
        """Normalised mean latents, float32; the frames are coded in groups of 1, 4, 4, ...

        Raises `InputError` unless the video has 4k+1 frames of a size in multiples of 8.
        """
        self._check(video)
        first, cache = self.encoder(video[:, :1], None)

        def step(cache: Cache, frames: Array) -> tuple[Cache, Array]:
            hidden, cache = self.encoder(frames, cache)
            return cache, hidden

        groups = rearrange(video[:, 1:], "b (n f) h w c -> n b f h w c", f=TEMPORAL_STRIDE)
        _, rest = jax.lax.scan(step, cache, groups)
        rest = rearrange(rest, "n b f h w c -> b (n f) h w c")
        moments = self.to_moments(jnp.concatenate([first, rest], axis=1))
        return self.normalise(moments[..., : self.config.z_dim].astype(jnp.float32))

    def decode(self, latents: Float[Array, "b f h w z"]) -> Float[Array, "b f2 h2 w2 3"]:
        """The video of normalised latents, float32 in [-1, 1], one latent frame at a time."""
        hidden = self.from_latents(self.denormalise(latents.astype(jnp.float32)))
        first, cache = self.decoder(hidden[:, :1], None)

        def step(cache: Cache, frame: Array) -> tuple[Cache, Array]:
            video, cache = self.decoder(frame, cache)
            return cache, video

        _, rest = jax.lax.scan(step, cache, rearrange(hidden[:, 1:], "b n h w c -> n b 1 h w c"))
        rest = rearrange(rest, "n b f h w c -> b (n f) h w c")
        video = jnp.concatenate([first, rest], axis=1).astype(jnp.float32)
        return jnp.clip(video, -1.0, 1.0)

    def normalise(self, mean: Float[Array, "*b z"]) -> Float[Array, "*b z"]:
        """Latents with the configured mean and standard deviation taken out."""
        return (mean - jnp.array(self.config.latent_mean)) / jnp.array(self.config.latent_std)

    def denormalise(self, latents: Float[Array, "*b z"]) -> Float[Array, "*b z"]:
        """The inverse of `normalise`."""
        return latents * jnp.array(self.config.latent_std) + jnp.array(self.config.latent_mean)

    def _check(self, video: Array) -> None:
        _, frames, height, width, _ = video.shape
        check_frame_count(frames)
        if height % SPATIAL_STRIDE or width % SPATIAL_STRIDE:
            raise InputError(
                f"A video of {height} x {width} pixels cannot be encoded: rows and columns must "
                f"be multiples of {SPATIAL_STRIDE}. Resize or crop it."
            )


def standardise_latents(vae: WanVAE, mean: Float[Any, " z"], std: Float[Any, " z"]) -> None:
    """Fold a measured latent mean and deviation into the two quantisation convolutions.

    `mean` and `std` are those of the means that `moments` gives over a data set. Afterwards
    these have mean 0 and deviation 1, the log variances shrink by 2 log std, and decoding what
    is encoded gives the same video as before.
    """
    encode, decode = vae.to_moments, vae.from_latents
    encode_bias, decode_bias = cast(nnx.Param, encode.bias), cast(nnx.Param, decode.bias)
    scale = jnp.concatenate([1 / std, jnp.ones_like(std)])
    shift = jnp.concatenate([-mean / std, -2 * jnp.log(std)])
    encode.kernel[...] = encode.kernel[...] * scale
    encode_bias[...] = encode_bias[...] * scale + shift
    decode_bias[...] = decode_bias[...] + mean @ decode.kernel[...]
    decode.kernel[...] = std[:, None] * decode.kernel[...]
