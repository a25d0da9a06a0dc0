"""Sparse points of frames with known cameras: triangulation, and selection of trusted points.

Lucas-Kanade optical flow tracks corners forward and backward in time, with a forward-backward
check. A point X at normalized image coordinates (x, y), seen by a camera with rotation R and
translation t, satisfies (R_1 - x R_3) X = x t_3 - t_1, and the same for y. Least squares over its
frames gives X. A second pass weights each equation by 1 / depth, so it minimizes the image error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from egosim_jax.geometry import invert, transform
from egosim_jax.perception.video.estimates import SparsePoints
from egosim_jax.types import Cameras, Counted
from egosim_jax.types.arrays import Mask, Masks, Points, Video


@dataclass(frozen=True, kw_only=True)
class Triangulation(Counted):
    """Parameters of tracking and triangulation."""

    corners: int = 1500
    """Maximum number of corners."""
    spacing_px: int = 5
    """Minimum distance between two corners, in pixels."""
    quality: float = 0.005
    """Minimum strength of a corner, relative to the strongest one."""
    max_return_px: float = 0.7
    """Maximum forward-backward error of the flow, in pixels."""
    min_angle_deg: float = 1.0
    """Minimum angle between two rays to a point, in degrees."""
    max_angle_deg: float = 60.0
    """Maximum angle in degrees; a larger one indicates a point that moves with the camera."""

    def __call__(self, frames: Video, moving: Masks, cameras: Cameras, frame: int) -> SparsePoints:
        """Return the world points of a frame's corners; there may be no points."""
        import cv2

        gray = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in frames]
        free = (~moving[frame]).astype(np.uint8)
        corners = cv2.goodFeaturesToTrack(
            gray[frame], self.corners, self.quality, self.spacing_px, mask=free
        )
        pixels = np.full((len(frames), 0 if corners is None else len(corners), 2), np.nan)
        if corners is not None:
            pixels[frame] = corners[:, 0]
            for step in (1, -1):
                self._follow(gray, moving, pixels, frame, step)
        return self._solve(pixels, cameras, frame)

    def _follow(
        self,
        gray: list[np.ndarray],
        moving: Masks,
        pixels: Float[np.ndarray, "f n 2"],
        frame: int,
        step: int,
    ) -> None:
        """Fill in the pixels of a frame's corners in the frames after it, or before it."""
        (alive,) = np.nonzero(np.isfinite(pixels[frame, :, 0]))
        height, width = gray[frame].shape
        stop = len(gray) if step > 0 else -1
        for other in range(frame + step, stop, step):
            if not len(alive):
                return
            here = pixels[other - step, alive].astype(np.float32)
            there, tracked = _flow(gray[other - step], gray[other], here)
            back, _ = _flow(gray[other], gray[other - step], there)
            kept = tracked & (np.linalg.norm(back - here, axis=1) < self.max_return_px)
            column, row = np.rint(there).astype(int).T
            kept &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
            kept[kept] &= ~moving[other, row[kept], column[kept]]
            alive = alive[kept]
            pixels[other, alive] = there[kept]

    def _solve(
        self, pixels: Float[np.ndarray, "f n 2"], cameras: Cameras, frame: int
    ) -> SparsePoints:
        """Triangulate tracks. Points at wrong angles or behind a camera are dropped."""
        matrix = cameras.intrinsics_px
        seen = np.isfinite(pixels[..., 0])
        homogeneous = np.concatenate([pixels, np.ones_like(pixels[..., :1])], axis=-1)
        rays = np.where(seen[..., None], homogeneous @ np.linalg.inv(matrix).T, 0)
        poses = invert(cameras.world_from_camera)
        rotation, shift = poses[:, None, :3, :3], poses[:, None, :3, 3]
        rows = rotation[:, :, :2] - rays[..., :2, None] * rotation[:, :, 2:]
        wanted = rays[..., :2] * shift[..., 2:] - shift[..., :2]
        weight = seen.astype(float)
        points = np.zeros((pixels.shape[1], 3))
        depth = np.ones_like(weight)
        for _ in range(2):
            left = np.einsum("fn,fnij,fnik->njk", weight, rows, rows)
            right = np.einsum("fn,fnij,fni->nj", weight, rows, wanted)
            points = np.einsum("njk,nk->nj", np.linalg.pinv(left), right)
            depth = np.einsum("fj,nj->fn", poses[:, 2, :3], points) + poses[:, 2, 3, None]
            weight = seen / np.maximum(np.abs(depth), 1e-9) ** 2
        residual = np.einsum("fnij,nj->fni", rows, points) - wanted
        miss = np.linalg.norm(residual * matrix[[0, 1], [0, 1]], axis=-1)
        miss /= np.maximum(np.abs(depth), 1e-9)
        count = np.maximum(seen.sum(axis=0), 1)
        error = np.where(seen, miss, 0).sum(axis=0) / count
        kept = (np.where(seen, depth, 1) > 0).all(axis=0) & (seen.sum(axis=0) > 1)
        angle = self._angle_deg(points, seen, cameras, frame)
        kept &= (angle >= self.min_angle_deg) & (angle <= self.max_angle_deg)
        indices, frames = np.nonzero((seen & kept).T)
        number = np.cumsum(kept) - 1
        return SparsePoints(
            points_m=points[kept],
            error_px=error[kept],
            frames=frames.astype(np.int32),
            indices=number[indices].astype(np.int32),
            pixels_px=pixels[frames, indices],
        )

    def _angle_deg(
        self, points: Points, seen: Bool[np.ndarray, "f n"], cameras: Cameras, frame: int
    ) -> Float[np.ndarray, " n"]:
        """Return the maximum angle between a point's ray in its frame and in any other."""
        rays = points - cameras.world_from_camera[:, None, :3, 3]
        rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
        cosine = np.einsum("fnc,nc->fn", rays, rays[frame])
        smallest = np.where(seen, cosine, 1).min(axis=0)
        return np.degrees(np.arccos(np.clip(smallest, -1, 1)))


