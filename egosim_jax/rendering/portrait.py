"""A scene state drawn from the left, the front and the right."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from egosim_jax.geometry import look_at
from egosim_jax.io.atomic import atomic_write
from egosim_jax.rendering.reference import render
from egosim_jax.types import Cameras, SceneState

Up = Literal["z", "-y"]
"""Axis of the world that points up: z in the tabletop world, -y in EgoSim's first camera."""
UP_AXES: dict[Up, tuple[float, float, float]] = {"z": (0.0, 0.0, 1.0), "-y": (0.0, -1.0, 0.0)}
"""Unit vector of each axis that may point up."""
SIDES, ABOVE = (-40.0, 0.0, 40.0), 30.0
"""Angles of the cameras in degrees: around the vertical axis, and above the horizon."""
DISTANCE, FIELD_OF_VIEW = 3.0, 50.0
"""Distance of the cameras in radii, and horizontal field of view in degrees.

Three quarters of the points are within the radius.
"""
HEIGHT, WIDTH = 480, 640


def up_of(state: SceneState) -> Up:
    """Return the axis that points up in a state's world, by its provenance."""
    return "z" if state.provenance.get("world") == "tabletop" else "-y"


def write_portrait(path: Path, state: SceneState, *, up: Up) -> None:
    """Write an image of a state from the left, the front and the right, in a row."""
    with atomic_write(path) as temporary:
        Image.fromarray(np.concatenate(list(portrait(state, up=up)), axis=1)).save(temporary)


def portrait(state: SceneState, *, up: Up) -> UInt8[np.ndarray, "3 480 640 3"]:
    """Return images of a state from the left, the front and the right, slightly from above.

    The front view looks the way a wearer does: along y if z is up, along z if -y is up. The point
    size is the distance between neighboring points.
    """
    import open3d as o3d

    upward = np.array(UP_AXES[up])
    forward = np.array({"z": (0.0, 1.0, 0.0), "-y": (0.0, 0.0, 1.0)}[up])
    rightward = np.cross(forward, upward)
    middle = np.median(state.points_m, axis=0).astype(float)
    radius = float(np.quantile(np.linalg.norm(state.points_m - middle, axis=1), 0.75))
    distance = DISTANCE * max(radius, 1e-6)
    poses = []
    for side in np.radians(SIDES):
        level = np.cos(side) * forward - np.sin(side) * rightward
        above = np.radians(ABOVE)
        eye = middle + distance * (np.sin(above) * upward - np.cos(above) * level)
        poses.append(look_at(eye, middle, up=upward))
    focal = WIDTH / 2 / np.tan(np.radians(FIELD_OF_VIEW / 2))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(state.points_m))
    spacing = float(np.median(cloud.compute_nearest_neighbor_distance()))
    cameras = Cameras(
        world_from_camera=np.array(poses),
        intrinsics_px=np.array(
            [[focal, 0, (WIDTH - 1) / 2], [0, focal, (HEIGHT - 1) / 2], [0, 0, 1]]
        ),
        height=HEIGHT,
        width=WIDTH,
    )
    return render(state, cameras, point_px=1 + round(2 * focal * spacing / distance)).frames
