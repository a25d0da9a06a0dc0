"""Convolutional layer of video autoencoders, over space or over space and time."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Float

from egosim_jax.models.causal_conv import convolve
from egosim_jax.models.layers import Initializer, lecun_normal
from egosim_jax.types import InputError


class Conv(nnx.Module):
    """Convolution with bias; kernel `[h, w, in, out]` or, over time too, `[t, h, w, in, out]`."""

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

    def __call__(self, x: Float[Array, "b f h w i"]) -> Float[Array, "b g h w o"]:
        """Convolve, SAME in space and, with a kernel over time, VALID in time."""
        kernel = self.kernel[...].astype(self.dtype)
        y = convolve(x.astype(self.dtype), kernel if kernel.ndim == 5 else kernel[None])
        return y + self.bias[...].astype(self.dtype)

    def downsample2x(self, x: Float[Array, "b f h w i"]) -> Float[Array, "b f y x o"]:
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


def check_video(video: Array, *, stride: int, check_frames: Callable[[int], None]) -> None:
    """Raise `InputError` unless a video has floats, frames that fit, and whole latent cells."""
    if not jnp.issubdtype(video.dtype, jnp.floating):
        raise InputError(
            f"A video of {video.dtype} cannot be encoded: values must be floats from -1 to 1. "
            "For uint8 frames: frames / 127.5 - 1."
        )
    _, frames, height, width, _ = video.shape
    check_frames(frames)
    if height % stride or width % stride:
        raise InputError(
            f"A video of {height} x {width} pixels cannot be encoded: rows and columns must "
            f"be multiples of {stride}. Resize or crop it."
        )
