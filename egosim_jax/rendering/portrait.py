"""A scene state drawn from the left, the front and the right."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from egosim_jax.geometry import level_axes, look_at
from egosim_jax.io.atomic import atomic_write
from egosim_jax.rendering.reference import render
from egosim_jax.runtime.open3d import point_cloud
from egosim_jax.types import Cameras, SceneState

SIDES, ABOVE = (-40.0, 0.0, 40.0), 30.0
"""Angles of the cameras in degrees: around the vertical axis, and above the horizon."""
DISTANCE, FIELD_OF_VIEW = 3.0, 50.0
"""Distance of the cameras in radii, and horizontal field of view in degrees.

Three quarters of the points are within the radius.
"""
HEIGHT, WIDTH = 480, 640
MIN_RADIUS_M, MAX_RADIUS_M = 0.02, 20.0
"""Smallest and largest radius that is drawn as it is; the renderer draws from 1 cm to 100 m."""
MAX_POINT_PX = 16
"""Maximum size of a point in pixels: a sparse cloud would be slow, and hide itself."""


def write_portrait(path: Path, state: SceneState, *, up: Float[np.ndarray, " 3"]) -> None:
    """Write an image of a state from the left, the front and the right, in a row."""
    with atomic_write(path) as temporary:
        Image.fromarray(np.concatenate(list(portrait(state, up=up)), axis=1)).save(temporary)


def portrait(state: SceneState, *, up: Float[np.ndarray, " 3"]) -> UInt8[np.ndarray, "3 480 640 3"]:
    """Return images of a state from the left, the front and the right, slightly from above.

    The front view looks the way a wearer does: along y if z is up, along z if -y is up
    (`level_axes`). The point size is the distance between neighboring points, up to `MAX_POINT_PX`.
    """
    rightward, forward, upward = level_axes(up).T
    middle = np.median(state.points_m, axis=0).astype(float)
    points = state.points_m.astype(float)
    radius = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.75)) or 1.0
    if not MIN_RADIUS_M <= radius <= MAX_RADIUS_M:  # in another unit, or nearly one point
        points, middle, radius = (points - middle) / radius, np.zeros(3), 1.0
        state = replace(state, points_m=points.astype(np.float32))
    distance = DISTANCE * radius
    poses = []
    for side in np.radians(SIDES):
        level = np.cos(side) * forward - np.sin(side) * rightward
        above = np.radians(ABOVE)
        eye = middle + distance * (np.sin(above) * upward - np.cos(above) * level)
        poses.append(look_at(eye, middle, up=upward))
    focal = WIDTH / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2))
    cloud = point_cloud(state.points_m)
    spacing = float(np.median(cloud.compute_nearest_neighbor_distance()))
    cameras = Cameras(
        world_from_camera=np.array(poses),
        intrinsics_px=np.array(
            [[focal, 0, (WIDTH - 1) / 2], [0, focal, (HEIGHT - 1) / 2], [0, 0, 1]]
        ),
        height=HEIGHT,
        width=WIDTH,
    )
    point_px = min(1 + round(2 * focal * spacing / distance), MAX_POINT_PX)
    return render(state, cameras, point_px=point_px).frames
