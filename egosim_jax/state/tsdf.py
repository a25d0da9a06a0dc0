"""TSDF fusion: depth images fused into a truncated signed distance field on a sparse voxel grid.

Every voxel near a surface stores the weighted mean of its signed distances to the surface, along
the rays that observed it, clipped at the truncation. The surface is the zero level set. Source:
EgoSim, section 3.3 and its implementation details: voxels of 3 mm, truncation 5 cm, depths up to
3 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int32, Shaped, UInt8

from egosim_jax.geometry import pixel_rays, transform
from egosim_jax.runtime.open3d import load_open3d
from egosim_jax.types import Cameras, InputError
from egosim_jax.types.arrays import DepthMaps, Mask, Masks, Pose, Video

DEPTH_WINDOW_PX = 5
"""Size in pixels of the window in which depths are compared."""
MAX_DEPTH_STEP = 0.1
"""Maximum difference of depths in the window of a reliable depth, as a fraction of that depth."""
BLOCK_VOXELS = 16
"""Voxels along an edge of a block."""
GRID_OFFSET_VOXELS = 0.37
"""Offset of the grid from the origin, in voxels.

A surface exactly on voxel centers, such as a table at height 0, has distances of 0 without a change
of sign, and would be lost."""


@dataclass(frozen=True, kw_only=True)
class Fusion:
    """Parameters of TSDF fusion."""

    voxel_m: float = 0.003
    """Voxel size in meters."""
    truncation_m: float = 0.05
    """Truncation distance in meters."""
    max_depth_m: float = 3.0
    """Maximum depth in meters; larger depths are ignored."""
    observations: int = 3
    """Minimum number of frames that observe a voxel; all frames if there are fewer."""

    def __post_init__(self) -> None:
        """Check that the sizes are positive and the truncation spans voxels."""
        if not (0 < self.voxel_m <= self.truncation_m and self.max_depth_m > 0):
            raise InputError(
                f"Invalid fusion parameters: voxel_m {self.voxel_m}, truncation_m "
                f"{self.truncation_m}, max_depth_m {self.max_depth_m}. All must be positive, and "
                "the truncation at least one voxel."
            )


def valid_depth_mask(depth_m: DepthMaps) -> Masks:
    """Return the pixels whose depth is known and continuous; at edges, depths of surfaces mix."""
    import cv2

    window = np.ones((DEPTH_WINDOW_PX, DEPTH_WINDOW_PX), np.uint8)
    valid = np.isfinite(depth_m) & (depth_m > 0)
    nearest = [cv2.erode(frame, window) for frame in np.where(valid, depth_m, np.inf)]
    farthest = [cv2.dilate(frame, window) for frame in np.where(valid, depth_m, 0)]
    step = np.stack(farthest) - np.stack(nearest)
    return valid & (step < MAX_DEPTH_STEP * np.where(valid, depth_m, 1))


def surface(
    depth_m: DepthMaps, colors: Video, cameras: Cameras, *, fusion: Fusion
) -> tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]:
    """Return points and colors of the surface that the frames observe, in the cameras' world.

    Depths that are 0, infinite or NaN are unknown; frames without any known depth are skipped.
    """
    o3d = load_open3d()

    valid = np.isfinite(depth_m) & (depth_m > 0) & (depth_m <= fusion.max_depth_m)
    frames = np.flatnonzero(valid.any(axis=(1, 2)))
    if not len(frames):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    focal_px = float(cameras.intrinsics_px[0, 0])
    poses = cameras.world_from_camera.copy()
    poses[:, :3, 3] += GRID_OFFSET_VOXELS * fusion.voxel_m
    blocks = {
        frame: _blocks(depth_m[frame], valid[frame], poses[frame], rays, focal_px, fusion)
        for frame in frames
    }
    float32 = o3d.core.float32
    grid = o3d.t.geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(float32, float32, float32),
        attr_channels=(1, 1, 3),
        voxel_size=fusion.voxel_m,
        block_resolution=BLOCK_VOXELS,
        # A grid that has to grow copies itself each time; one that is too large zeroes gigabytes.
        block_count=len(_unique(np.concatenate(list(blocks.values())))),
    )
    # Open3D takes the pixel that a coordinate falls into, and pixel 0 begins at 0: with pixel
    # centers at whole numbers the image is half a pixel off, 2 mm on a table at 160 columns.
    shifted = cameras.intrinsics_px.astype(np.float64)
    shifted[:2, 2] += 0.5
    intrinsics = o3d.core.Tensor(shifted)
    reach = fusion.truncation_m / fusion.voxel_m
    for frame in frames:
        depth = _image(np.where(valid[frame], depth_m[frame], 0).astype(np.float32))
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
    return cloud.point.positions.numpy() - np.float32(GRID_OFFSET_VOXELS * fusion.voxel_m), shades


def _blocks(
    depth_m: Float32[np.ndarray, "h w"],
    valid: Mask,
    grid_from_camera: Pose,
    rays: Float[np.ndarray, "h w 3"],
    focal_px: float,
    fusion: Fusion,
) -> Int32[np.ndarray, "n 3"]:
    """Return the voxel blocks that the rays pass through within the truncation of the surface.

    Open3D's function samples every fourth pixel only, and misses small objects.
    """
    edge = BLOCK_VOXELS * fusion.voxel_m
    pixel_m = float(np.median(depth_m[valid])) / focal_px
    every = max(1, int(edge / 4 / pixel_m))  # pixels whose rays are a quarter of a block apart
    sampled = np.zeros_like(valid)
    sampled[::every, ::every] = True
    if not (valid & sampled).any():
        sampled[:] = True
    rays, depth = rays[valid & sampled], depth_m[valid & sampled]
    steps = np.linspace(-1, 1, 1 + 2 * int(np.ceil(2 * fusion.truncation_m / edge)))
    depths = depth[:, None] + steps * fusion.truncation_m
    points = transform(grid_from_camera, (rays[:, None] * depths[..., None]).reshape(-1, 3))
    return _unique(np.floor(points / edge).astype(np.int32))


def _unique(cells: Int32[np.ndarray, "m 3"]) -> Int32[np.ndarray, "n 3"]:
    """Return the distinct rows, sorted; many times faster than `np.unique` with an axis."""
    low = cells.min(axis=0)
    size = tuple(cells.max(axis=0) - low + 1)
    numbers = np.unique(np.ravel_multi_index(tuple((cells - low).T), size))
    return (np.stack(np.unravel_index(numbers, size), axis=1) + low).astype(np.int32)


def _image(pixels: Shaped[np.ndarray, "h w *c"]) -> object:
    o3d = load_open3d()

    return o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(pixels)))
