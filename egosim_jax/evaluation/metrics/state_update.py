"""Accuracy of a scene state after an object moved, against the object's ground-truth surface.

All fractions are in percent. The definitions are ours; the paper does not evaluate the state.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int

from egosim_jax.runtime.open3d import load_open3d, nearest

ON_SURFACE_M = 0.01
"""Maximum distance in meters of a point on a surface."""
SAME_POINT_M = 0.005
"""Maximum distance in meters of two points that count as the same."""


def object_accuracy(
    before_m: Float32[np.ndarray, "n 3"],
    after_m: Float32[np.ndarray, "m 3"],
    *,
    surface: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]],
    seen_m: Float[np.ndarray, "k 3"],
) -> dict[str, float]:
    """Compare an object's points before and after the move with its mesh and observed surface.

    `surface` and `seen_m` are at the object's pose after the move. Returns the percentage of the
    object's points within 1 cm of the surface (`accuracy`), of the observed surface within 1 cm of
    one of its points (`completeness`), and of its earlier points off the surface that are still
    present (`ghost`). Without points or observed surface, a percentage is 0.
    """
    off = distance_to_mesh(before_m, surface) > ON_SURFACE_M
    return {
        "accuracy": _percent(distance_to_mesh(after_m, surface) <= ON_SURFACE_M),
        "completeness": _percent(nearest(seen_m, after_m) <= ON_SURFACE_M),
        "ghost": _percent(nearest(before_m[off], after_m) <= SAME_POINT_M),
    }


def symmetric_distance(
    points_m: Float[np.ndarray, "n 3"], others_m: Float[np.ndarray, "m 3"]
) -> float:
    """Return the 95 % quantile of nearest-neighbor distances in meters, maximum of both directions.

    Infinite if either set is empty.
    """
    if not len(points_m) or not len(others_m):
        return float("inf")
    distances = (nearest(points_m, others_m), nearest(others_m, points_m))
    return max(float(np.quantile(one, 0.95)) for one in distances)


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
