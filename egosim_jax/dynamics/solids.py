"""Solids of a state: convex hulls of the objects, completed where no camera sees them.

A solid is in level coordinates: z is up, and the main support, such as a table, is at z = 0. Only
the visible side of an object has points. Its hidden side reaches down to its support.
An object without a flat top, such as a ball, is as deep as it is wide.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from egosim_jax.geometry import invert, transform
from egosim_jax.types.arrays import Plane, Points, Pose, Vector

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

MAX_POINTS = 300
"""Approximate maximum number of points that determine a hull."""
FLAT_M = 0.004
"""Thickness of the layer of an object's top that shows whether it is flat, in meters."""
FLAT_SHARE = 0.12
"""Minimum fraction of an object's points in that layer if its top is flat."""
HOLE_M = 0.006
"""Minimum distance of a hole's points from an object's visible points, from above, in meters."""
NEAR_SUPPORT_M = 0.02
"""Maximum height above a support at which an object stands on it, in meters.

Another object may hide its lowest points."""


@dataclass(frozen=True, kw_only=True)
class Solid:
    """An object as it is in the first frame."""

    number: int
    """Id of the object."""
    points_m: Float[np.ndarray, "n 3"]
    """Visible points."""
    faces: Float[np.ndarray, "m 4"]
    """Outward planes of the hull: unit normal, and offset."""
    corners_m: Float[np.ndarray, "k 3"]
    """Corners of the hull."""
    base_m: float
    """Height of the support, or of the lowest point of an object in a hand."""
    lifted_m: float = 0.0
    """Height of an object in a hand above the place where it last rested."""

    @cached_property
    def center_m(self) -> Vector:
        """Middle of the box around the hull."""
        return (self.corners_m.min(axis=0) + self.corners_m.max(axis=0)) / 2

    @cached_property
    def radius_m(self) -> float:
        """Radius of the ball around the hull."""
        return float(np.linalg.norm(self.corners_m - self.center_m, axis=1).max())

    @cached_property
    def gyration_m(self) -> float:
        """Radius of gyration of the pressure under the solid, about a vertical axis."""
        flat = self.corners_m[:, :2] - self.center_m[:2]
        return 0.6 * float(np.linalg.norm(flat, axis=1).mean())

    def lifted(self, pose: Pose) -> Solid:
        """Return the solid of an object in a hand that rested before it was moved to a pose."""
        normals = self.faces[:, :3] @ pose[:3, :3].T
        corners = transform(pose, self.corners_m)
        return replace(
            self,
            points_m=transform(pose, self.points_m),
            faces=np.c_[normals, self.faces[:, 3] - normals @ pose[:3, 3]],
            corners_m=corners,
            base_m=float(corners[:, 2].min()),
            lifted_m=float((transform(pose, self.center_m[None])[0] - self.center_m)[2]),
        )

    def distance(self, points_m: Float[np.ndarray, "p 3"], pose: Pose) -> Float[np.ndarray, " p"]:
        """Return signed distances in meters from the hull, moved by a pose; negative inside.

        Outside of an edge they are too small.
        """
        local = transform(invert(pose), points_m)
        return (local @ self.faces[:, :3].T + self.faces[:, 3]).max(axis=1)

    def normal(self, point_m: Vector, pose: Pose) -> tuple[float, Vector]:
        """Return the signed distance of a point, and the outward normal of the nearest face."""
        local = transform(invert(pose), point_m[None])[0]
        distances = self.faces[:, :3] @ local + self.faces[:, 3]
        nearest = int(distances.argmax())
        return float(distances[nearest]), pose[:3, :3] @ self.faces[nearest, :3]

    def is_open_at(self, point_m: Vector, pose: Pose) -> bool:
        """Return True if no visible point is above or below a point: it is in a ring's hole."""
        local = transform(invert(pose), point_m[None])[0]
        return bool(np.linalg.norm((self.points_m - local)[:, :2], axis=1).min() > HOLE_M)

    def width_along(self, way: Vector, pose: Pose) -> float:
        """Return the extent of the hull along a unit vector, in meters."""
        return float(np.ptp(self.corners_m @ (pose[:3, :3].T @ way)))


def make_solid(number: int, points_m: Points, *, base_m: float, eye_m: Vector) -> Solid | None:
    """Return the solid of an object's points; None if they span no volume.

    `eye_m` is the camera that saw them.
    """
    points = points_m[:: max(1, len(points_m) // MAX_POINTS)]
    points = np.concatenate([points, _hidden_side(points, eye_m)])
    hull = hull_on_plane(points, np.array([0, 0, 1, -min(base_m, float(points[:, 2].min()))]))
    if hull is None:
        return None
    return Solid(
        number=number,
        points_m=points_m,
        faces=np.unique(hull.equations.round(9), axis=0),
        corners_m=hull.points[hull.vertices],
        base_m=base_m,
    )


def hull_on_plane(points_m: Points, plane: Plane) -> ConvexHull | None:
    """Return the hull of points and of their feet on a plane; None if they span no volume.

    A camera above an object sees no point of its underside.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = points_m[:: max(1, len(points_m) // MAX_POINTS)]
    feet = points - (points @ plane[:3] + plane[3])[:, None] * plane[:3]
    try:
        return ConvexHull(np.concatenate([points, feet]))
    except (QhullError, ValueError):
        return None


def _hidden_side(points_m: Points, eye_m: Vector) -> Float[np.ndarray, "k 3"]:
    """Return points of the back of an object that has no flat top; none for a flat top.

    The front, rotated by half a turn about the vertical, is the back, as far away as makes the
    object as deep as it is wide.
    """
    top = points_m[:, 2].max()
    if (points_m[:, 2] > top - FLAT_M).mean() >= FLAT_SHARE:
        return np.empty((0, 3))
    away = (points_m.mean(axis=0) - eye_m)[:2]
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    across = np.array([-away[1], away[0]])
    deep, wide = points_m[:, :2] @ away, points_m[:, :2] @ across
    width = np.ptp(wide)
    if np.ptp(deep) >= width:
        return np.empty((0, 3))
    center = (deep.min() + width / 2) * away + (wide.min() + wide.max()) / 2 * across
    back = points_m.copy()
    back[:, :2] = 2 * center - points_m[:, :2]
    return back
