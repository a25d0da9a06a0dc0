"""Sparse points of a frame whose cameras are known: corners tracked and triangulated.

Corners are followed by Lucas-Kanade optical flow forwards and backwards in time as long as the way
back ends where it began. A point X that is seen at normalized (x, y) by a camera with rotation R
and translation t satisfies (R_1 - x R_3) X = x t_3 - t_1 and the same for y: least squares over its
frames, weighted by 1 / depth in a second pass, which makes it the error in the image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from egosim_jax.geometry import invert
from egosim_jax.perception.estimates import SparsePoints
from egosim_jax.types import Cameras, check_counts


@dataclass(frozen=True, kw_only=True)
class Triangulation:
    """Parameters of tracking and triangulation."""

    corners: int = 1500
    """Largest number of corners."""
    spacing_px: int = 5
    """Smallest distance between two corners, in pixels."""
    quality: float = 0.005
    """Least strength of a corner, relative to the strongest."""
    max_return_px: float = 0.7
    """Largest distance by which the way back of the flow misses its start, in pixels."""
    min_angle_deg: float = 1.0
    """Least angle between two rays to a point, in degrees."""
    max_angle_deg: float = 60.0
    """Largest angle; what does not move with the scene is triangulated amid the cameras."""

    def __post_init__(self) -> None:
        """Check that all counts are positive."""
        check_counts({"corners": self.corners, "spacing_px": self.spacing_px})

    def __call__(
        self,
        frames: UInt8[np.ndarray, "f h w 3"],
        moving: Bool[np.ndarray, "f h w"],
        cameras: Cameras,
        frame: int,
    ) -> SparsePoints:
        """Return the points of a frame's corners, in the world; maybe none."""
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
        moving: Bool[np.ndarray, "f h w"],
        pixels: Float[np.ndarray, "f n 2"],
        frame: int,
        step: int,
    ) -> None:
        """Fill in the pixels of the corners in the frames before or after theirs."""

        (alive,) = np.nonzero(np.isfinite(pixels[frame, :, 0]))
        height, width = gray[frame].shape
        stop = len(gray) if step > 0 else -1
        for other in range(frame + step, stop, step):
            if not len(alive):
                return
            here = pixels[other - step, alive].astype(np.float32)
            there, found = _flow(gray[other - step], gray[other], here)
            back, _ = _flow(gray[other], gray[other - step], there)
            kept = found & (np.linalg.norm(back - here, axis=1) < self.max_return_px)
            column, row = np.rint(there).astype(int).T
            kept &= (column >= 0) & (row >= 0) & (column < width) & (row < height)
            kept[kept] &= ~moving[other, row[kept], column[kept]]
            alive = alive[kept]
            pixels[other, alive] = there[kept]

    def _solve(
        self, pixels: Float[np.ndarray, "f n 2"], cameras: Cameras, frame: int
    ) -> SparsePoints:
        """Triangulate tracks; those at wrong angles or behind a camera are dropped."""
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
        self,
        points: Float[np.ndarray, "n 3"],
        seen: Bool[np.ndarray, "f n"],
        cameras: Cameras,
        frame: int,
    ) -> Float[np.ndarray, " n"]:
        """Return the largest angle between a point's ray in its frame and in any other."""
        rays = points - cameras.world_from_camera[:, None, :3, 3]
        rays /= np.maximum(np.linalg.norm(rays, axis=-1, keepdims=True), 1e-12)
        cosine = np.einsum("fnc,nc->fn", rays, rays[frame])
        smallest = np.where(seen, cosine, 1).min(axis=0)
        return np.degrees(np.arccos(np.clip(smallest, -1, 1)))


def triangulate_frames(
    frames: UInt8[np.ndarray, "f h w 3"],
    moving: Bool[np.ndarray, "f h w"],
    cameras: Cameras,
    wanted: Sequence[int],
) -> SparsePoints | None:
    """Return the points of the corners of some frames; None if no corner shows parallax."""
    parts = [Triangulation()(frames, moving, cameras, frame) for frame in wanted]
    first = np.cumsum([0, *(len(part.points_m) for part in parts)])
    if not first[-1]:
        return None
    numbers = [part.indices + start for part, start in zip(parts, first[:-1], strict=True)]
    return SparsePoints(
        points_m=np.concatenate([part.points_m for part in parts]),
        error_px=np.concatenate([part.error_px for part in parts]),
        frames=np.concatenate([part.frames for part in parts]),
        indices=np.concatenate(numbers).astype(np.int32),
        pixels_px=np.concatenate([part.pixels_px for part in parts]),
    )


def _flow(
    start: UInt8[np.ndarray, "h w"], end: UInt8[np.ndarray, "h w"], pixels: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """Return where pixels have moved, and which were found."""
    import cv2

    moved, found, _ = cv2.calcOpticalFlowPyrLK(start, end, pixels, pixels.copy())
    return moved, found[:, 0] > 0
