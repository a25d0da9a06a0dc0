"""The convolution of a causal video network, in the form that each backend computes fastest.

    y[t, p] = sum_(k, s) x[t + k, p + s] W[k, s]        VALID in time, SAME in space

The caller puts the frames of the past in front of `x`. GPUs and TPUs have a kernel for it. XLA's
CPU backend has a good one for images only, so that there the sum over k is taken over images: as a
sum of convolutions or, where x has few channels, as one convolution of the 3 frames' channels
side by side. For large images it is also poor at the gradient

    dW[k, s] = sum_(t, p) x[t + k, p + s] dy[t, p]

which is computed here as a product of matrices, one frame of x at a time: its shifted copies side
by side, against the frames of dy that it reaches. `tests/benchmarks/bench_causal_conv.py` has the
times of all forms.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from einops import rearrange
from jaxtyping import Array, Float

FEW_CHANNELS = 8
"""Up to this many input channels, the CPU convolves all frames' channels at once."""
LARGE_IMAGE = 32 * 32
"""From this many pixels on, the CPU computes the kernel's gradient as a product of matrices."""


def convolve(
    x: Float[Array, "b f h w i"], kernel: Float[Array, "kt kh kw i o"]
) -> Float[Array, "b g h w o"]:
    """Convolve a video with a kernel of odd rows and columns; g = f - kt + 1, but at least 0."""
    return by_image(x, kernel) if jax.default_backend() == "cpu" else direct(x, kernel)


def direct(
    x: Float[Array, "b f h w i"], kernel: Float[Array, "kt kh kw i o"]
) -> Float[Array, "b g h w o"]:
    """`convolve` as one 3D convolution of XLA's."""
    _, rows, columns, _, _ = kernel.shape
    padding = ((0, 0), (rows // 2, rows // 2), (columns // 2, columns // 2))
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1, 1), padding, dimension_numbers=("NDHWC", "DHWIO", "NDHWC")
    )


@jax.custom_vjp
def by_image(
    x: Float[Array, "b f h w i"], kernel: Float[Array, "kt kh kw i o"]
) -> Float[Array, "b g h w o"]:
    """`convolve` as 2D convolutions; differentiable in reverse mode only."""
    taps = kernel.shape[0]
    frames = max(0, x.shape[1] - taps + 1)
    reached = [rearrange(x[:, k : k + frames], "b f h w i -> (b f) h w i") for k in range(taps)]
    if x.shape[-1] <= FEW_CHANNELS:
        images = jnp.concatenate(reached, axis=-1)
        y = _convolve_images(images, rearrange(kernel, "t h w i o -> h w (t i) o"))
    else:
        y = sum(map(_convolve_images, reached, kernel))
    return rearrange(y, "(b f) h w o -> b f h w o", b=x.shape[0])


def _convolve_images(x: Array, kernel: Array) -> Array:
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def _forward(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return by_image(x, kernel), (x, kernel)


def _backward(saved: tuple[Array, Array], dy: Array) -> tuple[Array, Array]:
    x, kernel = saved
    past = kernel.shape[0] - 1
    dy = jnp.pad(dy, ((0, 0), (past, past), (0, 0), (0, 0), (0, 0)))
    dx = by_image(dy, rearrange(kernel[::-1, ::-1, ::-1], "t h w i o -> t h w o i"))
    if x.shape[2] * x.shape[3] < LARGE_IMAGE:
        
    return dx, _kernel_gradient(x, dy, kernel)


by_image.defvjp(_forward, _backward)
