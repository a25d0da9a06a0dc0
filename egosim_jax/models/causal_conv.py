"""Convolution of a causal video network, in the form that each backend computes fastest.

    y[t, p] = sum_(k, s) x[t + k, p + s] W[k, s]        VALID in time, SAME in space

The caller puts the frames of the past in front of `x`. TPUs have a kernel for it. cuDNN turns
videos into another layout and back, and XLA's CPU backend has a good kernel for images only, so
that there the sum over k is one over images: of convolutions or, where x has few channels, of
channels, with the frames' channels side by side. The CPU is also slow at the gradient

    dW[k, s] = sum_(t, p) x[t + k, p + s] dy[t, p]

which is computed here as a product of matrices, one frame of x at a time: its shifted copies side
by side times the frames of dy that it reaches.
"""

from __future__ import annotations

from functools import reduce
from operator import add

import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Float

from egosim_jax.sharding import platform

FEW_CHANNELS = 8
"""Up to this many input channels, the CPU puts the frames' channels side by side."""


def convolve(
    x: Float[Array, "b f h w i"], kernel: Float[Array, "kt kh kw i o"]
) -> Float[Array, "b g h w o"]:
    """Convolve a video with a kernel of odd height and width; g = f - kt + 1 frames."""
    return {"cpu": by_image, "gpu": sum_of_images, "tpu": direct}[platform()](x, kernel)


def direct(
    x: Float[Array, "b f h w i"], kernel: Float[Array, "kt kh kw i o"]
) -> Float[Array, "b g h w o"]:
    """`convolve` as one 3D convolution."""
    _, height, width, _, _ = kernel.shape
    padding = ((0, 0), (height // 2, height // 2), (width // 2, width // 2))
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1, 1), padding, dimension_numbers=("NDHWC", "DHWIO", "NDHWC")
    )


def sum_of_images(
    x: Float[Array, "b f h w i"], kernel: Float[Array, "kt kh kw i o"]
) -> Float[Array, "b g h w o"]:
    """`convolve` as 2D convolutions, with the gradient that they have."""
    taps = kernel.shape[0]
    frames = x.shape[1] - taps + 1
    reached = [rearrange(x[:, k : k + frames], "b f h w i -> (b f) h w i") for k in range(taps)]
    if x.shape[-1] <= FEW_CHANNELS:
        reached = [jnp.concatenate(reached, axis=-1)]
        kernel = rearrange(kernel, "t h w i o -> 1 h w (t i) o")
    terms = [
        jax.lax.conv_general_dilated(
            images, tap, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        for images, tap in zip(reached, kernel, strict=True)
    ]
    return rearrange(reduce(add, terms), "(b f) h w o -> b f h w o", b=x.shape[0])


@jax.custom_vjp
def by_image(
    x: Float[Array, "b f h w i"], kernel: Float[Array, "kt kh kw i o"]
) -> Float[Array, "b g h w o"]:
    """`sum_of_images` with a faster gradient, in reverse mode only."""
    return sum_of_images(x, kernel)


def _forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return sum_of_images(x, kernel), (x, kernel)


def _backward(saved: tuple[Array, Array], dy: Array) -> tuple[Array, Array]:
    x, kernel = saved
    past = kernel.shape[0] - 1
    padded = jnp.pad(dy, ((0, 0), (past, past), (0, 0), (0, 0), (0, 0)))
    flipped = rearrange(kernel[::-1, ::-1, ::-1], "t h w i o -> t h w o i")
    return sum_of_images(padded, flipped), _kernel_gradient(x, padded, kernel)


by_image.defvjp(_forward, _backward)


def _kernel_gradient(x: Array, dy: Array, kernel: Array) -> Array:
    """Return the sum over t and p; `dy` with kt - 1 frames of zeros before and after."""
    taps, rows, columns, _, _ = kernel.shape
    frames, height, width = x.shape[1:4]
    x = jnp.pad(x, ((0, 0), (0, 0), (rows // 2,) * 2, (columns // 2,) * 2, (0, 0)))
    reaching = jnp.stack([dy[:, taps - 1 - k :][:, :frames] for k in range(taps)], axis=-2)

    def step(total: Array, frame: tuple[Array, Array]) -> tuple[Array, None]:
        image, dy = frame
        shifted = jnp.concatenate(
            [image[i : i + height, j : j + width] for i in range(rows) for j in range(columns)],
            axis=-1,
        )
        left = rearrange(shifted, "h w c -> (h w) c")
        right = rearrange(dy, "h w t o -> (h w) (t o)")
        return total + jnp.matmul(left.T, right, preferred_element_type=jnp.float32), None

    xs = (rearrange(x, "b f ... -> (b f) ..."), rearrange(reaching, "b f ... -> (b f) ..."))
    start = jnp.zeros((rows * columns * x.shape[-1], taps * dy.shape[-1]), jnp.float32)
    total, _ = jax.lax.scan(step, start, xs)
    names = {"h": rows, "w": columns, "t": taps}
    return rearrange(total, "(h w i) (t o) -> t h w i o", **names).astype(kernel.dtype)
