"""Depth that is assumed where nothing measures it: a plane before a camera that does not move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egosim_jax.geometry import invert, pixel_rays
from egosim_jax.perception.estimates import CameraEstimate, DepthEstimate
from egosim_jax.types import Cameras

MAX_DEPTH = 10.0
"""Depth in units of the plane's distance beyond which a turned camera's view of it is unknown."""


def has_parallax(estimate: CameraEstimate) -> bool:
    """Return True if the cameras have moved, and not only turned."""
    if estimate.cameras is None or estimate.verdict.rung in ("static", "rotation"):
        return False
    places = estimate.cameras.world_from_camera[:, :3, 3]
    return bool(np.ptp(places, axis=0).max() > 0)


def plane_depth_estimate(
    estimate: CameraEstimate, cameras: Cameras, wanted: Sequence[int], *, distance: float = 1.0
) -> DepthEstimate:
    """Return the depth of a plane across the first camera's view, at a distance in its unit.

    No pixel is confident. The scale from hands then puts the plane where hands touch it, and a
    prior that is rendered from it is the first frame, turned as the camera turns.
    """
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    depths = []
    for frame in wanted:
        first = invert(cameras.world_from_camera[0]) @ cameras.world_from_camera[frame]
        with np.errstate(divide="ignore"):
            depth = (distance - first[2, 3]) / (rays @ first[2, :3])
        met = (depth > 0) & (depth < MAX_DEPTH * distance)
        depths.append(np.where(met, depth, np.inf).astype(np.float32))
    return DepthEstimate(
        frames=np.array(wanted, np.int32),
        depth_m=np.stack(depths),
        confident=np.zeros((len(depths), cameras.height, cameras.width), bool),
        metric=False,
        reason=f"assumed: the camera does not change its place ({estimate.verdict.rung}), so that "
        "depth cannot be measured; a plane at the distance of the hands stands for the scene",
    )
