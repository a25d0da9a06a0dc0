"""Points of the scene, triangulated from corners that are followed through posed frames.

A point is where the rays of its track meet best: with centers c and unit directions d, it minimizes
the squared distances |(I - d d^T) (X - c)|^2, a linear system of three equations. For cameras that
are given, a device's or a dataset's, without points.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from egosim_jax.geometry import invert, project, transform
from egosim_jax.perception.cameras.flow import background
from egosim_jax.perception.estimates import SparsePoints
from egosim_jax.types import Cameras

STARTS = 6
"""Frames in which new corners are taken."""
MIN_FRAMES = 4
"""Fewest frames that observe a point."""
MIN_ANGLE_DEG = 1.0
"""Smallest angle between two rays of a point."""
MAX_ERROR_PX = 2.0
"""Largest mean reprojection error of a point."""


def triangulate(
    frames: UInt8[np.ndarray, "f h w 3"], moving: Bool[np.ndarray, "f h w"], cameras: Cameras
) -> SparsePoints | None:
    """Return points of the background with their observations; None if none can be trusted."""
    video = background(frames, moving)
    count = len(frames)
    points, errors, observed = [], [], []
    for start in sorted({int(k) for k in np.linspace(0, count - 1, STARTS + 1)[:-1]}):
        corners = video.corners(start)
        pixels = np.full((len(corners), count, 2), np.nan)
        pixels[:, start] = corners
        alive, here = np.arange(len(corners)), corners
        for frame in range(start, count - 1):
            here, found = video.follow(frame, frame + 1, here)
            alive, here = alive[found], here[found]
            pixels[alive, frame + 1] = here
        pixels = (pixels + 0.5) * video.reduction - 0.5
        for track in pixels:
            seen = np.flatnonzero(np.isfinite(track[:, 0]))
            if (found := _meet(track[seen], cameras, seen)) is not None:
                points.append(found[0])
                errors.append(found[1])
                observed.append((seen, track[seen]))
    if not points:
        return None
    lengths = [len(seen) for seen, _ in observed]
    return SparsePoints(
        points_m=np.array(points),
        error_px=np.array(errors),
        frames=np.concatenate([seen for seen, _ in observed]).astype(np.int32),
        indices=np.repeat(np.arange(len(points)), lengths).astype(np.int32),
        pixels_px=np.concatenate([pixels for _, pixels in observed]),
    )


def _meet(
    pixels: Float[np.ndarray, "n 2"], cameras: Cameras, seen: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " 3"], float] | None:
    """Return where the rays of a track meet, and its error in pixels; None if it is not sure."""
    if len(seen) < MIN_FRAMES:
        return None
    matrix, poses = cameras.intrinsics_px, cameras.world_from_camera[seen]
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1) @ np.linalg.inv(matrix).T
    rays = np.einsum("nij,nj->ni", poses[:, :3, :3], rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    system = across.sum(axis=0)
    if np.linalg.cond(system) > 1e8:
        return None
    point = np.linalg.solve(system, np.einsum("nij,nj->i", across, poses[:, :3, 3]))
    local = transform(invert(poses), np.broadcast_to(point, (len(seen), 1, 3)))[:, 0]
    if local[:, 2].min() <= 0:
        return None
    error = np.linalg.norm(np.stack(project(matrix, local), axis=1) - pixels, axis=1).mean()
    toward = point - poses[:, :3, 3]
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((toward @ toward.T).min(), -1, 1)))
    return (point, float(error)) if error < MAX_ERROR_PX and angle >= MIN_ANGLE_DEG else None
