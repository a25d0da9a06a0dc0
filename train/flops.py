"""Model FLOPs of the video transformer.

With N tokens of width d, an MLP of width f, T text and I image tokens and L blocks, a forward has

    self-attention    L (8 N d^2 + 4 N^2 d)
    cross-attention   L (4 N d^2 + 4 (T + I) d^2 + 4 N (T + I) d)
    MLP               L 4 N d f

and the embeddings and the head, counting a multiplication and an addition as two. Norms and
activations do not count, nor does what a backward pass computes again.
"""

from __future__ import annotations

from math import prod
from typing import NamedTuple

from egosim_jax.models.wan.config import PATCH, WanDiTConfig


class Flops(NamedTuple):
    """What a forward takes."""

    weights: float
    """In products with weights."""
    attention: float
    """In products of queries, keys and values."""

    @property
    def total(self) -> float:
        """Both."""
        return self.weights + self.attention


def count_forward(
    config: WanDiTConfig, *, latents: tuple[int, int, int], text: int, image: int
) -> Flops:
    """FLOPs of one forward of one sample: latent frames, rows, columns; text and image tokens."""
    d, f, depth = config.dim, config.ffn_dim, config.layers
    n = prod(latents) // PATCH**2
    image = image if config.image_dim is not None else 0
    block = 12 * n * d**2 + 4 * (text + image) * d**2 + 4 * n * d * f
    embeddings = 2 * n * PATCH**2 * (config.in_channels + config.out_channels) * d
    embeddings += 2 * text * (config.text_dim * d + d**2)
    embeddings += 2 * (config.freq_dim * d + 7 * d**2)
    if config.image_dim is not None:
        embeddings += 2 * image * (config.image_dim**2 + config.image_dim * d)
    return Flops(
        weights=float(depth * block + embeddings),
        attention=float(depth * 4 * n * (n + text + image) * d),
    )
