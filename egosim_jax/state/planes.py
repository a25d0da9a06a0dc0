"""Planes that objects stand on: a table, a shelf, the floor.

Planes are found by Open3D's RANSAC, one after another, each among the points that remain. A plane
is (a, b, c, d) with a unit normal (a, b, c): `a x + b y + c z + d` is a point's height above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.runtime.open3d import load_open3d, point_cloud

ITERATIONS = 500
"""Number of RANSAC trials per plane."""
MAX_FITS = 12
"""Maximum number of fitted planes, walls included."""
MAX_TILT_DEG = 75.0
"""Maximum angle between a camera's upward direction and the normal of a plane that it looks at.

The normal points to the camera. A table below a camera that looks down tilts by less; a wall in
front of it tilts by over 90 degrees.
"""
PARALLEL_DEG = 10.0
"""Maximum angle between the normals of two support planes, or between one and the true vertical."""
MIN_AREA_M2 = 0.02
"""Minimum visible area of every support plane after the first, in square meters."""
MAX_SAMPLED = 60_000
"""Maximum number of points that the trials compare."""


@dataclass(frozen=True, kw_only=True)
class SupportPlane:
    """Horizontal surface, seen from above."""

    plane: Float[np.ndarray, " 4"]
    """Plane (a, b, c, d); the unit normal points up."""
    inliers: Int[np.ndarray, " n"]
    """Indices of the points on the surface, and on no larger one."""

    def heights(self, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Return the heights of points above the surface, in meters."""
        return points_m @ self.plane[:3] + self.plane[3]


def fit_plane(
    points_m: Float[np.ndarray, "n 3"], tolerance_m: float
) -> tuple[Float[np.ndarray, " 4"], Int[np.ndarray, " k"]]:
    """Return the plane with the most inliers (RANSAC, the same in every run), and the inliers.

    It needs at least three points.
    """
    o3d = load_open3d()
    from threadpoolctl import threadpool_limits

    o3d.utility.random.seed(0)
    cloud = point_cloud(points_m)
    with threadpool_limits(1, user_api="openmp"):  # its threads race, and runs would differ
        plane, inliers = cloud.segment_plane(tolerance_m, 3, ITERATIONS)
    return np.array(plane), np.array(inliers, int)


def support_planes(
    points_m: Float[np.ndarray, "n 3"],
    up: Float[np.ndarray, " 3"],
    *,
    eye_m: Float[np.ndarray, " 3"] | None = None,
    tolerance_m: float = 0.006,
    min_points: int = 30,
    max_planes: int | None = None,
) -> list[SupportPlane]:
    """Return the horizontal surfaces of a scene, the largest first; the others are parallel to it.

    `up` is the vertical, or, with the position `eye_m` of a camera that looks down at the scene,
    the camera's upward direction (-y), which may be far from the vertical.
    """
    points_m = np.asarray(points_m, float)
    rest = np.arange(len(points_m))
    rest = rest[:: max(1, -(-len(rest) // MAX_SAMPLED))]
    found: list[SupportPlane] = []
    upward = up / np.linalg.norm(up)
    max_angle = PARALLEL_DEG if eye_m is None else MAX_TILT_DEG
    for _ in range(MAX_FITS):
        if len(rest) < max(min_points, 3) or len(found) == max_planes:
            break
        plane, inliers = fit_plane(points_m[rest], tolerance_m)
        if len(inliers) < min_points:
            break
        side = plane[:3] @ upward if eye_m is None else plane[:3] @ eye_m + plane[3]
        plane = plane if side > 0 else -plane
        on = rest[inliers]
        rest = np.delete(rest, inliers)
        angle = np.degrees(np.arccos(np.clip(plane[:3] @ upward, -1, 1)))
        if angle > max_angle or (found and area_of(points_m[on], plane) < MIN_AREA_M2):
            continue
        upward, max_angle = (plane[:3], PARALLEL_DEG) if not found else (upward, max_angle)
        own = np.abs(points_m @ plane[:3] + plane[3]) <= tolerance_m
        for larger in found:
            own[larger.inliers] = False
        found.append(SupportPlane(plane=plane, inliers=np.flatnonzero(own)))
    return found


def area_of(points_m: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, " 4"]) -> float:
    """Return the area that the points cover on the plane, in cells of 2 cm."""
    cell = 0.02
    side = np.linalg.svd(plane[None, :3])[2][1:]
    cells = np.unique(np.floor(points_m @ side.T / cell).astype(int), axis=0)
    return len(cells) * cell**2
