"""The renderer in JAX: the same pictures as `reference`, one compiled program for a whole path.

All squares of a given size are the same square moved by whole pixels. So each point goes into one
cell only, that of its first pixel, and the nearest of p x p neighboring cells is what a pixel
sees: p^2 comparisons a pixel instead of p^2 writes a point.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Int32, UInt8

from egosim_jax.geometry import invert, pixel_rays, project, transform
from egosim_jax.rendering.skeleton import (
    BONE_RADIUS_M,
    FAR_M,
    GAMMA,
    JOINT_RADIUS_M,
    NEAR_M,
    SKELETONS,
)
from egosim_jax.types import Cameras, Kind


def splat(
    points_m: Float[Array | np.ndarray, "n 3"], cameras: Cameras, *, point_px: int
) -> tuple[Float32[Array, "f h w"], Int32[Array, "f h w"]]:
    """Depth in meters and number of the point that each pixel sees; infinite and -1 where none."""
    poses, intrinsics = _poses(cameras)
    return _splat(
        points_m, poses, intrinsics, size=(cameras.height, cameras.width), point_px=point_px
    )


def _poses(cameras: Cameras) -> tuple[Float32[Array, "f 4 4"], Float32[Array, "3 3"]]:
    return (
        jnp.asarray(invert(cameras.world_from_camera), jnp.float32),
        jnp.asarray(cameras.intrinsics_px, jnp.float32),
    )


@partial(jax.jit, static_argnames=("size", "point_px"))
def _splat(
    points_m: Float[Array | np.ndarray, "n 3"],
    cameras_from_world: Float32[Array, "f 4 4"],
    intrinsics_px: Float32[Array, "3 3"],
    *,
    size: tuple[int, int],
    point_px: int,
) -> tuple[Float32[Array, "f h w"], Int32[Array, "f h w"]]:
    height, width = size
    margin = point_px - 1  # a square may begin this far outside and still show
    rows, columns = height + margin, width + margin
    count = len(points_m)
    points = points_m.astype(jnp.float32).T

    def frame(camera_from_world: Array) -> tuple[Array, Array]:
        # Written out: as a product of matrices with three columns it takes ten times as long.
        x, y, z = (
            a * points[0] + b * points[1] + c * points[2] + shift
            for a, b, c, shift in camera_from_world[:3]
        )
        u, v = project(intrinsics_px, jnp.stack([x, y, z], axis=-1))
        column = jnp.ceil(u - point_px / 2) + margin
        row = jnp.ceil(v - point_px / 2) + margin
        seen = (z >= NEAR_M) & (z <= FAR_M)
        seen &= (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        nowhere = rows * columns
        cell = jnp.where(seen, row * columns + column, nowhere).astype(jnp.int32)
        nearest = jnp.full(nowhere + 1, jnp.inf).at[cell].min(z)
        first = jnp.where(z <= nearest[cell], cell, nowhere)
        number = jnp.full(nowhere + 1, count, jnp.int32).at[first].min(jnp.arange(count))
        return _nearest_square(
            nearest[:-1].reshape(rows, columns), number[:-1].reshape(rows, columns), point_px
        )

    depth, number = jax.lax.map(frame, cameras_from_world)
    return depth, jnp.where(jnp.isfinite(depth), number, -1)


def _nearest_square(
    depth: Float32[Array, "r c"], number: Int32[Array, "r c"], point_px: int
) -> tuple[Float32[Array, "h w"], Int32[Array, "h w"]]:
    """The nearest, or of equally near ones the first, of the p x p cells that reach each pixel."""
    height, width = (extent - point_px + 1 for extent in depth.shape)
    best = depth[:height, :width], number[:height, :width]
    for down in range(point_px):
        for right in range(point_px):
            window = slice(down, down + height), slice(right, right + width)
            z, n = depth[window], number[window]
            closer = (z < best[0]) | ((z == best[0]) & (n < best[1]))
            best = jnp.where(closer, z, best[0]), jnp.where(closer, n, best[1])
    return best


@partial(jax.jit, static_argnames="gamma")
def paint(
    index: Int[Array | np.ndarray, "f h w"],
    colors: UInt8[Array | np.ndarray, "n 3"],
    *,
    gamma: bool,
) -> UInt8[Array, "f h w 3"]:
    """The picture of the points that are seen, black where there are none."""
    colors = jnp.asarray(GAMMA)[colors] if gamma else jnp.asarray(colors)
    return jnp.where(index[..., None] < 0, jnp.uint8(0), colors[index])


@partial(jax.jit, static_argnames="dilate")
def unobserved(
    index: Int[Array | np.ndarray, "f h w"], *, dilate: bool = False
) -> UInt8[Array, "f h w"]:
    """The mask: 255 where no point is seen; what is drawn may be widened by a pixel."""
    drawn = jnp.asarray(index) >= 0
    if dilate:
        drawn = jax.lax.reduce_window(
            drawn, False, jax.lax.bitwise_or, (1, 3, 3), (1, 1, 1), "SAME"
        )
    return jnp.where(drawn, 0, 255).astype(jnp.uint8)


def draw_hands(
    joints_m: Float[np.ndarray, "f n j 3"], cameras: Cameras, *, kind: Kind
) -> tuple[UInt8[Array, "f h w 3"], Float32[Array, "f h w"]]:
    """Picture and depth of n hands, black and infinite where there are none."""
    poses, _ = _poses(cameras)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    return _draw(jnp.asarray(joints_m, jnp.float32), poses, jnp.asarray(rays, jnp.float32), kind)


@partial(jax.jit, static_argnames="kind")
def _draw(
    joints_m: Float32[Array, "f n j 3"],
    cameras_from_world: Float32[Array, "f 4 4"],
    rays: Float32[Array, "h w 3"],
    kind: Kind,
) -> tuple[UInt8[Array, "f h w 3"], Float32[Array, "f h w"]]:
    skeleton = SKELETONS[kind]
    joint = np.arange(len(skeleton.colors))
    starts = np.concatenate([joint, skeleton.bones[:, 0]])
    ends = np.concatenate([joint, skeleton.bones[:, 1]])
    radii = np.where(starts == ends, JOINT_RADIUS_M, BONE_RADIUS_M).astype(np.float32)

    def frame(inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        joints, camera_from_world = inputs
        present = jnp.isfinite(joints).all(axis=(1, 2))
        local = transform(camera_from_world, joints)
        count = len(joints) * len(starts)
        shapes = (
            local[:, starts].reshape(count, 3),
            local[:, ends].reshape(count, 3),
            jnp.tile(radii, len(joints)),
            jnp.tile(jnp.asarray(skeleton.colors)[ends], (len(joints), 1)),
            jnp.repeat(present, len(starts)),
        )

        def draw(seen: tuple[Array, Array], shape: tuple[Array, ...]) -> tuple[tuple, None]:
            picture, depth = seen
            start, end, radius, color, here = shape
            met = _meet(rays, start, end, radius)
            nearer = here & (met < depth)
            picture = jnp.where(nearer[..., None], color, picture)
            return (picture, jnp.where(nearer, met, depth)), None

        empty = jnp.zeros(rays.shape, jnp.uint8), jnp.full(rays.shape[:2], jnp.inf)
        return jax.lax.scan(draw, empty, shapes)[0]

    return jax.lax.map(frame, (joints_m, cameras_from_world))


def _meet(
    rays: Float32[Array, "h w 3"],
    start: Float32[Array, " 3"],
    end: Float32[Array, " 3"],
    radius: Float32[Array, ""],
) -> Float32[Array, "h w"]:
    """Depth at which rays with z = 1 enter a sphere (start = end) or a tube, else infinity."""
    along = end - start
    length = jnp.sqrt(along @ along)
    axis = along / jnp.where(length > 0, length, 1)
    across = rays - (rays @ axis)[..., None] * axis
    offset = start - (start @ axis) * axis
    a = (across**2).sum(axis=-1)
    # The nearest point of each ray to the axis first: b^2 - a c would cancel in float32.
    b = across @ offset
    gap = offset - (b / a)[..., None] * across
    discriminant = radius**2 - (gap**2).sum(axis=-1)
    t = (b - jnp.sqrt(jnp.maximum(discriminant, 0) * a)) / a
    place = (t[..., None] * rays - start) @ axis
    hit = (discriminant >= 0) & (t >= NEAR_M) & (place >= 0) & (place <= length)
    return jnp.where(hit, t, jnp.inf)
