"""Renderer of shaded meshes in JAX, which draws the same images as `reference`.

With the corners a, b, c of a triangle in camera coordinates, a ray d from the camera leaves them on
one side if d . (b x c), d . (c x a) and d . (a x b) have one sign. Divided by their sum they are
the barycentric coordinates, and d meets the plane at the depth a . (b x c) / sum. Both triangles of
an edge compute the same product, so no ray passes between them.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float32, Int32, UInt8

from egosim_jax.geometry import invert, transform
from egosim_jax.rendering.mesh import AMBIENT, DIFFUSE, MovingMesh, vertex_normals
from egosim_jax.rendering.skeleton import NEAR_M
from egosim_jax.rendering.tiles import (
    Canvas,
    chunks,
    empty_canvas,
    image_of,
    pixel_rays,
    put,
    tiles_of,
)
from egosim_jax.types import Cameras


def draw_mesh(
    mesh: MovingMesh, cameras: Cameras
) -> tuple[UInt8[np.ndarray, "f h w 3"], Float32[np.ndarray, "f h w"]]:
    """Draw a mesh; return the image and its depth, black and infinite off the mesh."""
    tiles = tiles_of(cameras)
    intrinsics = jnp.asarray(cameras.intrinsics_px, jnp.float32)
    frames = []
    for vertices_m, pose in zip(mesh.vertices_m, cameras.world_from_camera, strict=True):
        canvas = empty_canvas(tiles)
        vertices = transform(invert(pose), vertices_m)
        complete = np.isfinite(vertices).all(axis=1)[mesh.triangles].all(axis=1)
        triangles = mesh.triangles[complete]
        normals = vertex_normals(np.where(np.isfinite(vertices), vertices, 0.0), triangles)
        corners = vertices[triangles]
        shapes = {"corners": corners, "normals": normals[triangles]}
        shapes["colors"] = mesh.colors[triangles]
        for chunk in chunks(shapes, corners.min(axis=1), corners.max(axis=1), cameras):
            canvas = _draw_chunk(canvas, **chunk, intrinsics_px=intrinsics, columns=tiles[1])
        frames.append(canvas)
    return image_of(frames, cameras)


@partial(jax.jit, static_argnames="columns", donate_argnames="canvas")
def _draw_chunk(
    canvas: Canvas,
    *,
    tile: Int32[Array, " k"],
    corners: Float32[Array, "k 3 3"],
    normals: Float32[Array, "k 3 3"],
    colors: Float32[Array, "k 3 3"],
    intrinsics_px: Float32[Array, "3 3"],
    columns: int,
) -> Canvas:
    """Draw each triangle into its tile; of equally near ones the first is seen."""
    x, y = pixel_rays(tile, intrinsics_px, columns)
    edges = jnp.cross(jnp.roll(corners, -1, axis=1), jnp.roll(corners, -2, axis=1))
    share = [_dot(x, y, edges[:, k]) for k in range(3)]
    total = share[0] + share[1] + share[2]
    inside = (share[0] >= 0) & (share[1] >= 0) & (share[2] >= 0)
    inside |= (share[0] <= 0) & (share[1] <= 0) & (share[2] <= 0)
    volume = (corners[:, 0] * edges[:, 0]).sum(axis=-1)[:, None, None]
    safe = jnp.where(total == 0, 1, total)
    depth = volume / safe
    met = inside & (total != 0) & (depth >= NEAR_M)
    share = [value / safe for value in share]
    return put(canvas, tile, jnp.where(met, depth, jnp.inf), _shade(x, y, share, normals, colors))


def _dot(
    x: Float32[Array, "k p p"], y: Float32[Array, "k p p"], vector: Float32[Array, "k 3"]
) -> Float32[Array, "k p p"]:
    """Return the products of rays (x, y, 1) with vectors."""
    a, b, c = (vector[:, k, None, None] for k in range(3))
    return x * a + y * b + c


def _shade(
    x: Float32[Array, "k p p"],
    y: Float32[Array, "k p p"],
    share: list[Float32[Array, "k p p"]],
    normals: Float32[Array, "k 3 3"],
    colors: Float32[Array, "k 3 3"],
) -> UInt8[Array, "k p p 3"]:
    """Return the colors of triangles at rays with barycentric coordinates `share`."""
    mix = [[sum(share[k] * v[:, k, c, None, None] for k in range(3)) for c in range(3)]
           for v in (normals, colors)]  # fmt: skip
    (nx, ny, nz), color = mix
    size = jnp.sqrt((nx**2 + ny**2 + nz**2) * (x**2 + y**2 + 1))
    cosine = -(nx * x + ny * y + nz) / jnp.maximum(size, 1e-12)
    light = AMBIENT + DIFFUSE * jnp.maximum(cosine, 0)
    shaded = jnp.clip(jnp.stack(color, axis=-1) * light[..., None], 0, 1)
    return jnp.round(255 * shaded).astype(jnp.uint8)
