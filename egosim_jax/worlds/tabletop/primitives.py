"""Meshes of simple shapes, by Open3D: vertices and triangles, counterclockwise from outside."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.runtime.open3d import load_open3d

Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Vertices, and the vertex indices of each triangle."""


def cuboid(size: Float[np.ndarray, " 3"]) -> Mesh:
    """Return the mesh of a box from the origin to the corner `size`."""
    return _arrays(_shapes().create_box(*size))


def sphere(radius: float, resolution: int) -> Mesh:
    """Return the mesh of a sphere about the origin with `resolution` bands of latitude."""
    return _arrays(_shapes().create_sphere(radius, resolution))


def cylinder(radius: float, height: float, resolution: int) -> Mesh:
    """Return the mesh of an upright cylinder about the origin with `resolution` sides."""
    return _arrays(_shapes().create_cylinder(radius, height, resolution, 1))


def cone(radius: float, height: float, resolution: int) -> Mesh:
    """Return the mesh of an upright cone on the origin with `resolution` sides."""
    return _arrays(_shapes().create_cone(radius, height, resolution, 1))


def torus(radius: float, tube: float, around: int, across: int) -> Mesh:
    """Return the mesh of a torus about the z axis; `tube` is the radius of its tube."""
    return _arrays(_shapes().create_torus(radius, tube, around, across))


def _shapes() -> Any:
    return load_open3d().geometry.TriangleMesh


def _arrays(mesh: Any) -> Mesh:
    return np.array(mesh.vertices), np.array(mesh.triangles, int)
