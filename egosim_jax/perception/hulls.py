"""Convex hull of an object: where its hidden sides may be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

MAX_POINTS = 400
"""Approximate maximum number of points that determine a hull."""


def hull_on_plane(
    points_m: Float[np.ndarray, "n 3"], plane: Float[np.ndarray, " 4"]
) -> Float[np.ndarray, "m 4"] | None:
    """Return the outward planes of the faces of a hull of points and of their feet on a plane.

    The hull reaches down to the supporting plane, because a camera above an object sees none of the
    points there. Without a plane (an offset of NaN) it has the points alone. None if the points do
    not span a volume.
    """
    from scipy.spatial import ConvexHull, QhullError

    points = points_m[:: max(1, len(points_m) // MAX_POINTS)]
    if np.isfinite(plane).all():
        feet = points - (points @ plane[:3] + plane[3])[:, None] * plane[:3]
        points = np.concatenate([points, feet])
    try:
        return ConvexHull(points).equations
    except (QhullError, ValueError):
        return None
