"""How well a state knows a thing that was moved, against the thing's true surface.

Shares are in percent. Source: the definitions are ours; the paper gives none for the state.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

NEAR_M, SAME_M = 0.01, 0.005
"""What is on a surface, and what is at the same place."""


@dataclass(frozen=True, kw_only=True)
class ThingAccuracy:
    """What became of one thing's points."""

    accurate: float
    """Share of its points within 1 cm of its true surface, where it is now."""
    complete: float
    """Share of its true surface that was seen, which has one of its points within 1 cm."""
    left: float
    """Share of its points from before that lie off its true surface and still are there."""


def thing_accuracy(
    before_m: Float32[np.ndarray, "n 3"],
    after_m: Float32[np.ndarray, "m 3"],
    *,
    surface: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]],
    seen_m: Float[np.ndarray, "k 3"],
) -> ThingAccuracy:
    """Compare a thing's points before and after with its true mesh and what was seen of it.

    `surface` and `seen_m` are where the thing is now. A state without points of it is neither
    accurate nor complete: 0; a thing that did not leave its place leaves nothing there: 0.
    """
    off = distance_to_mesh(before_m, surface) > NEAR_M
    return ThingAccuracy(
        accurate=_percent(distance_to_mesh(after_m, surface) <= NEAR_M),
        complete=_percent(nearest(seen_m, after_m) <= NEAR_M),
        left=_percent(nearest(before_m[off], after_m) <= SAME_M),
    )


def both_ways(
    points_m: Float[np.ndarray, "n 3"], others_m: Float[np.ndarray, "m 3"], *, share: float = 0.95
) -> float:
    """The larger of the two quantiles of nearest-neighbor distances, in meters.

    Infinite if there are no points on either side.
    """
    if not len(points_m) or not len(others_m):
        return float("inf")
    ways = (nearest(points_m, others_m), nearest(others_m, points_m))
    return max(float(np.quantile(way, share)) for way in ways)


def distance_to_mesh(
    points_m: Float[np.ndarray, "n 3"],
    surface: tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]],
) -> Float32[np.ndarray, " n"]:
    """Distance of each point from the nearest triangle."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    vertices, triangles = surface
    scene.add_triangles(
        o3d.core.Tensor(vertices.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32))
    )
    return scene.compute_distance(o3d.core.Tensor(points_m.astype(np.float32))).numpy()


def nearest(
    points_m: Float[np.ndarray, "n 3"], others_m: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, " n"]:
    """Distance of each point from the nearest of the others; infinite if there are none."""
    import open3d as o3d

    if not len(points_m) or not len(others_m):
        return np.full(len(points_m), np.inf)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (points_m, others_m)]
    return np.asarray(clouds[0].compute_point_cloud_distance(clouds[1]))


def _percent(good: np.ndarray) -> float:
    return 100 * float(good.mean()) if len(good) else 0.0
