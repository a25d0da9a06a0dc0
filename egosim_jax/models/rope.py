"""Rotary position embedding over frames, rows and columns.

A head of size k holds k/2 pairs (x_2j, x_2j+1), read as complex numbers. A token at frame f, row r
and column c rotates its first pairs by f·w_i, the next k//6 by r·w_i and the last k//6 by c·w_i,
with w_i = 10000^(-i/p) for the p pairs of that axis. The product of a query and a key then depends
only on the difference of their positions. (Wan 2.1: 22, 21 and 21 pairs of
a head of 128.)
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from einops import rearrange
from jaxtyping import Array, Float

THETA = 10000.0


def pairs(head_dim: int) -> tuple[int, int, int]:
    """Return the numbers of a head's pairs that rotate with the frame, the row and the column."""
    side = head_dim // 6
    return head_dim // 2 - 2 * side, side, side


def rotations(
    frames: int, rows: int, columns: int, head_dim: int, *, side: int = 1
) -> Float[Array, "n k 2"]:
    """Return the rotations of tokens at whole positions, in the order (frame, row, column).

    Tokens with a larger `side`, in rows and columns, are at the middle of the tokens they replace.
    """
    f, r, c = (np.arange(size, dtype=float) for size in (frames, rows, columns))
    r, c = (side * p + (side - 1) / 2 for p in (r, c))
    return rotations_at((f, r, c), pairs(head_dim))


def rotations_at(
    positions: tuple[np.ndarray, np.ndarray, np.ndarray], split: tuple[int, int, int]
) -> Float[Array, "n k 2"]:
    """Return the cosine and sine of each channel of a head, by token in the order (f, r, c).

    `positions` are the coordinates of frames, rows and columns, and `split` is the number of pairs
    that rotate with each. Channels x_2j and x_2j+1 have the same cosine c; their sines are -s and
    s: a rotated channel is its own value times the cosine, plus the other channel of the pair times
    the sine. Angles are computed in float64 on the host; only one small table per axis enters the
    program.
    """
    size = tuple(len(p) for p in positions)
    parts = []
    for axis, p in enumerate(split):
        angle = positions[axis][:, None] * THETA ** (-np.arange(p) / p)
        c, s = np.cos(angle), np.sin(angle)
        table = np.stack([c, -s, c, s], axis=-1).astype(np.float32)
        shape = [1, 1, 1, 2 * p, 2]
        shape[axis] = size[axis]
        parts.append(jnp.broadcast_to(table.reshape(shape), (*size, 2 * p, 2)))
    return rearrange(jnp.concatenate(parts, axis=3), "f r c k two -> (f r c) k two")


def rotate(x: Float[Array, "b n h k"], rotation: Float[Array, "n k 2"]) -> Float[Array, "b n h k"]:
    """Turn the pairs of every head by their token's angles, in float32."""
    x = x.astype(jnp.float32)
    other = rearrange(x, "b n h (p two) -> b n h p two", two=2)[..., ::-1].reshape(x.shape)
    return x * rotation[:, None, :, 0] + other * rotation[:, None, :, 1]
