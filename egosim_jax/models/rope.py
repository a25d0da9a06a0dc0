"""Rotary position embedding over frames, rows and columns.

A head of size k holds k/2 pairs (x_2j, x_2j+1), read as complex numbers. A token at frame f, row r
and column c turns its first pairs by f·w_i, the next k//6 by r·w_i and the last k//6 by c·w_i,
with w_i = 10000^(-i/p) for the p pairs of that axis. Queries and keys turned this way meet in a
product that depends only on the difference of their positions. (Wan 2.1: 22, 21 and 21 pairs of
a head of 128.)
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from einops import rearrange
from jaxtyping import Array, Float

THETA = 10000.0


def pairs(head_dim: int) -> tuple[int, int, int]:
    """How many of a head's pairs turn with the frame, the row and the column."""
    side = head_dim // 6
    return head_dim // 2 - 2 * side, side, side


def rotations(frames: int, rows: int, columns: int, head_dim: int) -> Float[Array, "n p 2"]:
    """The (cosine, sine) of every pair at every token, in row-major order (frame, row, column).

    Angles are taken in float64 on the host; only one small table per axis enters the program.
    """
    size = (frames, rows, columns)
    parts = []
    for axis, p in enumerate(pairs(head_dim)):
        angle = np.arange(size[axis])[:, None] * THETA ** (-np.arange(p) / p)
        table = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
        shape = [1, 1, 1, p, 2]
        shape[axis] = size[axis]
        parts.append(jnp.broadcast_to(table.reshape(shape), (*size, p, 2)))
    return rearrange(jnp.concatenate(parts, axis=3), "f r c p two -> (f r c) p two")


def rotate(x: Float[Array, "b n h k"], rotation: Float[Array, "n p 2"]) -> Float[Array, "b n h k"]:
    """Turn the pairs of every head by their token's angles, in float32."""
    x = rearrange(x.astype(jnp.float32), "b n h (p two) -> b n h p two", two=2)
    cos, sin = rotation[:, None, :, :1], rotation[:, None, :, 1:]
    turned = x * cos + x[..., ::-1] * jnp.concatenate([-sin, sin], axis=-1)
    return rearrange(turned, "b n h p two -> b n h (p two)")
