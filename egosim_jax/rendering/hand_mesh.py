"""Skinned mesh of a hand over 21 keypoints, which needs no licensed hand model.

The template is the level set of a smooth union of cones, one along each bone of an open right hand
and some across the palm. Its triangles come from naive surface nets. Keypoints pose it by linear
blend skinning. Let a bone go from p to q; in the template it starts at r and has the direction d
and the length l. It moves the point x to

    p + R (s (x - r) + (|q - p| / l - s) ((x - r) . d) d)

where s is the median of the bones' length ratios, so the thickness of fingers follows the size of
the hand. R is the rotation of the bone's parent, followed by the smallest rotation that aligns the
bone. The parent of palm bones is the least-squares rotation of the palm. A left hand is the mirror
image of a right one.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.geometry import smallest_rotation
from egosim_jax.rendering.mesh import HAND_COLORS, MovingMesh, Side, join_meshes
from egosim_jax.rendering.skeleton import SKELETONS
from egosim_jax.types import InputError

REST_MM = np.array([
    [0, 0, 0], [-28, 26, -14], [-53, 52, -31], [-72, 73, -44], [-88, 89, -54],
    [-26, 90, 0], [-33, 131, -4], [-38, 155, -8], [-42, 174, -12],
    [-4, 94, 2], [-5, 140, -2], [-6, 168, -7], [-7, 189, -12],
    [17, 88, 0], [22, 129, -4], [26, 155, -9], [29, 175, -14],
    [36, 78, -4], [46, 110, -8], [52, 128, -12], [57, 145, -17],
])  # fmt: skip
"""Keypoints of the template in millimeters: y along the fingers, z out of the back of the hand."""
RADII_MM = np.array(
    [24, 16, 12.5, 11.5, 9.5] + [11, 9.5, 8.5, 7.5, 11.5, 9.5, 8.5, 7.5]
    + [11, 9.5, 8.5, 7.5, 10, 8.5, 7.5, 6.5]
)  # fmt: skip
"""Radius of the hand at each keypoint in millimeters."""
ACROSS = ((1, 5), (5, 9), (9, 13), (13, 17))
"""Pairs of keypoints joined by soft tissue, not a bone."""
PALM = [0, 5, 9, 13, 17]
"""Keypoints that hardly move relative to each other."""
BLEND_MM, VOXEL_MM = 3.0, 4.0
"""Blending radius of the bones' shapes and motions; voxel size of the mesh."""


class Template(NamedTuple):
    """Right hand at rest."""

    vertices_m: Float[np.ndarray, "v 3"]
    """Vertices in meters."""
    triangles: Int[np.ndarray, "t 3"]
    """Vertex indices, counterclockwise as seen from outside."""
    weights: Float[np.ndarray, "v 20"]
    """Share of each bone in the motion of each vertex; they add up to 1."""


def pose_hands(
    joints_m: Float[np.ndarray, "f n j 3"], *, sides: Sequence[Side] | None = None
) -> MovingMesh:
    """Return the meshes of n hands along their keypoints, in the colors of their sides.

    A hand with a non-finite joint is missing from that frame. `sides` defaults to a left and a
    right hand, in this order. Raises `InputError` for another number of joints or sides.
    """
    sides = ("left", "right") if sides is None else tuple(sides)
    shape = np.shape(joints_m)
    if len(shape) != 4 or shape[1:] != (len(sides), 21, 3):
        raise InputError(
            f"joints_m has shape {shape}: meshes of {len(sides)} hands ({', '.join(sides)}) need "
            "(frames, hands, 21, 3). A missing hand has joints of NaN; a gripper has no mesh."
        )
    return join_meshes([_pose(joints_m[:, k], side) for k, side in enumerate(sides)])


def _pose(joints_m: Float[np.ndarray, "f 21 3"], side: Side) -> MovingMesh:
    template = make_template()
    mirror = np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
    present = np.isfinite(joints_m).all(axis=(1, 2))
    vertices = np.full((len(joints_m), *template.vertices_m.shape), np.nan)
    if present.any():
        vertices[present] = _skin(template, joints_m[present].astype(float) * mirror) * mirror
    return MovingMesh(
        vertices_m=vertices,
        triangles=template.triangles if side == "right" else template.triangles[:, ::-1],
        colors=np.tile(HAND_COLORS[side], (len(template.vertices_m), 1)),
    )


def _skin(template: Template, joints: Float[np.ndarray, "f 21 3"]) -> Float[np.ndarray, "f v 3"]:
    """Return the vertices of a right hand at keypoints, both in meters."""
    rest, bones = REST_MM / 1000, SKELETONS["human"].bones
    away = rest[bones[:, 1]] - rest[bones[:, 0]]
    length = np.linalg.norm(away, axis=-1)
    along = away / length[:, None]
    steps = joints[:, bones[:, 1]] - joints[:, bones[:, 0]]
    steps_m = np.linalg.norm(steps, axis=-1)
    ratio = steps_m / length
    scale = np.median(ratio, axis=1)
    rotations = _rotations(joints, along, steps / np.maximum(steps_m, 1e-9)[..., None])
    vertices = np.zeros((len(joints), *template.vertices_m.shape))
    for bone, (start, _) in enumerate(bones):
        local = template.vertices_m - rest[start]
        axial = (local @ along[bone])[:, None] * along[bone]
        stretched = scale[:, None, None] * local + (ratio[:, bone] - scale)[:, None, None] * axial
        moved = stretched @ rotations[:, bone].swapaxes(-1, -2) + joints[:, start, None]
        vertices += template.weights[:, bone, None] * moved
    return vertices


