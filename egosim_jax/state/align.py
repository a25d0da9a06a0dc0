"""Bring what was reconstructed into the world: from points, from cameras, and by refinement.

Alignments are 4 x 4 matrices `world_from_there`, rigid or with one scale, applied as
p -> s R p + t. Source: EgoSim, section 3.3 (Sim(3) Umeyama alignment); the methods for cameras are
those of the released `reconstruct_from_artifacts`, whose default is rigid.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from egosim_jax.geometry import transform, umeyama
from egosim_jax.types import InputError

Freedom = Literal["rigid", "similarity"]
"""Six degrees of freedom, or seven with a scale."""
CameraMethod = Literal["centers", "orientations", "orientations and scale"]
"""Umeyama on camera centers with a scale; or the mean rotation between the cameras, and then the
translation between their centers, without or with a scale."""

ROUNDS, SAMPLE = 500, 3
"""Of RANSAC: trials, and points that determine a motion."""
REFINEMENTS = 30
"""Rounds of ICP at most."""


def align_points(
    points: Float[np.ndarray, "n 3"],
    targets: Float[np.ndarray, "n 3"],
    *,
    freedom: Freedom = "rigid",
    tolerance_m: float,
    seed: int = 0,
) -> Float[np.ndarray, "4 4"]:
    """The motion that takes points to their targets, of which some may be wrong.

    RANSAC: the motion of three pairs that brings most pairs within `tolerance_m`, fitted again to
    all of those. Raises `InputError` if fewer than half of the pairs agree on any.
    """
    _check_finite(points, targets)
    scaled = freedom == "similarity"
    rng = np.random.default_rng(seed)
    best = np.zeros(len(points), bool)
    for _ in range(ROUNDS):
        chosen = rng.choice(len(points), min(SAMPLE, len(points)), replace=False)
        try:
            motion = umeyama(points[chosen], targets[chosen], scaled=scaled)
        except InputError:
            continue  # three points in line
        near = _within(motion, points, targets, tolerance_m)
        if near.sum() > best.sum():
            best = near
    if 2 * best.sum() < len(points) or best.sum() < SAMPLE:
        raise InputError(
            f"No motion brings half of {len(points)} points within {tolerance_m} m of where they "
            f"should be; the best brings {best.sum()}."
        )
    motion = umeyama(points[best], targets[best], scaled=scaled)
    near = _within(motion, points, targets, tolerance_m)
    return umeyama(points[near], targets[near], scaled=scaled)


def align_cameras(
    there_from_camera: Float[np.ndarray, "f 4 4"],
    world_from_camera: Float[np.ndarray, "f 4 4"],
    *,
    method: CameraMethod = "orientations",
) -> Float[np.ndarray, "4 4"]:
    """`world_from_there` of a reconstruction whose cameras are known in both.

    From orientations it takes one camera (two for a scale), from centers alone three that are not
    in line. A scale that two centers at one place leave open is 1.
    """
    _check_finite(there_from_camera, world_from_camera)
    here, there = world_from_camera[:, :3, 3], there_from_camera[:, :3, 3]
    if method == "centers":
        return umeyama(there, here, scaled=True)
    products = world_from_camera[:, :3, :3] @ there_from_camera[:, :3, :3].swapaxes(1, 2)
    u, _, vt = np.linalg.svd(products.sum(axis=0))
    motion = np.eye(4)
    motion[:3, :3] = (u * [1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
    if method == "orientations and scale":
        turned = (there - there.mean(axis=0)) @ motion[:3, :3].T
        spread = np.square(turned).sum()
        scale = (turned * (here - here.mean(axis=0))).sum() / spread if spread > 1e-12 else 1.0
        motion[:3, :3] *= scale if 0 < scale <= 100 else 1.0
    motion[:3, 3] = here.mean(axis=0) - motion[:3, :3] @ there.mean(axis=0)
    return motion


def refine(
    points: Float[np.ndarray, "n 3"],
    surface: Float[np.ndarray, "m 3"],
    *,
    start: Float[np.ndarray, "4 4"],
    radius_m: float,
    freedom: Freedom = "rigid",
) -> Float[np.ndarray, "4 4"]:
    """`start`, improved by ICP until every point within `radius_m` of the surface lies on it.

    Raises `InputError` if none is near at the start.
    """
    import open3d as o3d

    _check_finite(points, surface)
    source, target = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
    source.points = o3d.utility.Vector3dVector(points)
    target.points = o3d.utility.Vector3dVector(surface)
    registration = o3d.pipelines.registration
    found = registration.registration_icp(
        source,
        target,
        radius_m,
        start,
        registration.TransformationEstimationPointToPoint(freedom == "similarity"),
        registration.ICPConvergenceCriteria(max_iteration=REFINEMENTS),
    )
    if not found.fitness:
        raise InputError(
            f"None of {len(points)} points lies within {radius_m} m of the surface: the alignment "
            "to start from is too far off."
        )
    return np.array(found.transformation)


def _within(
    motion: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "n 3"],
    targets: Float[np.ndarray, "n 3"],
    tolerance_m: float,
) -> np.ndarray:
    return np.linalg.norm(transform(motion, points) - targets, axis=1) <= tolerance_m


def _check_finite(*arrays: np.ndarray) -> None:
    for array in arrays:
        if not np.isfinite(array).all():
            bad = int(np.argmin(np.isfinite(array).all(axis=tuple(range(1, array.ndim)))))
            raise InputError(f"Row {bad} is not finite, and cannot be aligned: {array[bad]}.")
