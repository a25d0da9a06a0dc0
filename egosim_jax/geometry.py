"""Rigid transforms and the pinhole camera, for NumPy and JAX arrays.

Cameras follow OpenCV: x right, y down, z forward, in meters, with pixel centers at integer
coordinates. A matrix `a_from_b` takes coordinates in b to coordinates in a, so that
`a_from_c = a_from_b @ b_from_c`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from egosim_jax.types import Cameras, InputError, SceneState

Up = Literal["z", "-y"]
"""Axis of the world that points up: z in the tabletop world, -y in EgoSim's first camera."""
UP_AXES: dict[Up, tuple[float, float, float]] = {"z": (0.0, 0.0, 1.0), "-y": (0.0, -1.0, 0.0)}
"""Unit vector of each axis that may point up."""


def upward(
    state: SceneState, world_from_camera: Float[np.ndarray, "4 4"]
) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"] | None]:
    """Return the vertical of a state's world; or a camera's upward direction, and its position.

    Only the tabletop world says where up is. Others may have any axes, so a camera says it: its
    upward direction (-y) is up to 75 degrees from the vertical.
    """
    if state.provenance.get("world") == "tabletop":
        return np.array(UP_AXES["z"]), None
    return -world_from_camera[:3, 1], world_from_camera[:3, 3]


