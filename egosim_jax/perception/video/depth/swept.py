"""Depth of recorded videos without networks: plane sweep, sparse points, completion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from einops import reduce
from jaxtyping import Bool, Float, Float32, UInt8

from egosim_jax.geometry import invert, pixel_rays, pixels_of, transform
from egosim_jax.perception.video.depth.complete import Diffusion
from egosim_jax.perception.video.depth.sweep import PlaneSweep, choose_views
from egosim_jax.perception.video.depth.triangulate import SparseFilter, Triangulation
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimate
from egosim_jax.rendering import POINT_PX
from egosim_jax.types import Cameras, Counted, InputError
from egosim_jax.types.arrays import DepthMap, Mask, Masks, Video

METRIC_DISTANCE_M = 0.6
"""Distance of the assumed plane from metric cameras, in meters."""
MAX_DEPTH = 10.0
"""Maximum depth of the assumed plane in a turned camera, in distances of the plane."""
DENSITY_STEP_PX = 8
"""Spacing of the points that decide about the density, in pixels."""
MIN_MAGNIFIED = 0.02
"""Minimum fraction of magnified points, over all views, for a higher density."""


@dataclass(frozen=True, kw_only=True)
class SweptDepth(Counted):
    """Depth of a static scene from the parallax of a moving camera; a `DepthEstimator`."""

    downscale: int = 2
    """Downscaling factor of frames before the sweep."""
    percentiles: tuple[float, float] = (1.0, 99.0)
    """Percentiles of the sparse points' inverse depths that bound the sweep."""
    margin: float = 0.1
    """Widening of that range, relative to the inverse depths at its ends."""
    min_ratio: float = 2.0
    """Minimum ratio of the farthest to the nearest plane's depth."""
    sparse_weight: float = 4.0
    """Weight of a sparse point in the completion; a confident pixel of the sweep has 1."""
    min_points: int = 20
    """Minimum number of trusted points of a frame."""
    triangulation: Triangulation = field(default_factory=Triangulation)
    """Triangulation of points for cameras without points."""
    points: SparseFilter = field(default_factory=SparseFilter)
    """Selection of sparse points."""
    sweep: PlaneSweep = field(default_factory=PlaneSweep)
    """Plane sweep of each wanted frame."""
    diffusion: Diffusion = field(default_factory=Diffusion)
    """Completion of pixels that were not measured."""

    def __call__(
        self, frames: Video, moving: Masks, estimate: CameraEstimate, wanted: Sequence[int]
    ) -> DepthEstimate:
        """Return dense depth of the wanted frames in the unit of the cameras.

        Pixels in `moving` are completed from their surroundings. If the cameras have no points,
        for example a dataset's cameras, tracked corners are triangulated. If the cameras stay in
        place, or a frame has fewer than `min_points` points with parallax, depth is an assumed
        plane, and the estimate's `reason` says so. Raises `InputError` if cameras were refused.
        """
        cameras = estimate.cameras
        if cameras is None:
            raise InputError(
                "Depth cannot be swept: it needs cameras, which were refused: "
                f"{estimate.verdict.reason}. Give cameras, or a depth network. (--depth)"
            )
        if not has_parallax(estimate):
            why = f"the camera does not change its place ({estimate.verdict.rung})"
            return assume_plane(estimate, cameras, wanted, why=why)
        small, hidden, reduced = reduce_video(frames, moving, cameras, self.downscale)
        depths, measured = [], []
        for frame in wanted:
            points = estimate.points or self.triangulation(frames, moving, cameras, frame)
            pixels, depth = self.points(points, cameras, frame, moving[frame])
            if len(depth) < self.min_points:
                why = f"{len(depth)} points of frame {frame} show parallax"
                return assume_plane(estimate, cameras, wanted, why=why)
            pixels = (pixels + 0.5) / self.downscale - 0.5
            inverse, reliable = self._frame(small, hidden, reduced, frame, pixels, depth)
            depths.append(1 / _enlarge(inverse, cameras))
            measured.append(_enlarge(reliable.astype(np.float32), cameras) > 0.5)
        return DepthEstimate(
            frames=np.array(wanted, np.int32),
            depth_m=np.stack(depths),
            confident=np.stack(measured),
            metric=estimate.metric,
            reason="plane sweep, completed by diffusion",
        )

    def _frame(
        self,
        frames: Video,
        hidden: Masks,
        cameras: Cameras,
        frame: int,
        pixels: Float[np.ndarray, "n 2"],
        depth: Float[np.ndarray, " n"],
    ) -> tuple[Float32[np.ndarray, "h w"], Mask]:
        """Return a downscaled frame's completed inverse depth, and True for measured pixels."""
        far, near = (float(np.percentile(1 / depth, p)) for p in self.percentiles)
        widen = max(1 + self.margin, float(np.sqrt(self.min_ratio * far / near)))
        far, near = far / widen, near * widen
        views = choose_views(cameras, frame, float(np.median(depth)), self.sweep.views)
        swept = self.sweep(frames, hidden, cameras, frame, views, (far, near))
        weight = swept.confident.astype(float)
        total = weight * swept.inverse
        column, row = np.rint(pixels).astype(int).T
        row, column = np.clip(row, 0, cameras.height - 1), np.clip(column, 0, cameras.width - 1)
        np.add.at(total, (row, column), self.sparse_weight / depth)
        np.add.at(weight, (row, column), self.sparse_weight)
        inverse = self.diffusion(frames[frame], total / np.maximum(weight, 1e-12), weight)
        return np.clip(inverse, far, near), weight > 0


