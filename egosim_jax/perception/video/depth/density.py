"""Density of a scene's points for cameras that move towards it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from egosim_jax.geometry import invert, pixel_rays, pixels_of, transform
from egosim_jax.types import Cameras

STEP_PX = 8
"""Spacing of the sampled points in pixels."""
MIN_FRACTION = 0.02
"""Minimum fraction of magnified points, over all views, for a higher density."""
POINT_PX = 2
"""Size of drawn points in pixels, and so the magnification that opens gaps."""


def points_per_pixel(depth_m: Float[np.ndarray, "h w"], cameras: Cameras) -> int:
    """Return the number of points along each side of a first-frame pixel: 1 or 2.

    2 is for clips that see a part of the scene from less than half the first frame's distance. It
    is not the default because denser points look less sharp where nothing is magnified.
    """
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    finite = np.isfinite(depth_m[::STEP_PX, ::STEP_PX])
    depth = depth_m[::STEP_PX, ::STEP_PX][finite]
    points = transform(
        cameras.world_from_camera[0], rays[::STEP_PX, ::STEP_PX][finite] * depth[:, None]
    )
    local = transform(
        invert(cameras.world_from_camera),
        np.repeat(points[None], len(cameras.world_from_camera), 0),
    )
    _, _, inside = pixels_of(cameras, local)
    nearer = (local[..., 2] * POINT_PX < depth) & inside
    return 2 if nearer.sum() > MIN_FRACTION * inside.sum() else 1