def level_axes(up: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the axes right, forward and up of a world, as columns, for its upward direction.

    Forward is the level direction nearest to y or z, whichever is farther from the vertical: y if z
    is up, z if -y is up.
    """
    up = up / np.linalg.norm(up)
    forward = np.eye(3)[1 + int(abs(up[1]) > abs(up[2]))]
    forward = forward - (forward @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([np.cross(forward, up), forward, up], axis=1)


def transform(a_from_b: Float[Any, "*#b 4 4"], points: Float[Any, "*#b n 3"]) -> Any:
    """Transform points `*b n 3` from frame b to frame a."""
    return points @ a_from_b[..., :3, :3].swapaxes(-1, -2) + a_from_b[..., None, :3, 3]


def invert(a_from_b: Float[np.ndarray, "*b 4 4"]) -> Float[np.ndarray, "*b 4 4"]:
    """Return the inverse `b_from_a` of a rigid transform."""
    inverse = np.zeros_like(a_from_b)
    rotation = a_from_b[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3:] = -rotation @ a_from_b[..., :3, 3:]
    inverse[..., 3, 3] = 1
    return inverse


def project(intrinsics_px: Float[Any, "3 3"], points: Float[Any, "*b n 3"]) -> tuple[Any, Any]:
    """Project points in camera coordinates; return columns and rows in pixels, each `*b n`.

    Check z first: points at depth 0 give infinity or NaN, points behind the camera are mirrored.
    """
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    focal_x, focal_y = intrinsics_px[0, 0], intrinsics_px[1, 1]
    return focal_x * x / z + intrinsics_px[0, 2], focal_y * y / z + intrinsics_px[1, 2]


def pixels_of(
    cameras: Cameras, points: Float[np.ndarray, "*b n 3"]
) -> tuple[Int[np.ndarray, "*b n"], Int[np.ndarray, "*b n"], Bool[np.ndarray, "*b n"]]:
    """Return row, column and visibility of the pixels that points in camera coordinates fall into.

    Points behind the camera or outside the image are not visible and have row and column 0.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = project(cameras.intrinsics_px, points)
        inside = (points[..., 2] > 0) & (u > -0.5) & (v > -0.5)
        inside &= (u < cameras.width - 0.5) & (v < cameras.height - 0.5)
    column, row = (np.rint(np.where(inside, x, 0)).astype(int) for x in (u, v))
    return row, column, inside


def pixel_rays(
    intrinsics_px: Float[np.ndarray, "3 3"], *, height: int, width: int
) -> Float[np.ndarray, "h w 3"]:
    """Return the ray of each pixel in camera coordinates, with z = 1; ray x depth is a point."""
    rays = np.ones((height, width, 3))
    rays[..., 0] = (np.arange(width) - intrinsics_px[0, 2]) / intrinsics_px[0, 0]
    rays[..., 1] = ((np.arange(height) - intrinsics_px[1, 2]) / intrinsics_px[1, 1])[:, None]
    return rays


def upsample_intrinsics(
    intrinsics_px: Float[np.ndarray, "3 3"], times: int
) -> Float[np.ndarray, "3 3"]:
    """Return the intrinsics of the same camera with each pixel split into `times` x `times`.

    The center of pixel i is at `times` i + (`times` - 1) / 2 afterwards.
    """
    split = intrinsics_px.copy()
    split[:2] *= times
    split[:2, 2] += (times - 1) / 2
    return split


def rotation_z(radians: float) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about z by an angle in radians, from x towards y."""
    cosine, sine = np.cos(radians), np.sin(radians)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def rotation_angles_deg(a_from_b: Float[np.ndarray, "*b 4 4"]) -> Float[Any, "*b"]:
    """Return the angle of the rotation of each rigid transform, in degrees."""
    cosines = (np.trace(a_from_b[..., :3, :3], axis1=-2, axis2=-1) - 1) / 2
    return np.degrees(np.arccos(np.clip(cosines, -1, 1)))


def smallest_rotation(
    start: Float[np.ndarray, "f 3"], end: Float[np.ndarray, "f 3"]
) -> Float[np.ndarray, "f 3 3"]:
    """Return the smallest rotation from one unit vector to another (Rodrigues' formula)."""
    x, y, z = np.cross(start, end).T
    cross = np.zeros((len(start), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = np.stack([x, y, z], axis=-1)
    cross[:, [1, 2, 0], [2, 0, 1]] = -np.stack([x, y, z], axis=-1)
    # Opposite vectors have no unique rotation; the bound keeps the result finite.
    cosine = np.maximum((start * end).sum(axis=-1), -0.999)
    return np.eye(3) + cross + cross @ cross / (1 + cosine)[:, None, None]


def hinge_rotation(
    axis: Float[np.ndarray, " 3"], point: Float[np.ndarray, " 3"], radians: float
) -> Float[np.ndarray, "4 4"]:
    """Return the rotation by an angle about a unit axis through a point (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = np.eye(4)
    turn[:3, :3] += np.sin(radians) * cross + (1 - np.cos(radians)) * cross @ cross
    turn[:3, 3] = point - turn[:3, :3] @ point
    return turn


def look_at(
    eye: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"], *, up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """Return `world_from_camera` of a camera at `eye` that looks at `target`, with `up` upwards."""
    forward = target - eye
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = eye
    return pose


def umeyama(
    points: Float[np.ndarray, "n 3"],
    targets: Float[np.ndarray, "n 3"],
    *,
    scaled: bool = False,
) -> Float[np.ndarray, "4 4"]:
    """Return the least-squares transform of points to targets: rigid, or with a scale if `scaled`.

    Never a reflection. Source: Umeyama 1991, equations 40 to 43. Raises `InputError` if the points
    do not determine it: fewer than three, or collinear.
    """
    center, target_center = points.mean(axis=0), targets.mean(axis=0)
    centered, targets = points - center, targets - target_center
    u, singular, vt = np.linalg.svd(targets.T @ centered / len(points))
    if len(points) < 3 or singular[1] <= 1e-12 * max(singular[0], 1e-300):
        raise InputError(
            f"{len(points)} points do not determine a transform: it needs at least three that are "
            "non-collinear."
        )
    signs = np.array([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    motion = np.eye(4)
    motion[:3, :3] = (u * signs) @ vt
    if scaled:
        motion[:3, :3] *= (singular * signs).sum() / np.square(centered).sum(axis=1).mean()
    motion[:3, 3] = target_center - motion[:3, :3] @ center
    return motion


def cameras_in_object_frame(
    cameras: Cameras, world_from_object: Float[np.ndarray, "f 4 4"]
) -> Cameras:
    """Return the cameras in the coordinates of a moving object."""
    poses = invert(world_from_object) @ cameras.world_from_camera
    return replace(cameras, world_from_camera=poses)
