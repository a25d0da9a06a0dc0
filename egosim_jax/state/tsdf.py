"""Depth images fused into a surface: a truncated signed distance field on a sparse voxel grid.

Every voxel near a surface keeps the weighted mean of its signed distances to it along the rays that
saw it, cut off at the truncation; the surface is where that mean is zero. Source: EgoSim, section
3.3 and its implementation details: voxels of 3 mm, truncation 5 cm, depths up to 3 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, Shaped, UInt8
from numpy.lib.stride_tricks import sliding_window_view

from egosim_jax.geometry import pixel_rays, transform
from egosim_jax.types import Cameras, InputError

WINDOW, LARGEST_STEP = 5, 0.1
"""A depth counts if within so many pixels around it depths differ by less than this share."""
BLOCK = 16
"""Voxels along an edge of a block."""
SHIFT = 0.37
"""Voxels by which the grid is off the origin: where a surface passes exactly through the voxels,
as a table at height 0 would, distances are 0 and change no sign, and it would be lost."""


@dataclass(frozen=True, kw_only=True)
class Fusion:
    """How finely depth is fused."""

    voxel_m: float = 0.003
    truncation_m: float = 0.05
    max_depth_m: float = 3.0
    """Farther depths are left out."""
    observations: int = 3
    """A voxel counts from so many frames on, or from all if there are fewer."""

    def __post_init__(self) -> None:
        """Check that the sizes are positive and the truncation spans voxels."""
        if not (0 < self.voxel_m <= self.truncation_m and self.max_depth_m > 0):
            raise InputError(
                f"Voxels of {self.voxel_m} m, a truncation of {self.truncation_m} m and depths up "
                f"to {self.max_depth_m} m make no surface: all must be positive, and the "
                "truncation no less than a voxel."
            )


def steady(depth_m: Float32[np.ndarray, "*f h w"]) -> Bool[np.ndarray, "*f h w"]:
    """Where depth is known and changes little: not at the edge of a thing, whose depth is mixed."""
    half = WINDOW // 2
    border = [(0, 0)] * (depth_m.ndim - 2) + [(half, half)] * 2
    known = np.isfinite(depth_m) & (depth_m > 0)
    low = _around(np.pad(np.where(known, depth_m, np.inf), border, constant_values=np.inf), np.min)
    high = _around(np.pad(np.where(known, depth_m, 0), border), np.max)
    return known & (high - low < LARGEST_STEP * np.where(known, depth_m, 1))


def _around(padded: np.ndarray, reduce: np.ufunc | object) -> np.ndarray:
    """Least or greatest value in the window around each pixel: first along rows, then columns."""
    for axis in (-1, -2):
        padded = reduce(sliding_window_view(padded, WINDOW, axis=axis), axis=-1)  # type: ignore[operator]
    return padded


def surface(
    depth_m: Float32[np.ndarray, "f h w"],
    colors: UInt8[np.ndarray, "f h w 3"],
    cameras: Cameras,
    *,
    fusion: Fusion,
) -> tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Points and colors of the surface that the frames see, in the coordinates of the cameras.

    Depths that are 0, infinite or NaN are unknown; frames in which all are add nothing.
    """
    import open3d as o3d

    known = np.isfinite(depth_m) & (depth_m > 0) & (depth_m <= fusion.max_depth_m)
    frames = np.flatnonzero(known.any(axis=(1, 2)))
    if not len(frames):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    focal_px = float(cameras.intrinsics_px[0, 0])
    poses = cameras.world_from_camera.copy()
    poses[:, :3, 3] += SHIFT * fusion.voxel_m
    blocks = {
        frame: _blocks(depth_m[frame], known[frame], poses[frame], rays, focal_px, fusion)
        for frame in frames
    }
    float32 = o3d.core.float32
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(float32, float32, float32),
        attr_channels=(1, 1, 3),
        voxel_size=fusion.voxel_m,
        block_resolution=BLOCK,
        # A grid that has to grow copies itself each time; one that is too large zeroes gigabytes.
        block_count=len(_unique(np.concatenate(list(blocks.values())))),
    )
    # Open3D takes the pixel that a coordinate falls into, and pixel 0 begins at 0: with pixel
    # centers at whole numbers the image lies half a pixel off, 2 mm on a table at 160 columns.
    centerd = cameras.intrinsics_px.astype(np.float64)
    centerd[:2, 2] += 0.5
    intrinsics = o3d.core.Tensor(centerd)
    reach = fusion.truncation_m / fusion.voxel_m
    for frame in frames:
        depth = _image(np.where(known[frame], depth_m[frame], 0).astype(np.float32))
        color = _image(colors[frame].astype(np.float32))
        pose = o3d.core.Tensor(np.linalg.inv(poses[frame]))
        near = o3d.core.Tensor(blocks[frame])
        grid.integrate(
            near, depth, color, intrinsics, intrinsics, pose, 1.0, fusion.max_depth_m, reach
        )
    # A voxel seen n times has weight n, and Open3D asks for more than the threshold.
    threshold = min(fusion.observations, len(frames)) - 0.5
    cloud = grid.extract_point_cloud(weight_threshold=threshold)
    if cloud.is_empty():
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    shades = np.clip(np.rint(cloud.point.colors.numpy()), 0, 255).astype(np.uint8)
    return cloud.point.positions.numpy() - np.float32(SHIFT * fusion.voxel_m), shades


def _blocks(
    depth_m: Float32[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    grid_from_camera: Float[np.ndarray, "4 4"],
    rays: Float[np.ndarray, "h w 3"],
    focal_px: float,
    fusion: Fusion,
) -> Int32[np.ndarray, "n 3"]:
    """The blocks that the rays pass through within the truncation of the surface.

    Open3D's own looks at every fourth pixel only, and misses small things.
    """
    edge = BLOCK * fusion.voxel_m
    apart = float(np.median(depth_m[known])) / focal_px
    every = max(1, int(edge / 4 / apart))  # pixels whose rays are a quarter of a block apart
    some = np.zeros_like(known)
    some[::every, ::every] = True
    if not (known & some).any():
        some[:] = True
    rays, depth = rays[known & some], depth_m[known & some]
    steps = np.linspace(-1, 1, 1 + 2 * int(np.ceil(2 * fusion.truncation_m / edge)))
    depths = depth[:, None] + steps * fusion.truncation_m
    places = transform(grid_from_camera, (rays[:, None] * depths[..., None]).reshape(-1, 3))
    return _unique(np.floor(places / edge).astype(np.int32))


def _unique(cells: Int32[np.ndarray, "m 3"]) -> Int32[np.ndarray, "n 3"]:
    """Each cell once, in order; many times faster than `np.unique` of rows."""
    low = cells.min(axis=0)
    size = tuple(cells.max(axis=0) - low + 1)
    numbers = np.unique(np.ravel_multi_index(tuple((cells - low).T), size))
    return (np.stack(np.unravel_index(numbers, size), axis=1) + low).astype(np.int32)


def _image(pixels: Shaped[np.ndarray, "h w *c"]) -> object:
    import open3d as o3d

    return o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(pixels)))
