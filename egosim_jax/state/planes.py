"""Planes that objects stand on: a table, a shelf, the floor.

Planes are found by Open3D's RANSAC, one after another, each among the points that remain. A plane
is (a, b, c, d) with a unit normal (a, b, c): `a x + b y + c z + d` is a point's height above it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.geometry import UP_AXES, upward
from egosim_jax.runtime.open3d import load_open3d, point_cloud
from egosim_jax.types import SceneState
from egosim_jax.types.arrays import Plane, Points, Pose, Vector

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
TOLERANCE_M, MIN_PLANE_POINTS = 0.006, 30
"""Maximum distance of the points of a plane in meters, and their minimum number."""
MIN_AREA_M2 = 0.02
"""Minimum visible area of every support plane after the first, in square meters."""
MAX_SAMPLED = 60_000
"""Maximum number of points that the trials compare."""
MAX_MAIN_POINTS = 4000
"""Maximum number of points that determine the main support."""


@dataclass(frozen=True, kw_only=True)
class SupportPlane:
    """Horizontal surface, seen from above."""

    plane: Float[np.ndarray, " 4"]
    """Plane (a, b, c, d); the unit normal points up."""
    inliers: Int[np.ndarray, " n"]
    """Indices of the points on the surface, and on no larger one."""

    def heights(self, points_m: Points) -> Float[np.ndarray, " n"]:
        """Return the heights of points above the surface, in meters."""
        return points_m @ self.plane[:3] + self.plane[3]


def fit_plane(points_m: Points, tolerance_m: float) -> tuple[Plane, Int[np.ndarray, " k"]]:
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
    points_m: Points,
    up: Vector,
    *,
    eye_m: Vector | None = None,
    tolerance_m: float = TOLERANCE_M,
    min_points: int = MIN_PLANE_POINTS,
    max_planes: int | None = None,
) -> list[SupportPlane]:
    """Return the horizontal surfaces of a scene, the largest first; the others are parallel to it.

    `up` is the vertical, or, with the position `eye_m` of a camera that looks down at the scene,
    the camera's upward direction (-y), which may be far from the vertical.
    """
    points_m = np.asarray(points_m, float)
    rest = np.arange(len(points_m))
    rest = rest[:: max(1, -(-len(rest) // MAX_SAMPLED))]
    surfaces: list[SupportPlane] = []
    upward = up / np.linalg.norm(up)
    max_angle = PARALLEL_DEG if eye_m is None else MAX_TILT_DEG
    for _ in range(MAX_FITS):
        if len(rest) < max(min_points, 3) or len(surfaces) == max_planes:
            break
        plane, inliers = fit_plane(points_m[rest], tolerance_m)
        if len(inliers) < min_points:
            break
        side = plane[:3] @ upward if eye_m is None else plane[:3] @ eye_m + plane[3]
        plane = plane if side > 0 else -plane
        on = rest[inliers]
        rest = np.delete(rest, inliers)
        angle = np.degrees(np.arccos(np.clip(plane[:3] @ upward, -1, 1)))
        if angle > max_angle or (surfaces and area_of(points_m[on], plane) < MIN_AREA_M2):
            continue
        upward, max_angle = (plane[:3], PARALLEL_DEG) if not surfaces else (upward, max_angle)
        near = np.abs(points_m @ plane[:3] + plane[3]) <= tolerance_m
        for larger in surfaces:
            near[larger.inliers] = False
        surfaces.append(SupportPlane(plane=plane, inliers=np.flatnonzero(near)))
    return surfaces


def main_support(state: SceneState, world_from_camera: Pose) -> Plane | None:
    """Return the support plane that most background points are on, if there is one.

    The camera looks down at it. The tabletop world's table is at z = 0.
    """
    up, eye_m = upward(state, world_from_camera)
    if eye_m is None:
        return np.array([*up, 0.0])
    planes = support_planes(_background(state), up, eye_m=eye_m, max_planes=1)
    return planes[0].plane if planes else None


def vertical(state: SceneState, world_from_camera: Pose | None = None) -> Vector:
    """Return the unit vector that points up in a state's world.

    It is the normal of the main support; without one, the camera's upward direction. Without a
    camera, it is z or -y, whichever is nearer to the normal of the largest plane, on the side of
    most other points; without a plane, -y.
    """
    up, eye_m = upward(state, np.eye(4) if world_from_camera is None else world_from_camera)
    if eye_m is None:
        return up
    if world_from_camera is not None:
        plane = main_support(state, world_from_camera)
        return up / np.linalg.norm(up) if plane is None else plane[:3]
    points = _background(state)
    if len(points) < MIN_PLANE_POINTS:
        return np.array(UP_AXES["-y"])
    plane, _ = fit_plane(points, TOLERANCE_M)
    heights = state.points_m @ plane[:3] + plane[3]
    above = np.sign(heights[np.abs(heights) > TOLERANCE_M]).sum() >= 0
    normal = plane[:3] if above else -plane[:3]
    return np.array(max(UP_AXES.values(), key=lambda axis: normal @ axis))


def _background(state: SceneState) -> Points:
    """Return some of the background points of a state."""
    points = state.points_m[state.object_ids == 0].astype(float)
    return points[:: max(1, len(points) // MAX_MAIN_POINTS)]


def area_of(points_m: Points, plane: Plane) -> float:
    """Return the area that the points cover on the plane, in cells of 2 cm."""
    cell = 0.02
    side = np.linalg.svd(plane[None, :3])[2][1:]
    cells = np.unique(np.floor(points_m @ side.T / cell).astype(int), axis=0)
    return len(cells) * cell**2
