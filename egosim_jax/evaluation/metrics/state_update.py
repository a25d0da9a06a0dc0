"""Accuracy of a scene state after an object moved, against the object's ground-truth surface.

All fractions are in percent. The definitions are ours; the paper does not evaluate the state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from egosim_jax.runtime.open3d import load_open3d, nearest

ON_SURFACE_M = 0.01
"""Maximum distance in meters of a point on a surface."""
SAME_POINT_M = 0.005
"""Maximum distance in meters of two points that count as the same."""


@dataclass(frozen=True, kw_only=True)
class ObjectAccuracy:
    """Accuracy of the points of one object after a state update, in percent."""

    accurate: float
    """Percentage of the object's points within 1 cm of its ground-truth surface after the move."""
    complete: float
    """Percentage of the object's observed surface within 1 cm of one of its points."""
    ghost: float
    """Percentage of earlier points off the new surface that are still present (ghost points)."""


def object_accuracy(
    before_m: Float32[np.ndarray, "n 3"],
    after_m: Float32[np.ndarray, "m 3"],
    *,
    surface: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]],
    seen_m: Float[np.ndarray, "k 3"],
) -> ObjectAccuracy:
    """Compare an object's points before and after the move with its mesh and observed surface.

    `surface` and `seen_m` are at the object's pose after the move. A state without points of the
    object has accuracy and completeness 0. An object that did not move has no ghost points (0).
    """
    off = distance_to_mesh(before_m, surface) > ON_SURFACE_M
    return ObjectAccuracy(
        accurate=_percent(distance_to_mesh(after_m, surface) <= ON_SURFACE_M),
        complete=_percent(nearest(seen_m, after_m) <= ON_SURFACE_M),
        ghost=_percent(nearest(before_m[off], after_m) <= SAME_POINT_M),
    )


def symmetric_distance(
    points_m: Float[np.ndarray, "n 3"],
    others_m: Float[np.ndarray, "m 3"],
    *,
    quantile: float = 0.95,
) -> float:
    """Return the quantile of nearest-neighbor distances in meters, maximum of both directions.

    Infinite if either set is empty.
    """
    if not len(points_m) or not len(others_m):
        return float("inf")
    distances = (nearest(points_m, others_m), nearest(others_m, points_m))
    return max(float(np.quantile(one, quantile)) for one in distances)


def distance_to_mesh(
    points_m: Float[np.ndarray, "n 3"],
    surface: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]],
) -> Float32[np.ndarray, " n"]:
    """Return the distance of each point from the nearest triangle, in meters."""
    o3d = load_open3d()

    scene = o3d.t.geometry.RaycastingScene()
    vertices, triangles = surface
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32))
    )
    return scene.compute_distance(o3d.core.Tensor(points_m.astype(np.float32))).numpy()


def _percent(good: np.ndarray) -> float:
    return 100 * float(good.mean()) if len(good) else 0.0
