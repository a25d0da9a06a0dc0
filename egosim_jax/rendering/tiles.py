"""Square tiles of an image: a shape is drawn only in the tiles that its bounding box meets.

Pairs of shape and tile are drawn in chunks of equal length, so jax compiles once per image size.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import jax.numpy as jnp
import numpy as np
from einops import rearrange
from jaxtyping import Array, Float, Float32, Int, UInt8

from egosim_jax.geometry import project
from egosim_jax.rendering.skeleton import NEAR_M
from egosim_jax.types import Cameras

TILE_PX, CHUNK = 16, 256
"""Side of a tile in pixels, and number of pairs of shape and tile in a chunk."""

Canvas = tuple[Float32[Array, "t p p"], UInt8[Array, "t p p 3"]]
"""Depth and colors of all tiles of an image."""


def tiles_of(cameras: Cameras) -> tuple[int, int]:
    """Return the rows and columns of tiles that cover an image."""
    return -(-cameras.height // TILE_PX), -(-cameras.width // TILE_PX)


def empty_canvas(tiles: tuple[int, int]) -> Canvas:
    """Return a black image of infinite depth."""
    shape = (tiles[0] * tiles[1], TILE_PX, TILE_PX)
    return jnp.full(shape, jnp.inf), jnp.zeros((*shape, 3), jnp.uint8)


def image_of(
    frames: Sequence[Canvas], cameras: Cameras
) -> tuple[UInt8[np.ndarray, "f h w 3"], Float32[np.ndarray, "f h w"]]:
    """Return the images and depths of canvases."""
    rows, _ = tiles_of(cameras)
    depth, image = (np.stack([np.asarray(frame[k]) for frame in frames]) for k in range(2))
    depth = rearrange(depth, "f (r c) i j -> f (r i) (c j)", r=rows)
    image = rearrange(image, "f (r c) i j d -> f (r i) (c j) d", r=rows)
    inside = slice(None), slice(cameras.height), slice(cameras.width)
    return image[inside], depth[inside]


def chunks(
    shapes: dict[str, np.ndarray],
    low_m: Float[np.ndarray, "s 3"],
    high_m: Float[np.ndarray, "s 3"],
    cameras: Cameras,
) -> Iterator[dict[str, np.ndarray]]:
    """Yield each shape with each tile that its bounding box meets, `CHUNK` pairs at a time.

    `low_m` and `high_m` are the corners of the boxes in camera coordinates. The last chunk is
    padded with shapes of NaN, which no ray meets.
    """
    tiles = tiles_of(cameras)
    first, last = _bounding_tiles(low_m, high_m, cameras, tiles)
    counts = np.maximum(last - first, 0)
    total = counts.prod(axis=1)
    shape = np.repeat(np.arange(len(total)), total)
    number = np.arange(len(shape)) - np.repeat(np.cumsum(total) - total, total)
    row, column = np.divmod(number, counts[shape, 1])
    tile = (first[shape, 0] + row) * tiles[1] + first[shape, 1] + column
    for begin in range(0, len(tile), CHUNK):
        here = slice(begin, begin + CHUNK)
        missing = CHUNK - len(tile[here])
        pairs = {name: _padded(values[shape[here]], missing) for name, values in shapes.items()}
        yield {"tile": np.pad(tile[here], (0, missing)).astype(np.int32), **pairs}


def _padded(values: np.ndarray, missing: int) -> np.ndarray:
    """Append rows of NaN, or of 0 to bytes."""
    floating = values.dtype.kind == "f"
    return np.pad(
        values.astype(np.float32) if floating else values,
        ((0, missing), *[(0, 0)] * (values.ndim - 1)),
        constant_values=np.nan if floating else 0,
    )


def _bounding_tiles(
    low_m: Float[np.ndarray, "s 3"],
    high_m: Float[np.ndarray, "s 3"],
    cameras: Cameras,
    tiles: tuple[int, int],
) -> tuple[Int[np.ndarray, "s 2"], Int[np.ndarray, "s 2"]]:
    """Return row and column of each shape's first tile, and of the tile after its last.

    They bound the projected corners of the shape's box. A shape that crosses the near plane may be
    anywhere in the image and gets all tiles; a shape in front of it gets none.
    """
    box = np.stack([low_m, high_m], axis=1)
    near = low_m[:, 2] < NEAR_M
    box[near, :, 2] = NEAR_M
    corners = np.stack([box[:, which, range(3)] for which in np.ndindex(2, 2, 2)], axis=1)
    columns, rows = project(cameras.intrinsics_px, corners)
    pixels = np.stack([rows, columns], axis=-1)
    first = np.floor(pixels.min(axis=1) - 1) // TILE_PX
    last = np.ceil(pixels.max(axis=1) + 1) // TILE_PX + 1
    first = np.where(near[:, None], 0, np.clip(first, 0, tiles)).astype(int)
    last = np.where(near[:, None], tiles, np.clip(last, 0, tiles)).astype(int)
    return first, np.where(high_m[:, 2:] < NEAR_M, first, last)


def pixel_rays(
    tile: Int[Array, " k"], intrinsics_px: Float32[Array, "3 3"], columns: int
) -> tuple[Float32[Array, "k p p"], Float32[Array, "k p p"]]:
    """Return x and y of the rays of unit z through the pixels of tiles, `columns` in a row."""
    corner = jnp.stack([tile % columns, tile // columns]) * TILE_PX
    pixel = (
        corner[:, :, None, None]
        + jnp.stack(jnp.meshgrid(jnp.arange(TILE_PX), jnp.arange(TILE_PX)))[:, None]
    )
    x = (pixel[0] - intrinsics_px[0, 2]) / intrinsics_px[0, 0]
    y = (pixel[1] - intrinsics_px[1, 2]) / intrinsics_px[1, 1]
    return x, y


def put(
    canvas: Canvas,
    tile: Int[Array, " k"],
    depth: Float32[Array, "k p p"],
    colors: UInt8[Array, "k q r 3"],
) -> Canvas:
    """Draw each shape into its tile; at equal depth the first shape is visible."""
    before, image = canvas
    count = len(tile)
    nearest = before.at[tile].min(depth)
    seen = (depth <= nearest[tile]) & (depth < before[tile])
    number = jnp.where(seen, jnp.arange(count)[:, None, None], count)
    winner = jnp.full(before.shape, count).at[tile].min(number)
    shape = jnp.minimum(winner, count - 1)
    rows, columns = (jnp.arange(size) for size in colors.shape[1:3])
    drawn = colors[shape, rows[:, None], columns]
    return nearest, jnp.where((winner < count)[..., None], drawn, image)
