"""Renderer in JAX, the default; it draws the same images as `reference`.

Points: all squares of one size are the same square at integer offsets. So each point is written
into one cell only, the cell of its first pixel. A pixel sees the nearest of p x p
neighboring cells: p^2 comparisons per pixel instead of p^2 writes per point.

Hands: a shape is intersected only with the rays of the tiles that its bounding box meets.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int, Int32, UInt8

from egosim_jax.geometry import invert, project, transform
from egosim_jax.rendering.mesh_jitted import draw_mesh as draw_mesh
from egosim_jax.rendering.reference import (
    GAP_MARGIN_PX,
    Paths,
    add_margin,
    check_visible,
    paths_of,
)
from egosim_jax.rendering.skeleton import (
    BONE_RADIUS_M,
    FAR_M,
    GAMMA,
    JOINT_RADIUS_M,
    NEAR_M,
    SKELETONS,
)
from egosim_jax.rendering.tiles import (
    Canvas,
    chunks,
    empty_canvas,
    image_of,
    pixel_rays,
    put,
    tiles_of,
)
from egosim_jax.types import Cameras, Kind, Motion, SceneState, View

_FARTHEST = np.uint64(np.float32(np.inf).view(np.uint32)) << np.uint64(32)
"""Key of a cell that no point is written into, without its number."""


def render(
    state: SceneState, cameras: Cameras, *, point_px: int, motion: Motion | None = None
) -> View:
    """Render a state along a camera path, as `reference.render` does.

    Raises `InputError` if the first frame shows no point.
    """
    # Pad to one of a few counts, so that a growing state rarely recompiles.
    count = len(state.points_m)
    block = 1 << max(count.bit_length() - 3, 12)
    missing = -count % block
    points = np.pad(state.points_m, ((0, missing), (0, 0)), constant_values=np.nan)
    paths = [(np.pad(moves, (0, missing)), path) for moves, path in paths_of(state, motion)]
    depth_m, index = _seen_points(points, cameras, point_px, paths)
    check_visible(np.asarray(index[0]), count)
    drawn = index
    if paths:
        _, before = _seen_points(points, cameras, point_px, ())
        drawn = jnp.where(index < 0, before, index)
    colors = np.pad(state.colors, ((0, missing), (0, 0)))
    ids = np.pad(state.object_ids, (0, missing))
    return View(
        frames=np.asarray(paint(drawn, colors, gamma=False)),
        mask=np.asarray(unobserved(drawn, dilate=True)),
        depth_m=np.asarray(depth_m),
        object_ids=np.asarray(_identify(index, ids)),
    )


def _seen_points(
    points_m: Float[np.ndarray, "n 3"], cameras: Cameras, point_px: int, paths: Paths
) -> tuple[Float32[Array, "f h w"], Int32[Array, "f h w"]]:
    """Return depth and index of the point seen by each pixel, with gaps closed (`splat`)."""
    if point_px == 1:
        return close_gaps(*splat(points_m, add_margin(cameras), point_px=1, paths=paths))
    return splat(points_m, cameras, point_px=point_px, paths=paths)


@jax.jit
def _identify(index: Int[Array, "f h w"], object_ids: Int32[Array, " n"]) -> Int32[Array, "f h w"]:
    """Return the object id of the point that each pixel sees; 0 where no point is visible."""
    return jnp.where(index < 0, 0, object_ids[index])


def splat(
    points_m: Float[Array | np.ndarray, "n 3"],
    cameras: Cameras,
    *,
    point_px: int,
    paths: Paths = (),
) -> tuple[Float32[Array, "f h w"], Int32[Array, "f h w"]]:
    """Return depth in meters and index of the point seen by each pixel; infinite and -1 if none.

    `paths` moves points.
    """
    moving = None
    cameras_from_world = invert(cameras.world_from_camera).astype(np.float64)
    if paths:
        # Padded to a power of two, so that the number of moving objects rarely recompiles.
        slots = 1 << len(paths).bit_length()
        matrices = np.repeat(cameras_from_world[:, None], slots, axis=1)
        slot = np.zeros(len(points_m), np.int32)
        for number, (moves, motion) in enumerate(paths, start=1):
            slot[moves] = number
            matrices[:, number] = cameras_from_world @ motion
        moving = slot
        cameras_from_world = matrices
    with jax.enable_x64(True):  # as in `reference`: in float32 another of two close points may win
        return _splat(
            points_m,
            cameras_from_world,
            moving,
            cameras.intrinsics_px.astype(np.float32),
            size=(cameras.height, cameras.width),
            point_px=point_px,
        )


@partial(jax.jit, static_argnames=("size", "point_px"))
def _splat(
    points_m: Float[Array | np.ndarray, "n 3"],
    cameras_from_world: Float[Array, "f *s 4 4"],
    slot: Int32[Array, " n"] | None,
    intrinsics_px: Float32[Array, "3 3"],
    *,
    size: tuple[int, int],
    point_px: int,
) -> tuple[Float32[Array, "f h w"], Int32[Array, "f h w"]]:
    height, width = size
    margin = point_px - 1  # a square may begin this far outside and still show
    rows, columns = height + margin, width + margin
    count = len(points_m)
    points = points_m.astype(jnp.float64).T

    def frame(camera_from_world: Array) -> tuple[Array, Array]:
        # Written by components: a product of matrices with three columns takes ten times as long.
        rows_from_world = (
            camera_from_world[:3]
            if slot is None
            else camera_from_world[slot, :3].transpose(1, 2, 0)
        )
        x, y, z = (
            (a * points[0] + b * points[1] + c * points[2] + shift).astype(jnp.float32)
            for a, b, c, shift in rows_from_world
        )
        u, v = project(intrinsics_px, jnp.stack([x, y, z], axis=-1))
        column = jnp.ceil(u - point_px / 2) + margin
        row = jnp.ceil(v - point_px / 2) + margin
        seen = (z >= NEAR_M) & (z <= FAR_M)
        seen &= (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        nowhere = rows * columns
        at = row.astype(jnp.int32) * columns + column.astype(jnp.int32)  # over 2**24 pixels, too
        cell = jnp.where(seen, at, nowhere)
        # Positive floats are in the order of their bits: the least key is the nearest point, at
        # equal depth the first. One scatter of 64 bits takes half the time of two of 32.
        bits = jax.lax.bitcast_convert_type(z, jnp.uint32).astype(jnp.uint64)
        key = (bits << 32) | jnp.arange(count, dtype=jnp.uint64)
        least = jnp.full(nowhere + 1, _FARTHEST | np.uint64(count)).at[cell].min(key)[:-1]
        nearest = jax.lax.bitcast_convert_type((least >> 32).astype(jnp.uint32), jnp.float32)
        number = least.astype(jnp.uint32).astype(jnp.int32)
        return _nearest_square(
            nearest.reshape(rows, columns), number.reshape(rows, columns), point_px
        )

    depth, number = jax.lax.map(frame, cameras_from_world)
    return depth, jnp.where(jnp.isfinite(depth), number, -1)


def _nearest_square(
    depth: Float32[Array, "r c"], number: Int32[Array, "r c"], point_px: int
) -> tuple[Float32[Array, "h w"], Int32[Array, "h w"]]:
    """Return the nearest of the p x p cells that cover each pixel; at equal depth the first."""
    height, width = (extent - point_px + 1 for extent in depth.shape)
    best = depth[:height, :width], number[:height, :width]
    for down in range(point_px):
        for right in range(point_px):
            window = slice(down, down + height), slice(right, right + width)
            z, n = depth[window], number[window]
            closer = (z < best[0]) | ((z == best[0]) & (n < best[1]))
            best = jnp.where(closer, z, best[0]), jnp.where(closer, n, best[1])
    return best


@jax.jit
@jax.vmap
def close_gaps(
    depth_m: Float32[Array, "r c"], index: Int32[Array, "r c"]
) -> tuple[Float32[Array, "h w"], Int32[Array, "h w"]]:
    """Return depth and index without their margin, with gaps closed as in `reference`."""
    # The nearest of the negated depths is the farthest; the second window completes the closing.
    negated, number = _nearest_square(jnp.where(index < 0, jnp.inf, -depth_m), index, 3)
    worst = jax.lax.reduce_window(negated, -jnp.inf, jax.lax.max, (3, 3), (1, 1), "VALID")
    inside, around = (
        (slice(margin, -margin),) * 2 for margin in (GAP_MARGIN_PX, GAP_MARGIN_PX - 1)
    )
    gap = jnp.isfinite(worst) & (index[inside] < 0)
    return (
        jnp.where(gap, -negated[around], depth_m[inside]),
        jnp.where(gap, number[around], index[inside]),
    )


@partial(jax.jit, static_argnames="gamma")
def paint(
    index: Int[Array | np.ndarray, "f h w"],
    colors: UInt8[Array | np.ndarray, "n 3"],
    *,
    gamma: bool,
) -> UInt8[Array, "f h w 3"]:
    """Return the image of the visible points, black where no point is visible."""
    colors = jnp.asarray(GAMMA)[colors] if gamma else jnp.asarray(colors)
    return jnp.where(index[..., None] < 0, jnp.uint8(0), colors[index])


@partial(jax.jit, static_argnames="dilate")
def unobserved(
    index: Int[Array | np.ndarray, "f h w"], *, dilate: bool = False
) -> UInt8[Array, "f h w"]:
    """Return the mask, 255 where no point is seen; `dilate` widens the observed part by a pixel."""
    drawn = jnp.asarray(index) >= 0
    if dilate:
        drawn = jax.lax.reduce_window(
            drawn, False, jax.lax.bitwise_or, (1, 3, 3), (1, 1, 1), "SAME"
        )
    return jnp.where(drawn, 0, 255).astype(jnp.uint8)


def draw_hands(
    joints_m: Float[np.ndarray, "f n j 3"], cameras: Cameras, *, kind: Kind
) -> tuple[UInt8[np.ndarray, "f h w 3"], Float32[np.ndarray, "f h w"]]:
    """Draw n hands; return the image and its depth, black and infinite where there is no hand."""
    tiles = tiles_of(cameras)
    intrinsics = jnp.asarray(cameras.intrinsics_px, jnp.float32)
    frames = []
    for joints, pose in zip(joints_m, cameras.world_from_camera, strict=True):
        canvas = empty_canvas(tiles)
        shapes = _shapes_of(joints, pose, kind)
        radius = shapes["radius"][:, None]
        low = np.minimum(shapes["start"], shapes["end"]) - radius
        high = np.maximum(shapes["start"], shapes["end"]) + radius
        for chunk in chunks(shapes, low, high, cameras):
            canvas = _draw_chunk(canvas, **chunk, intrinsics_px=intrinsics, columns=tiles[1])
        frames.append(canvas)
    return image_of(frames, cameras)


def _shapes_of(
    joints_m: Float[np.ndarray, "n j 3"], world_from_camera: Float[np.ndarray, "4 4"], kind: Kind
) -> dict[str, np.ndarray]:
    """Return the spheres and tubes of one frame's hands in camera coordinates, one per row."""
    skeleton = SKELETONS[kind]
    joint = np.arange(len(skeleton.colors))
    starts = np.concatenate([joint, skeleton.bones[:, 0]])
    ends = np.concatenate([joint, skeleton.bones[:, 1]])
    present = joints_m[np.isfinite(joints_m).all(axis=(1, 2))]
    local = transform(invert(world_from_camera), present)
    return {
        "start": local[:, starts].reshape(-1, 3),
        "end": local[:, ends].reshape(-1, 3),
        "radius": np.tile(np.where(starts == ends, JOINT_RADIUS_M, BONE_RADIUS_M), len(present)),
        "color": np.tile(skeleton.colors[ends], (len(present), 1)),
    }


