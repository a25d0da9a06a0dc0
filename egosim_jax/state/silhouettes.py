"""Colors of background points at the silhouettes of objects.

A pixel at a silhouette mixes the colors of an object and of the background behind it. Once the
object has moved, its color would stay there as a ring on the background.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int, UInt8

from egosim_jax.geometry import invert, project, transform
from egosim_jax.types.arrays import Matrix, Points, Pose

MIXED_PX = 1.0
"""Maximum distance of mixed colors from an object, along rows and columns, in pixels."""
NEIGHBORS = 5
"""Number of neighbors whose median color replaces a mixed one."""
MAX_OFF_MIX = 15.0
"""Maximum distance of a color from a mix of two, in 8-bit levels of its farthest channel."""
MIN_DEPTH_M = 0.01
"""Minimum depth of a point that a camera sees, in meters."""


def unmix_colors(
    points_m: Points,
    colors: UInt8[np.ndarray, "n 3"],
    object_ids: Int[np.ndarray, " n"],
    world_from_camera: Pose,
    intrinsics_px: Matrix,
) -> UInt8[np.ndarray, "n 3"]:
    """Return the colors, with mixed ones of the background replaced by colors of farther points.

    A background point (id 0) within `MIXED_PX` of a point of an object (a positive id), as the
    camera sees them, gets the median color of the nearest background points that are farther from
    every object, if its color is a mix of that one and the object's. The image that gave the colors
    has the pixels of `intrinsics_px`.
    """
    from scipy.spatial import KDTree

    local = transform(invert(world_from_camera), points_m.astype(float))
    ahead = local[:, 2] > MIN_DEPTH_M
    objects, background = (
        np.flatnonzero(ahead & chosen) for chosen in (object_ids > 0, object_ids == 0)
    )
    if not len(objects):
        return colors
    pixels = np.stack(project(intrinsics_px, np.where(ahead[:, None], local, 1.0)), axis=1)
    apart, touched = KDTree(pixels[objects]).query(
        pixels[background], p=np.inf, distance_upper_bound=MIXED_PX + 1e-3
    )
    near = np.isfinite(apart)
    edge, clean = background[near], background[~near]
    if not len(edge) or len(clean) < NEIGHBORS:
        return colors
    nearest = np.asarray(KDTree(points_m[clean]).query(points_m[edge], k=NEIGHBORS)[1])
    behind = np.median(colors[clean[nearest]].astype(float), axis=1)
    mixed = _is_mix(colors[edge], behind, colors[objects[np.asarray(touched)[near]]].astype(float))
    unmixed = colors.copy()
    unmixed[edge[mixed]] = np.round(behind[mixed])
    return unmixed


def _is_mix(colors: UInt8[np.ndarray, "n 3"], a: Points, b: Points) -> Bool[np.ndarray, " n"]:
    """Return which colors are within `MAX_OFF_MIX` of the line from color a to color b."""
    way = b - a
    share = ((colors - a) * way).sum(axis=1) / np.maximum((way**2).sum(axis=1), 1.0)
    off = colors - a - np.clip(share, 0, 1)[:, None] * way
    return np.abs(off).max(axis=1) <= MAX_OFF_MIX
