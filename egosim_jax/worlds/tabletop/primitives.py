"""Meshes of simple shapes: vertices and triangles, counterclockwise from outside.

The C library gives sines and cosines: numpy's vectorized ones differ between processors, and a seed
must give the same pixels everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Vertices, and the vertex indices of each triangle."""


def cuboid(size: Float[np.ndarray, " 3"]) -> Mesh:
    """Return the mesh of a box from the origin to the corner `size`."""
    corners = np.array([(k & 1, k >> 2, k >> 1 & 1) for k in range(8)])
    faces = [(4, 7, 5), (4, 6, 7), (0, 2, 4), (2, 6, 4), (0, 1, 2), (1, 3, 2),
             (1, 5, 7), (1, 7, 3), (2, 3, 7), (2, 7, 6), (0, 4, 1), (1, 4, 5)]  # fmt: skip
    return corners * size, np.array(faces)


def sphere(radius: float, resolution: int) -> Mesh:
    """Return the mesh of a sphere about the origin with `resolution` bands of latitude."""
    angles = [math.pi / resolution * k for k in range(1, resolution)]
    rings = [(math.sin(angle), math.cos(angle)) for angle in angles]
    vertices, triangles = _revolve(rings, (1.0, -1.0), 2 * resolution)
    return vertices * radius, triangles


def cylinder(radius: float, height: float, resolution: int) -> Mesh:
    """Return the mesh of an upright cylinder about the origin with `resolution` sides."""
    top = height / 2
    return _revolve([(radius, top), (radius, -top)], (top, -top), resolution)


def cone(radius: float, height: float, resolution: int) -> Mesh:
    """Return the mesh of an upright cone on the origin with `resolution` sides."""
    vertices, triangles = _revolve([(radius, 0.0)], (0.0, height), resolution)
    return vertices, triangles[:, [0, 2, 1]]  # its first pole is the lower one


def torus(radius: float, tube: float, around: int, across: int) -> Mesh:
    """Return the mesh of a torus about the z axis; `tube` is the radius of its tube."""
    circle, section = _circle(around), _circle(across)
    flat = radius * circle[:, None] + tube * section[:, 0][None, :, None] * circle[:, None]
    height = np.broadcast_to(tube * section[:, 1], (around, across))
    vertices = np.concatenate([flat, height[..., None]], axis=-1).reshape(-1, 3)
    here = np.arange(around * across).reshape(around, across)
    ahead = np.roll(here, -1, axis=0)
    beyond = np.roll(ahead, -1, axis=1)
    pairs = [(ahead, beyond, here), (here, beyond, np.roll(here, -1, axis=1))]
    return vertices, np.stack([np.stack(pair, -1) for pair in pairs], axis=2).reshape(-1, 3)


def _revolve(rings: Sequence[tuple[float, float]], poles: tuple[float, float], sides: int) -> Mesh:
    """Return the mesh of a solid of revolution about z.

    `rings` has radius and z of each ring from the first pole to the second, `poles` their z.
    """
    circle = _circle(sides)
    ends = [(0.0, 0.0, z) for z in poles]
    levels = [np.column_stack([circle * radius, np.full(sides, z)]) for radius, z in rings]
    index = 2 + np.arange(len(rings) * sides).reshape(len(rings), sides)
    after = np.roll(index, -1, axis=1)
    first, second = np.zeros_like(index[0]), np.ones_like(index[0])
    caps = [(first, index[0], after[0]), (second, after[-1], index[-1])]
    faces = [np.stack([np.stack(cap, -1) for cap in caps], axis=1).reshape(-1, 3)]
    upper, lower, upper_after, lower_after = index[:-1], index[1:], after[:-1], after[1:]
    bands = [(lower, upper_after, upper), (lower, lower_after, upper_after)]
    faces.append(np.stack([np.stack(band, -1) for band in bands], axis=2).reshape(-1, 3))
    return np.concatenate([ends, *levels]), np.concatenate(faces)


def _circle(sides: int) -> Float[np.ndarray, "n 2"]:
    """Return cosine and sine of equally spaced angles."""
    angles = [2 * math.pi / sides * k for k in range(sides)]
    return np.array([(math.cos(angle), math.sin(angle)) for angle in angles])
