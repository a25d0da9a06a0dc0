"""Mesh of a gripper over its three joints: two fingers, a palm between them, and a wrist.

Every limb is a tube with round ends, with a radius at each end. The sizes fit a gripper whose
tips are `REACH_M` from its wrist, and scale with it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.rendering.mesh import MovingMesh

REACH_M = 0.12
"""Distance from the wrist to the middle of the tips, in meters."""
KNUCKLE_M, HALF_PALM_M, WRIST_M = 0.045, 0.055, 0.02
"""Distances of palm and wrist's end from the wrist, and half the palm's width, in meters."""
RADII_M = np.array([[0.012, 0.010], [0.012, 0.010], [0.020, 0.020], [0.026, 0.026]])
"""Radii of both ends of the two fingers, the palm and the wrist, in meters."""
RUBBER, ENAMEL = (0.22, 0.22, 0.24), (0.16, 0.55, 0.60)
"""RGB of the fingers, and of palm and wrist, in [0, 1]."""
MIN_OPENING_M = 0.002
"""Minimum distance of the tips that shows the fingers' direction, in meters."""
SIDES, BANDS = 12, 4
"""Number of sides of a tube, and of bands of each of its round ends."""


def pose_grippers(joints_m: Float[np.ndarray, "f n 3 3"]) -> MovingMesh:
    """Return the mesh of n grippers: wrist, and the tips of two fingers, in each frame.

    A gripper with a non-finite joint is missing from that frame. Where its tips touch, its fingers
    have the direction of the nearest frame in which they do not.
    """
    wrist, tips = joints_m[:, :, 0], joints_m[:, :, 1:]
    along = tips.mean(axis=2) - wrist
    reach = np.linalg.norm(along, axis=-1, keepdims=True)
    along = along / np.maximum(reach, 1e-9)
    size = reach / REACH_M
    across = across_of(tips[:, :, 1] - tips[:, :, 0], along)
    knuckle = wrist + KNUCKLE_M * size * along
    limbs = [
        (knuckle + across * ((tip - knuckle) * across).sum(axis=-1, keepdims=True), tip)
        for tip in np.moveaxis(tips, 2, 0)
    ]
    limbs += [
        (knuckle - HALF_PALM_M * size * across, knuckle + HALF_PALM_M * size * across),
        (wrist - WRIST_M * size * along, knuckle),
    ]
    pieces = [
        _tube(start, end, size * radii) for (start, end), radii in zip(limbs, RADII_M, strict=True)
    ]
    vertices = np.stack(pieces, axis=2)  # frames, grippers, limbs, vertices, 3
    count, corners = vertices.shape[1] * len(limbs), vertices.shape[3]
    starts = corners * np.arange(count)[:, None, None]
    colors = np.repeat([RUBBER, RUBBER, ENAMEL, ENAMEL], corners, axis=0)
    return MovingMesh(
        vertices_m=vertices.reshape(len(joints_m), -1, 3),
        triangles=(_triangles() + starts).reshape(-1, 3),
        colors=np.tile(colors, (vertices.shape[1], 1)),
    )


def across_of(
    apart: Float[np.ndarray, "f n 3"], along: Float[np.ndarray, "f n 3"]
) -> Float[np.ndarray, "f n 3"]:
    """Return the unit direction from finger to finger, across the gripper."""
    apart = apart - (apart * along).sum(axis=-1, keepdims=True) * along
    length = np.linalg.norm(apart, axis=-1)
    for gripper in range(apart.shape[1]):
        wide = np.flatnonzero(length[:, gripper] > MIN_OPENING_M)
        if len(wide):
            nearest = wide[np.abs(np.arange(len(apart))[:, None] - wide).argmin(axis=1)]
            apart[:, gripper] = apart[nearest, gripper]
        else:
            helper = np.eye(3)[np.abs(np.nan_to_num(along[:, gripper])).argmin(axis=1)]
            apart[:, gripper] = np.cross(along[:, gripper], helper)
    return apart / np.maximum(np.linalg.norm(apart, axis=-1, keepdims=True), 1e-9)


def _tube(
    start: Float[np.ndarray, "f n 3"],
    end: Float[np.ndarray, "f n 3"],
    radii_m: Float[np.ndarray, "f n 2"],
) -> Float[np.ndarray, "f n v 3"]:
    """Return the vertices of a tube, rings from its start to its end."""
    axis = end - start
    axis = axis / np.maximum(np.linalg.norm(axis, axis=-1, keepdims=True), 1e-9)
    helper = np.eye(3)[np.abs(np.nan_to_num(axis)).argmin(axis=-1)]
    x = np.cross(axis, helper)
    x /= np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-9)
    y = np.cross(axis, x)
    around = np.arange(SIDES) * 2 * np.pi / SIDES
    circle = np.cos(around)[:, None] * x[..., None, :] + np.sin(around)[:, None] * y[..., None, :]
    rings = []
    for place, radius, angles in (
        (start, radii_m[..., :1], np.linspace(-np.pi / 2, 0, BANDS + 1)),
        (end, radii_m[..., 1:], np.linspace(0, np.pi / 2, BANDS + 1)),
    ):
        for angle in angles:
            middle = place + radius * np.sin(angle) * axis
            rings.append(middle[..., None, :] + (radius * np.cos(angle))[..., None] * circle)
    return np.concatenate(rings, axis=-2)


def _triangles() -> Int[np.ndarray, "t 3"]:
    """Return the triangles between neighboring rings of a tube, counterclockwise from outside."""
    ring, side = np.indices((2 * (BANDS + 1) - 1, SIDES)).reshape(2, -1)
    a, b = ring * SIDES + side, ring * SIDES + (side + 1) % SIDES
    return np.concatenate(
        [np.stack([a, b, b + SIDES], axis=1), np.stack([a, b + SIDES, a + SIDES], axis=1)]
    )
