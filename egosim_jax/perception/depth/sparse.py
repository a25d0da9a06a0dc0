"""Selection of triangulated points that can be trusted as depths of a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.geometry import invert, transform
from egosim_jax.perception.estimates import SparsePoints
from egosim_jax.types import Cameras, check_counts


@dataclass(frozen=True, kw_only=True)
class SparseFilter:
    """Rules that a triangulated point must satisfy to count as a depth of a frame."""

    min_track: int = 4
    """Smallest number of frames that observe the point."""
    max_error_px: float = 2.0
    """Largest mean reprojection error in pixels."""
    neighbors: int = 8
    """Number of nearest points in the image that a depth is compared with."""
    tolerance: float = 0.08
    """Relative difference of 1/z from the neighbors' median that is always accepted."""
    deviations: float = 3.0
    """Difference from the neighbors' median in their median absolute deviations."""

    def __post_init__(self) -> None:
        """Check that all counts are positive."""
        check_counts({"min_track": self.min_track, "neighbors": self.neighbors})

    def __call__(
        self,
        points: SparsePoints,
        cameras: Cameras,
        frame: int,
        moving: Bool[np.ndarray, "h w"],
    ) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
        """Return pixels (column, row) and depths of the points that a frame observes.

        Points that are projected into `moving` do not count, and a point whose depth differs from
        all its neighbors' is a false match.
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
        """Return which inverse depths are like those of their neighbors in the image."""
        from scipy.spatial import KDTree

        if len(pixels) <= self.neighbors:
            return np.ones(len(pixels), bool)
        near = np.asarray(KDTree(pixels).query(pixels, k=self.neighbors + 1)[1])
        around = inverse[near[:, 1:]]
        median = np.median(around, axis=1)
        spread = np.median(np.abs(around - median[:, None]), axis=1)
        allowed = np.maximum(self.tolerance * median, self.deviations * spread)
        return np.abs(inverse - median) <= allowed