@dataclass(frozen=True, kw_only=True)
class SparseFilter(Counted):
    """Selection of the triangulated points that can be trusted as depths of a frame."""

    min_track: int = 4
    """Minimum number of frames that observe a point."""
    max_error_px: float = 2.0
    """Maximum mean reprojection error in pixels."""
    neighbors: int = 8
    """Number of nearest points in the image to compare a depth with."""
    tolerance: float = 0.08
    """Accepted relative difference of 1/z from the neighbors' median."""
    deviations: float = 3.0
    """Accepted difference from the neighbors' median, in median absolute deviations."""

    def __call__(
        self, points: SparsePoints, cameras: Cameras, frame: int, moving: Mask
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """Return pixels (column, row) and depths of the trusted points of a frame.

        Points in `moving` do not count. A point whose depth differs from its neighbors' is a false
        match.
        """
        track = np.bincount(points.indices, minlength=len(points.points_m))
        kept = (track >= self.min_track) & (points.error_px < self.max_error_px)
        seen = (points.frames == frame) & kept[points.indices]
        pixels, indices = points.pixels_px[seen], points.indices[seen]
        pose = invert(cameras.world_from_camera[frame])
        depth = transform(pose, points.points_m[indices])[:, 2]
        column, row = np.rint(pixels).astype(int).T
        inside = (column >= 0) & (row >= 0) & (depth > 0)
        inside &= (column < cameras.width) & (row < cameras.height)
        inside[inside] &= ~moving[row[inside], column[inside]]
        pixels, depth = pixels[inside], depth[inside]
        agrees = self._agrees(pixels, 1 / depth)
        return pixels[agrees], depth[agrees]

    def _agrees(
        self, pixels: Float[np.ndarray, "n 2"], inverse: Float[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Return True for inverse depths that agree with their neighbors in the image."""
        from scipy.spatial import KDTree

        if len(pixels) <= self.neighbors:
            return np.ones(len(pixels), bool)
        near = np.asarray(KDTree(pixels).query(pixels, k=self.neighbors + 1)[1])
        around = inverse[near[:, 1:]]
        median = np.median(around, axis=1)
        spread = np.median(np.abs(around - median[:, None]), axis=1)
        allowed = np.maximum(self.tolerance * median, self.deviations * spread)
        return np.abs(inverse - median) <= allowed


def triangulate_frames(
    frames: Video, moving: Masks, cameras: Cameras, wanted: Sequence[int]
) -> SparsePoints | None:
    """Return the corner points of some frames; None if no corner shows parallax."""
    parts = [Triangulation()(frames, moving, cameras, frame) for frame in wanted]
    first = np.cumsum([0, *(len(points.points_m) for points in parts)])
    if not first[-1]:
        return None
    numbers = [points.indices + start for points, start in zip(parts, first[:-1], strict=True)]
    return SparsePoints(
        points_m=np.concatenate([points.points_m for points in parts]),
        error_px=np.concatenate([points.error_px for points in parts]),
        frames=np.concatenate([points.frames for points in parts]),
        indices=np.concatenate(numbers).astype(np.int32),
        pixels_px=np.concatenate([points.pixels_px for points in parts]),
    )


def _flow(
    start: UInt8[np.ndarray, "h w"], end: UInt8[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Return the new places of pixels, and True for the pixels found."""
    import cv2

    moved, tracked, _ = cv2.calcOpticalFlowPyrLK(start, end, pixels, pixels.copy())
    return moved, tracked[:, 0] > 0
