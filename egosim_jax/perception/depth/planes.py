"""Depth that is assumed where nothing measures it: a plane before a camera that does not move."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from egosim_jax.geometry import invert, pixel_rays
from egosim_jax.perception.estimates import CameraEstimate, DepthEstimate
from egosim_jax.types import Cameras

METRIC_DISTANCE_M = 0.6
"""Distance of the plane from cameras in meters."""
MAX_DEPTH = 10.0
"""Depth, in distances of the plane, beyond which a turned camera's view of it is unknown."""


def has_parallax(estimate: CameraEstimate) -> bool:
    """Return True if the cameras have moved, and not only turned."""
    if estimate.cameras is None or estimate.verdict.rung in ("static", "rotation"):
        return False
    places = estimate.cameras.world_from_camera[:, :3, 3]
    return bool(np.ptp(places, axis=0).max() > 0)


def plane_depth_estimate(
    estimate: CameraEstimate, cameras: Cameras, wanted: Sequence[int], *, why: str
) -> DepthEstimate:
    """Return the depth of a plane across the first camera's view, with the reason in words.

    No pixel is confident. The plane is at distance 1 of a camera whose unit is not known: the scale
    from hands then puts it where hands touch it. Metric cameras see it at `METRIC_DISTANCE_M`. A
    prior that is rendered from it is the first frame, turned as the camera turns.
    """
    distance = METRIC_DISTANCE_M if estimate.metric else 1.0
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
        metric=estimate.metric,
        reason=f"assumed, not measured: {why}; a plane across the first view replaces the scene",
    )
