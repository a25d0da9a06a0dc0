"""Posed videos of the tabletop world with sparse points of exact depth, for tests."""

from dataclasses import replace

import numpy as np

from egosim_jax.geometry import invert, pixel_rays, pixels_of, transform
from egosim_jax.perception.video.estimates import CameraEstimate, SparsePoints, Verdict
from egosim_jax.types import VideoSpec
from egosim_jax.worlds.tabletop import make_sequence
from egosim_jax.worlds.tabletop.scene import FIRST_HAND

SPEC = VideoSpec(frames=9, height=120, width=208, fps=8)
UNKNOWN_CAMERAS = CameraEstimate(
    cameras=None, metric=False, verdict=Verdict(rung="refused", reason="no texture", figures={})
)


def make_clip(seed=0):
    return next(make_sequence(seed, spec=SPEC))


def hands_of(clip):
    """Return the pixels of hands and of the body that they move."""
    return (clip.ids >= FIRST_HAND) | (clip.ids == clip.body_ids[clip.target])


def sparse_points(clip, *, count=300, seed=0):
    """Return points of frame 0 and their exact pixels in all frames that see them."""
    rng = np.random.default_rng(seed)
    cameras, depth = clip.cameras, clip.depth_m
    rows, columns = np.nonzero(np.isfinite(depth[0]) & ~hands_of(clip)[0])
    chosen = rng.choice(len(rows), count, replace=False)
    rows, columns = rows[chosen], columns[chosen]
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    points = transform(
        cameras.world_from_camera[0], rays[rows, columns] * depth[0, rows, columns][:, None]
    )
    local = transform(invert(cameras.world_from_camera), np.repeat(points[None], len(depth), 0))
    row, column, inside = pixels_of(cameras, local)
    there = np.take_along_axis(depth.reshape(len(depth), -1), row * cameras.width + column, axis=1)
    seen = inside & (np.abs(there - local[..., 2]) < 0.01)
    frames, indices = np.nonzero(seen)
    z = local[frames, indices]
    matrix = cameras.intrinsics_px
    pixels = (z[:, :2] / z[:, 2:]) * matrix[[0, 1], [0, 1]] + matrix[:2, 2]
    return SparsePoints(
        points_m=points,
        error_px=np.full(len(points), 0.3),
        frames=frames.astype(np.int32),
        indices=indices.astype(np.int32),
        pixels_px=pixels,
    )


def estimate_of(clip, *, unit=1.0, rung="incremental", points=True):
    """Return the clip's exact cameras and points, in an unknown unit of `unit` meters."""
    poses = clip.cameras.world_from_camera.copy()
    poses[:, :3, 3] /= unit
    sparse = sparse_points(clip) if points else None
    if sparse is not None:
        sparse = replace(sparse, points_m=sparse.points_m / unit)
    return CameraEstimate(
        cameras=replace(clip.cameras, world_from_camera=poses),
        metric=False,
        verdict=Verdict(rung=rung, reason="given to a test", figures={}),
        points=sparse,
    )