def _rotations(
    joints: Float[np.ndarray, "f 21 3"],
    along: Float[np.ndarray, "20 3"],
    directions: Float[np.ndarray, "f 20 3"],
) -> Float[np.ndarray, "f 20 3 3"]:
    """Return the rotation of each bone from the template."""
    palm = palm_rotations(joints, "right")
    rotations = np.empty((len(joints), len(along), 3, 3))
    for bone in range(len(along)):
        parent = palm if bone % 4 == 0 else rotations[:, bone - 1]
        turned = parent @ along[bone]
        rotations[:, bone] = smallest_rotation(turned, directions[:, bone]) @ parent
    return rotations


def palm_rotations(joints_m: Float[np.ndarray, "f 21 3"], side: Side) -> Float[np.ndarray, "f 3 3"]:
    """Return the rotation of a hand's palm from a hand whose fingers point along y, palm down."""
    mirror = np.array([1.0 if side == "right" else -1.0, 1.0, 1.0])
    rest, posed = REST_MM[PALM] / 1000 * mirror, joints_m[:, PALM]
    covariance = np.einsum(
        "fkc,kd->fcd", posed - posed.mean(axis=1, keepdims=True), rest - rest.mean(axis=0)
    )
    u, _, vt = np.linalg.svd(covariance)
    # A proper rotation, never a reflection.
    u[:, :, 2] *= np.sign(np.linalg.det(u) * np.linalg.det(vt))[:, None]
    return u @ vt


@cache
def make_template() -> Template:
    """Return the right hand at rest."""
    axes = [
        np.arange(low, high + VOXEL_MM, VOXEL_MM)
        for low, high in zip(REST_MM.min(axis=0) - 32, REST_MM.max(axis=0) + 32, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    vertices, triangles = _surface_net(_level(grid.reshape(-1, 3)).reshape(grid.shape[:3]))
    vertices = vertices * VOXEL_MM + grid[0, 0, 0]
    return Template(vertices / 1000, triangles, _weights(vertices))


def _level(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Return the signed distance to the hand at rest, in millimeters, negative inside."""
    pairs = [*SKELETONS["human"].bones.tolist(), *ACROSS]
    gaps = np.stack([_gap(points, a, b) for a, b in pairs])
    nearest = gaps.min(axis=0)
    return nearest - BLEND_MM * np.log(np.exp((nearest - gaps) / BLEND_MM).sum(axis=0))


def _gap(points: Float[np.ndarray, "n 3"], a: int, b: int) -> Float[np.ndarray, " n"]:
    """Return the distance to the cone between two keypoints in millimeters, negative inside."""
    away = REST_MM[b] - REST_MM[a]
    share = np.clip((points - REST_MM[a]) @ away / (away @ away), 0, 1)
    radius = RADII_MM[a] + share * (RADII_MM[b] - RADII_MM[a])
    return np.linalg.norm(points - REST_MM[a] - share[:, None] * away, axis=1) - radius


def _weights(points: Float[np.ndarray, "v 3"]) -> Float[np.ndarray, "v 20"]:
    """Return the weights of the nearest bone and of the bones that share a joint with it."""
    bones = SKELETONS["human"].bones
    gaps = np.stack([_gap(points, a, b) for a, b in bones.tolist()], axis=1)
    touching = (bones[:, None, :, None] == bones[None, :, None, :]).any(axis=(2, 3))
    near = np.where(touching[gaps.argmin(axis=1)], gaps, np.inf)
    weights = np.exp((near.min(axis=1, keepdims=True) - near) / BLEND_MM)
    return weights / weights.sum(axis=1, keepdims=True)


def _surface_net(
    level: Float[np.ndarray, "x y z"],
) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    """Return the surface of level 0, in cells: one vertex in each cell it crosses (Gibson 1998).

    The vertex is the mean of the crossings of the cell's edges; the four cells around a crossed
    edge share a square.
    """
    cells = np.array(level.shape) - 1
    total, count, squares = np.zeros((*cells, 3)), np.zeros(cells, int), []
    inside = level < 0
    for axis in range(3):
        low, high = (np.take(level, np.arange(cells[axis]) + k, axis=axis) for k in (0, 1))
        crossed = (low < 0) != (high < 0)
        share = np.where(crossed, low / np.where(crossed, low - high, 1), 0)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for i, j in np.ndindex(2, 2):
            window = [slice(None)] * 3
            window[first], window[second] = slice(i, i + cells[first]), slice(j, j + cells[second])
            here = crossed[tuple(window)]
            count += here
            total[..., axis] += share[tuple(window)]
            total[..., first] += i * here
            total[..., second] += j * here
        edge = np.argwhere(crossed)
        around = np.repeat(edge[:, None], 4, axis=1)
        around[:, :, first] -= [1, 0, 0, 1]
        around[:, :, second] -= [1, 1, 0, 0]
        outward = inside[tuple(edge.T)][:, None, None]
        squares.append(np.where(outward, around, around[:, ::-1]))
    number = np.cumsum(count.ravel() > 0).reshape(count.shape) - 1
    place = np.argwhere(count > 0)
    vertices = place + total[count > 0] / count[count > 0][:, None]
    corners = number[tuple(np.moveaxis(np.concatenate(squares), -1, 0))]
    return vertices, np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
