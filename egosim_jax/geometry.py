"""Rigid motions and the pinhole camera, for NumPy arrays and jax's alike.

Cameras follow OpenCV: x right, y down, z forward, in meters, with pixel centers at integer
coordinates. A matrix `a_from_b` takes coordinates in b to coordinates in a, so that
`a_from_c = a_from_b @ b_from_c`.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from egosim_jax.types import Cameras, InputError


def transform(a_from_b: Float[Any, "*#b 4 4"], points: Float[Any, "*#b n 3"]) -> Any:
    """The points `*b n 3` of b, in a."""
    return points @ a_from_b[..., :3, :3].swapaxes(-1, -2) + a_from_b[..., None, :3, 3]


def invert(a_from_b: Float[np.ndarray, "*b 4 4"]) -> Float[np.ndarray, "*b 4 4"]:
    """`b_from_a` of a rigid motion."""
    inverse = np.zeros_like(a_from_b)
    rotation = a_from_b[..., :3, :3].swapaxes(-1, -2)
    inverse[..., :3, :3] = rotation
    inverse[..., :3, 3:] = -rotation @ a_from_b[..., :3, 3:]
    inverse[..., 3, 3] = 1
    return inverse


def project(intrinsics_px: Float[Any, "3 3"], points: Float[Any, "*b n 3"]) -> tuple[Any, Any]:
    """Columns and rows, each `*b n`, at which a camera sees points of its own coordinates.

    Points at depth 0 come out infinite or NaN, those behind the camera mirrored: look at z first.
    """
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    focal_x, focal_y = intrinsics_px[0, 0], intrinsics_px[1, 1]
    return focal_x * x / z + intrinsics_px[0, 2], focal_y * y / z + intrinsics_px[1, 2]


def pixels_of(
    cameras: Cameras, points: Float[np.ndarray, "*b n 3"]
) -> tuple[Int[np.ndarray, "*b n"], Int[np.ndarray, "*b n"], Bool[np.ndarray, "*b n"]]:
    """Row and column of the pixel that points of a camera's coordinates fall into.

    And whether they do: those behind the camera or beside the picture have row and column 0.
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
    """The direction of each pixel in camera coordinates, with z = 1: times a depth, its point."""
    rows, columns = np.mgrid[:height, :width].astype(np.float64)
    x = (columns - intrinsics_px[0, 2]) / intrinsics_px[0, 0]
    y = (rows - intrinsics_px[1, 2]) / intrinsics_px[1, 1]
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def finer(intrinsics_px: Float[np.ndarray, "3 3"], times: int) -> Float[np.ndarray, "3 3"]:
    """The same camera with each pixel split into `times` x `times`.

    The centers of pixel i's parts lie around `times` i + (`times` - 1) / 2.
    """
    split = intrinsics_px.copy()
    split[:2] *= times
    split[:2, 2] += (times - 1) / 2
    return split


def turned(radians: float) -> Float[np.ndarray, "3 3"]:
    """Rotation about z, from x towards y."""
    cosine, sine = np.cos(radians), np.sin(radians)
    return np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])


def look_at(
    eye: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"], *, up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """`world_from_camera` of a camera at `eye` that has `target` in the middle and `up` above."""
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
    """The motion that brings points nearest to their targets in the least squares sense.

    Rotation, translation and, if `scaled`, one positive scale; never a reflection. Source: Umeyama
    1991, equations 40 to 43. Raises `InputError` if the points do not determine it: fewer than
    three, or all on one line.
    """
    middle, aim = points.mean(axis=0), targets.mean(axis=0)
    centerd, aimed = points - middle, targets - aim
    u, strength, vt = np.linalg.svd(aimed.T @ centerd / len(points))
    if len(points) < 3 or strength[1] <= 1e-12 * max(strength[0], 1e-300):
        raise InputError(
            f"{len(points)} points do not determine a motion: it needs at least three that are "
            "non-collinear."
        )
    signs = np.array([1, 1, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    motion = np.eye(4)
    motion[:3, :3] = (u * signs) @ vt
    if scaled:
        motion[:3, :3] *= (strength * signs).sum() / np.square(centerd).sum(axis=1).mean()
    motion[:3, 3] = aim - motion[:3, :3] @ middle
    return motion


def beside(cameras: Cameras, world_from_object: Float[np.ndarray, "f 4 4"]) -> Cameras:
    """The cameras in the coordinates of a thing that moves."""
    poses = invert(world_from_object) @ cameras.world_from_camera
    return replace(cameras, world_from_camera=poses)
