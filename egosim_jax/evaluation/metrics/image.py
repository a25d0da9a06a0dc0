"""PSNR and SSIM of uint8 RGB videos, color drift, and color fitting of a baseline.

The PSNR of a frame is 10 log10(255^2 / MSE), with the MSE over all pixels and channels. A frame
equal to its reference counts as 100 dB instead of infinity. The PSNR of a video is the mean over
frames. DWM instead reports the PSNR of one MSE over all frames, as computed by torchmetrics.

SSIM (Wang et al. 2004) compares means, variances and the covariance under an 11 x 11 Gaussian
window of sigma 1.5, whose weights sum to one:

    (2 mu_a mu_b + C1) (2 cov_ab + C2) / ((mu_a^2 + mu_b^2 + C1) (var_a + var_b + C2))

with C1 = (0.01 * 255)^2 and C2 = (0.03 * 255)^2. It is computed per channel, averaged over the
windows inside the frame (no padding), then over channels and frames.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from einops import rearrange
from jaxtyping import Array, Float, UInt8

from egosim_jax.evaluation.metrics.batches import Batches, check_same_shape

MAX_PSNR = 100.0
"""PSNR in dB of equal frames."""
MAX_PIXELS = 1 << 23
"""Maximum number of pixels in a batch on an accelerator."""
_GRAY = 127.5
_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2


def psnr(
    video: UInt8[np.ndarray, "f h w 3"], reference: UInt8[np.ndarray, "f h w 3"]
) -> Float[np.ndarray, " f"]:
    """Return the PSNR of every frame in dB, at most `MAX_PSNR`."""
    errors = np.array(
        [
            np.square(frame.astype(np.float32) - other).mean(dtype=np.float64)
            for frame, other in zip(video, reference, strict=True)
        ]
    )
    return decibels(errors)


def clip_psnr(frame_psnr: Float[np.ndarray, " f"]) -> float:
    """Return the PSNR in dB of one MSE over all frames, given the PSNR of each frame.

    A frame equal to its reference counts as 100 dB.
    """
    return float(-10 * np.log10(np.mean(10 ** (-np.asarray(frame_psnr) / 10))))


def color_drift(
    video: UInt8[np.ndarray, "f h w 3"], reference: UInt8[np.ndarray, "f h w 3"]
) -> Float[np.ndarray, "f 3"]:
    """Return the mean RGB of each frame minus the reference's, in levels of 255."""
    return mean_colors(video) - mean_colors(reference)


def mean_colors(video: UInt8[np.ndarray, "f h w 3"]) -> Float[np.ndarray, "f 3"]:
    """Return the mean RGB of every frame, in levels of 255."""
    return np.stack([frame.reshape(-1, 3).mean(axis=0) for frame in video])


def decibels(errors: Float[Any, "*n"]) -> Any:
    """Return the PSNR in dB of mean squared errors, at most `MAX_PSNR`."""
    floor = 255**2 / 10 ** (MAX_PSNR / 10)
    return 10 * np.log10(255**2 / np.maximum(errors, floor))


