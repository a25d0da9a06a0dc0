"""Density of the points of a scene that cameras come near to."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from egosim_jax.geometry import invert, pixel_rays, pixels_of, transform
from egosim_jax.types import Cameras

STEP_PX = 8
"""Distance in pixels of the points that are looked at."""
SHARE = 0.02
"""Least share of the views of points that counts."""
POINT_PX = 2
"""Size in pixels at which points are drawn, and so the magnification that opens gaps."""


def points_per_pixel(depth_m: Float[np.ndarray, "h w"], cameras: Cameras) -> int:
    """Return how many points along each side of a pixel of the first frame later frames need.

    One, unless some frame sees a part of the scene from less than half the first frame's distance:
    then two. Denser points are drawn less sharply where nothing is magnified.
    """
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    known = np.isfinite(depth_m[::STEP_PX, ::STEP_PX])
    depth = depth_m[::STEP_PX, ::STEP_PX][known]
    points = transform(
        cameras.world_from_camera[0], rays[::STEP_PX, ::STEP_PX][known] * depth[:, None]
    )
    local = transform(
        invert(cameras.world_from_camera),
        np.repeat(points[None], len(cameras.world_from_camera), 0),
    )
    _, _, inside = pixels_of(cameras, local)
    nearer = (local[..., 2] * POINT_PX < depth) & inside
    return 2 if nearer.sum() > SHARE * inside.sum() else 1