@partial(jax.jit, static_argnames="columns", donate_argnames="canvas")
def _draw_chunk(
    canvas: Canvas,
    *,
    tile: Int32[Array, " k"],
    start: Float32[Array, "k 3"],
    end: Float32[Array, "k 3"],
    radius: Float32[Array, " k"],
    color: UInt8[Array, "k 3"],
    intrinsics_px: Float32[Array, "3 3"],
    columns: int,
) -> Canvas:
    """Draw each shape into its tile; at equal depth the first shape is visible."""
    x, y = pixel_rays(tile, intrinsics_px, columns)
    return put(canvas, tile, _meet(x, y, start, end, radius), color[:, None, None])


def _meet(
    x: Float32[Array, "k p p"],
    y: Float32[Array, "k p p"],
    start: Float32[Array, "k 3"],
    end: Float32[Array, "k 3"],
    radius: Float32[Array, " k"],
) -> Float32[Array, "k p p"]:
    """Return the depth at which rays (x, y, 1) enter a sphere (start = end) or a tube, or infinity.

    Written by components: products of matrices with three columns take ten times as long.
    """
    along = end - start
    length = jnp.sqrt((along**2).sum(axis=-1))
    axis = along / jnp.where(length > 0, length, 1)[:, None]
    offset = start - (start * axis).sum(axis=-1, keepdims=True) * axis
    ax, ay, az, ox, oy, oz, sx, sy, sz = (
        vector[:, k, None, None] for vector in (axis, offset, start) for k in range(3)
    )
    cosine = x * ax + y * ay + az
    cx, cy, cz = x - cosine * ax, y - cosine * ay, 1 - cosine * az
    a = cx**2 + cy**2 + cz**2
    # From the ray's nearest point to the axis: b^2 - a c would cancel in float32.
    b = cx * ox + cy * oy + cz * oz
    share = b / a
    gap = (ox - share * cx) ** 2 + (oy - share * cy) ** 2 + (oz - share * cz) ** 2
    discriminant = radius[:, None, None] ** 2 - gap
    t = (b - jnp.sqrt(jnp.maximum(discriminant, 0) * a)) / a
    place = (t * x - sx) * ax + (t * y - sy) * ay + (t - sz) * az
    hit = (discriminant >= 0) & (t >= NEAR_M) & (place >= 0) & (place <= length[:, None, None])
    return jnp.where(hit, t, jnp.inf)