def ssim(
    video: UInt8[np.ndarray, "f h w 3"], reference: UInt8[np.ndarray, "f h w 3"]
) -> Float[np.ndarray, " f"]:
    """Return the SSIM of each frame; frames need at least 11 pixels in height and width."""
    check_same_shape(video, reference)
    count, height, width, _ = video.shape
    alone = jax.default_backend() == "cpu"  # single frames fit the CPU caches
    batches = Batches(count, 1 if alone else MAX_PIXELS // (height * width))
    values = []
    for frames, others in zip(batches.of(video), batches.of(reference), strict=True):
        moments, center = _moments(frames, others)
        values.append(_similarity(_blur(_blur(moments, axis=2), axis=3), center))
    return batches.join(values).astype(float)


def fit_colors(
    video: UInt8[np.ndarray, "f h w 3"], reference: UInt8[np.ndarray, "f h w 3"]
) -> UInt8[np.ndarray, "f h w 3"]:
    """Return a video whose colors are fitted to a reference.

    One affine map (3 x 4) for the clip is fitted by least squares over all pixels.
    """
    gram, moment = np.zeros((4, 4)), np.zeros((4, 3))
    for frame, other in zip(video, reference, strict=True):
        sums = _normal_equations(frame, other)
        gram, moment = gram + np.asarray(sums[0]), moment + np.asarray(sums[1])
    matrix = np.linalg.lstsq(gram, moment)[0].astype(np.float32)
    return np.stack([np.asarray(_map_colors(frame, matrix)) for frame in video])


@jax.jit
def _normal_equations(
    a: UInt8[Array, "h w 3"], b: UInt8[Array, "h w 3"]
) -> tuple[Float[Array, "4 4"], Float[Array, "4 3"]]:
    colors = _with_one(a)
    return colors.T @ colors, colors.T @ (_with_one(b)[:, :3])


@jax.jit
def _map_colors(frame: UInt8[Array, "h w 3"], matrix: Float[Array, "4 3"]) -> UInt8[Array, "h w 3"]:
    mapped = jnp.rint(_with_one(frame) @ matrix + _GRAY)
    return jnp.clip(mapped, 0, 255).astype(jnp.uint8).reshape(frame.shape)


def _with_one(frame: UInt8[Array, "h w 3"]) -> Float[Array, "n 4"]:
    """Return centered colors and a one for each pixel."""
    colors = rearrange(frame, "h w c -> (h w) c").astype(jnp.float32) - _GRAY
    return jnp.concatenate([colors, jnp.ones((len(colors), 1))], axis=1)


@jax.jit
def _moments(
    a: UInt8[Array, "b h w c"], b: UInt8[Array, "b h w c"]
) -> tuple[Float[Array, "b 4 h w c"], Float[Array, "b 1 1 1"]]:
    """Return a, b, a b and a^2 + b^2 of values centered per frame, and the subtracted constant.

    Variances are small differences of large squares: float32 is exact enough only after the mean of
    the frames is subtracted.
    """
    a, b = a.astype(jnp.float32), b.astype(jnp.float32)
    mean = (a + b).mean(axis=(1, 2, 3), keepdims=True)
    center = jnp.rint(mean / 2)
    a, b = a - center, b - center
    return jnp.stack([a, b, a * b, a * a + b * b], axis=1), center


@functools.partial(jax.jit, static_argnames="axis")
def _blur(x: Float[Array, "b 4 _ _ c"], *, axis: int) -> Float[Array, "b 4 _ _ c"]:
    """Apply the Gaussian window along one axis, only where it is inside the frame.

    Each pass is a separate jitted call: in one program, XLA would recompute the first pass for each
    tap of the second.
    """
    offsets = np.arange(_WINDOW) - _WINDOW // 2
    weights = np.exp(-(offsets**2) / (2 * _SIGMA**2))
    places = x.shape[axis] - _WINDOW + 1
    taps = [
        float(weight) * jax.lax.slice_in_dim(x, k, k + places, axis=axis)
        for k, weight in enumerate(weights / weights.sum())
    ]
    return functools.reduce(jnp.add, taps)


@jax.jit
def _similarity(
    blurred: Float[Array, "b 4 h w c"], center: Float[Array, "b 1 1 1"]
) -> Float[Array, " b"]:
    """Return the mean SSIM over windows and channels."""
    mu_a, mu_b, product, squares = (blurred[:, number] for number in range(4))
    covariance = product - mu_a * mu_b
    variances = squares - mu_a**2 - mu_b**2
    mu_a, mu_b = mu_a + center, mu_b + center
    above = (2 * mu_a * mu_b + _C1) * (2 * covariance + _C2)
    ratio = above / ((mu_a**2 + mu_b**2 + _C1) * (variances + _C2))
    return ratio.mean(axis=(1, 2, 3))
