"""Objects of an RGB-D image: what stands on its support planes, one id each.

1. `planes` finds the table, shelves and the floor. A quadratic surface follows a plane that a
   network's depth bends.
2. Pixels above a surface and within its outline are candidates. Walls are not.
3. `regions` cuts candidates where the depth jumps or the color changes, and joins the regions of
   one object.
4. A region that is too small or too large, or does not reach down to a surface, is no object.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from egosim_jax.geometry import pixel_rays
from egosim_jax.runtime.open3d import point_cloud
from egosim_jax.state.depth import known_depth
from egosim_jax.state.planes import SupportPlane, area_of, fit_plane, support_planes
from egosim_jax.state.regions import RegionConfig, find_regions
from egosim_jax.types import Counted, SceneState
from egosim_jax.types.arrays import DepthMap, Mask, Matrix, Plane, Points, RgbImage, Vector

UP = np.array([0.0, -1.0, 0.0])
"""Rough upward direction in camera coordinates."""
BEND_ROUNDS = 6
"""Number of fits of the quadratic surface, each to the inliers of the one before."""
WALL_AREA_M2, WALL_TILT_DEG = 0.25, 50.0
"""Minimum area of a wall, and minimum angle between its normal and the upward direction."""
MAX_WALLS = 4
"""Maximum number of walls."""
MAX_APART = 0.02
"""Maximum relative difference in depth of a pixel and the subsampled one that gives its object."""


@dataclass(frozen=True, kw_only=True)
class ObjectSearch(Counted):
    """Thresholds of the search for objects in an RGB-D image."""

    max_width: int = 480
    """Maximum width and height of the searched image in pixels; a larger one is subsampled."""
    min_height_m: float = 0.005
    """Height above the surface at which a candidate begins, in meters."""
    min_top_m: float = 0.01
    """Minimum height of an object, in meters; anything lower is a crumb or a stain."""
    max_extent_m: float = 0.6
    """Maximum extent of an object along each axis, in meters."""
    max_foot_m: float = 0.03
    """Maximum height of an object's lowest visible part above its surface, in meters.

    Half of the object's height is allowed, too: a camera above a ball does not see its lower part.
    """
    outline_m: float = 0.05
    """Maximum distance of an object from the visible outline of its surface, in meters."""
    min_points: int = 30
    """Minimum number of pixels of an object in the image as it is given."""
    regions: RegionConfig = field(default_factory=RegionConfig)
    """Division of the candidates into objects."""


@no_type_check  # shapes and dtypes are checked with messages for users
def find_objects(
    image: RgbImage, depth_m: DepthMap, intrinsics_px: Matrix, search: ObjectSearch | None = None
) -> Int32[np.ndarray, "h w"]:
    """Return the object id of each pixel, from 1 for the largest; 0 is the background.

    The image has no hands, and is taken from above the surfaces, by a camera that is not turned on
    its side. Depth is in meters along the camera's z axis; 0, NaN and infinity mean unknown. Raises
    `InputError` for arrays that `state_from_depth` refuses.
    """
    import cv2

    surface = known_depth(image, depth_m, intrinsics_px)
    search = search or ObjectSearch()
    every = max(1, -(-max(depth_m.shape) // search.max_width))
    valid = surface[::every, ::every]
    coarse = np.where(valid, depth_m[::every, ::every], 0.0).astype(float)
    rays = pixel_rays(np.asarray(intrinsics_px, float), height=image.shape[0], width=image.shape[1])
    points = rays[::every, ::every] * coarse[..., None]
    shown = cv2.GaussianBlur(image, (0, 0), 0.5 * every) if every > 1 else image
    lab = cv2.cvtColor(
        np.ascontiguousarray(shown[::every, ::every]).astype(np.float32) / 255, cv2.COLOR_RGB2LAB
    )
    heights, above = _heights(points, valid, search)
    footprint_m = coarse * every / float(intrinsics_px[0, 0])
    labels = find_regions(points, lab, above, footprint_m, search.regions)
    labels = _keep_objects(labels, points, heights, search.min_points / every**2, search)
    labels = _grow_down(labels, lab, heights, valid, search)
    return _refine(labels, depth_m, every)


def _heights(
    points: Float[np.ndarray, "h w 3"], valid: Mask, search: ObjectSearch
) -> tuple[Float[np.ndarray, "h w"], Mask]:
    """Return the height of each pixel above the surface below it, and the candidates.

    The height is NaN where there is no surface below.
    """
    heights = np.full(valid.shape, np.nan)
    cloud = points[valid]
    if len(cloud) < 3:
        return heights, np.zeros(valid.shape, bool)
    tolerance = max(search.min_height_m, 0.008 * float(np.median(cloud[:, 2])))
    lowest = np.full(len(cloud), np.nan)
    noise = np.full(len(cloud), search.min_height_m)
    surfaces = support_planes(cloud, UP, eye_m=np.zeros(3), tolerance_m=tolerance)
    for surface in _without_tops(surfaces, cloud, search):
        height, deviation, inside = _above(surface, cloud, tolerance, search)
        limit = max(search.min_height_m, 3 * deviation)
        nearer = inside & (height > -limit) & ~(lowest <= height)
        lowest[nearer], noise[nearer] = height[nearer], limit
    free = np.flatnonzero(lowest > noise)
    free = np.delete(free, _walls(cloud[free], surfaces, tolerance))
    heights[valid] = lowest
    above = np.zeros(len(cloud), bool)
    above[free] = lowest[free] < search.max_extent_m
    candidates = np.zeros(valid.shape, bool)
    candidates[valid] = above
    return heights, candidates


def _without_tops(
    surfaces: list[SupportPlane], cloud: Points, search: ObjectSearch
) -> list[SupportPlane]:
    """Return the surfaces without tops of objects: small ones above another surface."""
    kept = []
    for surface in surfaces:
        flat = _on_plane(cloud[surface.inliers], surface.plane)
        small = (np.quantile(flat, 0.98, axis=0) - np.quantile(flat, 0.02, axis=0)).max()
        middle = np.median(cloud[surface.inliers], axis=0)
        higher = any(
            0 < other.heights(middle[None])[0] < search.max_extent_m
            for other in surfaces
            if other is not surface
        )
        if not (higher and small < search.max_extent_m):
            kept.append(surface)
    return kept


def _on_plane(points_m: Points, plane: Plane) -> Float[np.ndarray, "n 2"]:
    """Return coordinates of points along two axes of a plane, in meters."""
    return points_m @ np.linalg.svd(plane[None, :3])[2][1:].T


def _above(
    surface: SupportPlane, cloud: Points, tolerance_m: float, search: ObjectSearch
) -> tuple[Float[np.ndarray, " n"], float, Bool[np.ndarray, " n"]]:
    """Return heights above a surface, their deviation on it, and which points are over it."""
    import cv2

    flat = _on_plane(cloud, surface.plane)
    height = surface.heights(cloud)
    on = np.abs(height) <= tolerance_m
    middle = np.median(flat[on], axis=0)
    # Scaled, so that the quadratic terms are well conditioned.
    x, y = ((flat - middle) / np.maximum(np.ptp(flat[on], axis=0), 1e-6)).T
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)
    bent, deviation = height, tolerance_m / 3
    for _ in range(BEND_ROUNDS):
        bend, *_ = np.linalg.lstsq(terms[on], height[on], rcond=None)
        bent = height - terms @ bend
        deviation = 1.4826 * float(np.median(np.abs(bent[on])))
        on = np.abs(bent) <= max(min(3 * deviation, tolerance_m), search.min_height_m / 2)
    outline = cv2.convexHull((flat[on] - middle).astype(np.float32))
    hull = np.array(outline[:, 0], float)
    following = np.roll(hull, -1, axis=0) - hull
    outward = np.stack([following[:, 1], -following[:, 0]], axis=1)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    inner = hull.mean(axis=0)
    outward *= -np.sign(((inner - hull) * outward).sum(axis=1, keepdims=True))
    beyond = ((flat - middle) @ outward.T - (hull * outward).sum(axis=1)).max(axis=1)
    return bent, deviation, beyond <= search.outline_m


def _walls(cloud: Points, surfaces: list[SupportPlane], tolerance_m: float) -> list[int]:
    """Return the indices of the points on walls."""
    rest, planes = np.arange(len(cloud)), []
    for _ in range(MAX_WALLS if surfaces else 0):
        if len(rest) < 100:
            break
        plane, inliers = fit_plane(cloud[rest], tolerance_m)
        upright = abs(plane[:3] @ surfaces[0].plane[:3]) < np.cos(np.radians(WALL_TILT_DEG))
        if upright and area_of(cloud[rest[inliers]], plane) >= WALL_AREA_M2:
            planes += rest[inliers].tolist()
        rest = np.delete(rest, inliers)
    return planes


def _keep_objects(
    labels: Int32[np.ndarray, "h w"],
    points: Float[np.ndarray, "h w 3"],
    heights: Float[np.ndarray, "h w"],
    min_pixels: float,
    search: ObjectSearch,
) -> Int32[np.ndarray, "h w"]:
    """Return the labels of objects alone, from 1 for the largest.

    An object stands on a surface, or on another object.
    """
    import cv2

    numbers, counts = np.unique(labels[labels > 0], return_counts=True)
    fits, standing = {}, set()
    for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
        mask = labels == number
        low, high = np.quantile(heights[mask], [0.03, 0.97])
        extent = np.ptp(np.quantile(points[mask], [0.02, 0.98], axis=0), axis=0).max()
        if count >= min_pixels and high >= search.min_top_m and extent <= search.max_extent_m:
            fits[number] = low
            if low <= max(search.max_foot_m, high / 2):
                standing.add(number)
    for number in sorted(fits.keys() - standing, key=lambda n: fits[n]):
        mask = labels == number
        around = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        touched = set(np.unique(labels[around & ~mask]).tolist()) & standing
        if any(fits[other] < fits[number] for other in touched):
            standing.add(number)
    order = sorted(standing, key=lambda n: -counts[numbers == n][0])
    renumbered = np.zeros(int(labels.max()) + 1, np.int32)
    renumbered[order] = np.arange(1, len(order) + 1)
    return renumbered[labels]


def _grow_down(
    labels: Int32[np.ndarray, "h w"],
    lab: Float32[np.ndarray, "h w 3"],
    heights: Float[np.ndarray, "h w"],
    valid: Mask,
    search: ObjectSearch,
) -> Int32[np.ndarray, "h w"]:
    """Return labels with the feet of objects, which are nearer to the surface than its noise.

    A pixel next to an object belongs to it if its color is nearer to the object's there than to
    the surface's around it.
    """
    import cv2

    labels = labels.copy()
    size = 2 * round(max(labels.shape) / 40) + 1
    surface = valid & (labels == 0) & (np.abs(heights) <= search.min_height_m)
    weight = cv2.blur(surface.astype(np.float32), (size, size))
    around = cv2.blur(lab * surface[..., None], (size, size)) / np.maximum(weight, 1e-6)[..., None]
    for _ in range(max(1, max(labels.shape) // 160) + 1):
        mask = (labels > 0).astype(np.float32)
        near = cv2.blur(mask, (3, 3))
        color = cv2.blur(lab * mask[..., None], (3, 3)) / np.maximum(near, 1e-6)[..., None]
        grown = cv2.dilate(labels.astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
        to_object = np.linalg.norm(lab - color, axis=2)
        to_surface = np.linalg.norm(lab - around, axis=2)
        new = (labels == 0) & (grown > 0) & (near > 0) & (np.abs(heights) < 2 * search.min_top_m)
        new &= (to_object < to_surface) & valid
        labels[new] = grown[new]
    return labels


def _refine(
    labels: Int32[np.ndarray, "h w"], depth_m: Float[np.ndarray, "r c"], every: int
) -> Int32[np.ndarray, "r c"]:
    """Return labels at the size of the image.

    Each pixel has the label of its subsampled pixel if that is as deep, or else of the neighbor
    of the nearest depth. The edge of an object would stay behind where it stood.
    """
    if every == 1:
        return labels
    height, width = depth_m.shape
    padded = np.pad(depth_m[::every, ::every], 1, constant_values=np.nan)
    shifts = sorted(product((0, 1, -1), repeat=2), key=lambda shift: shift != (0, 0))
    refined, nearest = np.zeros(depth_m.shape, np.int32), np.full(depth_m.shape, np.inf)
    for down, right in shifts:
        rows, columns = slice(1 + down, -1 + down or None), slice(1 + right, -1 + right or None)
        fine, coarse = (
            np.repeat(np.repeat(x, every, axis=0), every, axis=1)[:height, :width]
            for x in (np.pad(labels, 1)[rows, columns], padded[rows, columns])
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            apart = np.abs(depth_m - coarse) / coarse
            closer = (apart <= MAX_APART) & (apart < nearest)
        refined[closer], nearest[closer] = fine[closer], apart[closer]
        if (down, right) == (0, 0):
            nearest[closer] = 0.0
    return refined


def object_sizes(state: SceneState) -> dict[int, Vector]:
    """Return the extents of each object's points along its own axes in meters, ascending."""
    sizes = {}
    for number in np.unique(state.object_ids[state.object_ids > 0]).tolist():
        points = state.points_m[state.object_ids == number].astype(float)
        spread = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[1]
        if len(points) < 4 or spread[2] < 1e-9 * max(spread[0], 1e-9):
            sizes[number] = np.sort(np.ptp(points, axis=0))
            continue
        cloud = point_cloud(points)
        sizes[number] = np.sort(cloud.get_minimal_oriented_bounding_box(robust=True).extent)
    return sizes