def reduce_video(
    frames: Video, moving: Masks, cameras: Cameras, factor: int
) -> tuple[UInt8[np.ndarray, "f r c 3"], Bool[np.ndarray, "f r c"], Cameras]:
    """Return downscaled frames, moving pixels and cameras. Remaining rows and columns are cropped.

    A downscaled pixel moves if any of its pixels does.
    """
    import cv2

    height, width = cameras.height // factor, cameras.width // factor
    rows, columns = slice(height * factor), slice(width * factor)
    small = [
        cv2.resize(frame[rows, columns], (width, height), interpolation=cv2.INTER_AREA)
        for frame in frames
    ]
    hidden = reduce(moving[:, rows, columns], "f (h a) (w b) -> f h w", "max", a=factor, b=factor)
    matrix = cameras.intrinsics_px.astype(float).copy()
    matrix[:2, 2] += 0.5  # pixel centers are at integers, but scaling is from the image corner
    matrix[:2] /= factor
    matrix[:2, 2] -= 0.5
    return (
        np.stack(small),
        hidden,
        replace(cameras, intrinsics_px=matrix, height=height, width=width),
    )


def has_parallax(estimate: CameraEstimate) -> bool:
    """Return True if the cameras move and do not only turn."""
    if estimate.cameras is None or estimate.verdict.rung in ("static", "rotation"):
        return False
    places = estimate.cameras.world_from_camera[:, :3, 3]
    return bool(np.ptp(places, axis=0).max() > 0)


def assume_plane(
    estimate: CameraEstimate, cameras: Cameras, wanted: Sequence[int], *, why: str
) -> DepthEstimate:
    """Return the assumed depth of a plane across the first camera's view.

    No pixel is confident. The plane is at `METRIC_DISTANCE_M` from metric cameras. If the unit is
    unknown, it is at distance 1, and the scale from hands then puts it where hands touch it. A
    view rendered from the plane is the first frame, turned with the camera.
    """
    distance = METRIC_DISTANCE_M if estimate.metric else 1.0
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    depths = []
    for frame in wanted:
        first = invert(cameras.world_from_camera[0]) @ cameras.world_from_camera[frame]
        with np.errstate(divide="ignore"):
            depth = (distance - first[2, 3]) / (rays @ first[2, :3])
        met = (depth > 0) & (depth < MAX_DEPTH * distance)
        depths.append(np.where(met, depth, np.inf).astype(np.float32))
    return DepthEstimate(
        frames=np.array(wanted, np.int32),
        depth_m=np.stack(depths),
        confident=np.zeros((len(depths), cameras.height, cameras.width), bool),
        metric=estimate.metric,
        reason=f"assumed, not measured: {why}; a plane across the first view replaces the scene",
    )


def _enlarge(values: Float32[np.ndarray, "r c"], cameras: Cameras) -> Float32[np.ndarray, "h w"]:
    import cv2

    size = cameras.width, cameras.height
    return cv2.resize(values, size, interpolation=cv2.INTER_LINEAR)


def points_per_pixel(depth_m: DepthMap, cameras: Cameras) -> int:
    """Return the number of points along each side of a first-frame pixel: 1 or 2.

    2 is for clips that see a part of the scene from less than half the first frame's distance. It
    is not the default because denser points look less sharp where nothing is magnified.
    """
    sampled = np.s_[::DENSITY_STEP_PX, ::DENSITY_STEP_PX]
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)[sampled]
    finite = np.isfinite(depth_m[sampled])
    depth = depth_m[sampled][finite]
    points = transform(cameras.world_from_camera[0], rays[finite] * depth[:, None])
    local = transform(invert(cameras.world_from_camera), points[None])
    inside = pixels_of(cameras, local)[2]
    nearer = (local[..., 2] * POINT_PX < depth) & inside
    return 2 if nearer.sum() > MIN_MAGNIFIED * inside.sum() else 1
