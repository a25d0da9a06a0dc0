"""Drawing of robots into frames: ray cast in the clip's camera, with shadows and depth order.

Every pixel is divided into `RAYS` x `RAYS`; each part shows the robot where it is nearer than the
scene. The light is the tabletop world's; Embree casts the rays on the CPU, without OpenGL.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import Any, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from egosim_jax.geometry import invert, pixel_rays, project, transform, upsample_intrinsics
from egosim_jax.robots.ik import posed
from egosim_jax.robots.models import TABLE, RobotModel
from egosim_jax.types import Cameras
from egosim_jax.worlds.tabletop.embree import Mesh, Rays, make_mesh
from egosim_jax.worlds.tabletop.raycast import AMBIENT, SUN, SUNLIGHT

RAYS = 2
"""Color samples along each side of a pixel."""
SHADOW = AMBIENT / (AMBIENT + SUNLIGHT)
"""Brightness of a surface in the shadow of a robot, relative to its brightness in the light."""
SHADOW_M, SHADOW_PX = 0.25, 0.006
"""Distance at which a shadow has faded, and its softness in image widths."""
DRAWN_GROUPS = (0, 1, 2)
"""MuJoCo's groups of geometries that are drawn; the others are for collisions."""
NEARER_M = 5e-4
"""Minimum distance between a robot and the scene that it hides."""
SIDES = 24
"""Sides of a drawn cylinder."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Drawn:
    """Frames with a robot."""

    frames: UInt8[np.ndarray, "f h w 3"]
    """RGB of robots and scene."""
    depth_m: Float32[np.ndarray, "f h w"]
    """Depth of the robot or the scene."""
    mask: Bool[np.ndarray, "f h w"]
    """Pixels whose center shows the robot."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """Drawn geometries of a robot: meshes in their own frames, and their colors."""

    robot: RobotModel

    @cached_property
    def geoms(self) -> list[tuple[int, Mesh, np.ndarray]]:
        """Number, mesh and RGB color in [0, 1] of each drawn geometry."""
        mj = self.robot.mj
        found = []
        for n in range(mj.ngeom):
            mesh = _mesh_of(mj, n)
            if n != mj.geom(TABLE).id and mj.geom_group[n] in DRAWN_GROUPS and mesh is not None:
                material = mj.geom_matid[n]
                rgba = mj.mat_rgba[material] if material >= 0 else mj.geom_rgba[n]
                found.append((n, mesh, np.asarray(rgba[:3], np.float32)))
        return found

    def pose(self, q: np.ndarray, opening_m: float, world_from_base: np.ndarray) -> list[Mesh]:
        """Return the meshes in the world for a posture."""
        data, placed = posed(self.robot, self.robot.open(q, opening_m)), []
        for n, (vertices, triangles), _ in self.geoms:
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = data.geom_xmat[n].reshape(3, 3), data.geom_xpos[n]
            placed.append((transform(world_from_base @ pose, vertices), triangles))
        return placed


def _mesh_of(mj: Any, geom: int) -> Mesh | None:
    """Return the mesh of a geometry in its frame; None for a kind that no arm has."""
    mujoco: Any = import_module("mujoco")

    kind, size = mujoco.mjtGeom(int(mj.geom_type[geom])), mj.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = mj.geom_dataid[geom]
        first, count = mj.mesh_vertadr[mesh], mj.mesh_vertnum[mesh]
        face, faces = mj.mesh_faceadr[mesh], mj.mesh_facenum[mesh]
        vertices = mj.mesh_vert[first : first + count].astype(float)
        return vertices, mj.mesh_face[face : face + faces].astype(int)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        vertices, triangles = make_mesh("box", *(2 * size))
        return vertices - size, triangles
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return make_mesh("sphere", size[0], SIDES // 2)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return make_mesh("cylinder", size[0], 2 * size[1], SIDES, 1)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:  # a sphere whose halves are apart
        vertices, triangles = make_mesh("sphere", size[0], SIDES // 2)
        shift = np.sign(vertices[:, 2:]) * size[1] * np.array([0, 0, 1])
        return vertices + shift, triangles
    return None


def draw(
    frames: UInt8[np.ndarray, "f h w 3"],
    depth_m: Float32[np.ndarray, "f h w"],
    cameras: Cameras,
    meshes: Sequence[Sequence[Mesh]],
    colors: Sequence[np.ndarray],
    *,
    world_from_up: Float[np.ndarray, "4 4"],
) -> Drawn:
    """Draw the robots' meshes of each frame, with the given colors, over the frames."""
    sun = (world_from_up[:3, :3] @ (SUN / np.linalg.norm(SUN))).astype(np.float32)
    found = [
        _draw(frames[n], depth_m[n], cameras, n, meshes[n], np.array(colors), sun)
        for n in range(len(frames))
    ]
    images, depths, masks = zip(*found, strict=True)
    return Drawn(frames=np.stack(images), depth_m=np.stack(depths), mask=np.stack(masks))


def _draw(
    image: np.ndarray,
    scene_m: np.ndarray,
    cameras: Cameras,
    frame: int,
    meshes: Sequence[Mesh],
    colors: np.ndarray,
    sun: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return color, depth and mask of one frame."""
    pose, rays = cameras.world_from_camera[frame], Rays(meshes)
    image = _shade(image, scene_m, cameras, frame, rays, sun)
    depth, mask = scene_m.copy(), np.zeros(scene_m.shape, bool)
    rows, columns = _window(meshes, cameras, pose)
    if rows.start >= rows.stop or columns.start >= columns.stop:
        return image, depth, mask
    directions = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    middle = rays.cast(*_from_eye(directions[rows, columns], pose))
    seen = middle.distances.reshape(depth[rows, columns].shape)
    nearer = seen < depth[rows, columns] - NEARER_M
    mask[rows, columns] = nearer
    fine = upsample_intrinsics(cameras.intrinsics_px, RAYS)
    size = {"height": RAYS * cameras.height, "width": RAYS * cameras.width}
    window = tuple(slice(RAYS * s.start, RAYS * s.stop) for s in (rows, columns))
    parts = pixel_rays(fine, **size)[window]
    eye, towards = _from_eye(parts, pose)
    hits = rays.cast(eye, towards)
    behind = depth[rows, columns].repeat(RAYS, axis=0).repeat(RAYS, axis=1).ravel()
    front = hits.distances < behind - NEARER_M
    normals = hits.normals[front]
    facing = (normals * towards[front]).sum(axis=1, keepdims=True)
    normals = np.where(facing > 0, -normals, normals)
    points = eye[front] + hits.distances[front, None] * towards[front] + 1e-3 * normals
    cosine = np.maximum(normals @ sun, 0)
    lit = ~rays.blocked(points.astype(np.float32), _all(sun, len(points)))
    shaded = colors[hits.meshes[front]] * (AMBIENT + SUNLIGHT * cosine * lit)[:, None]
    samples = image[rows, columns].repeat(RAYS, axis=0).repeat(RAYS, axis=1).astype(float)
    flat = samples.reshape(-1, 3)
    flat[front] = 255 * np.clip(shaded, 0, 1)
    height, width = mask[rows, columns].shape
    mean = flat.reshape(height, RAYS, width, RAYS, 3).mean(axis=(1, 3))
    image[rows, columns] = np.round(mean)
    depth[rows, columns] = np.where(nearer, seen, depth[rows, columns])
    return image, depth, mask


def _shade(
    image: np.ndarray,
    scene_m: np.ndarray,
    cameras: Cameras,
    frame: int,
    rays: Any,
    sun: np.ndarray,
) -> np.ndarray:
    """Return the image with a soft shadow of the meshes on the scene."""
    import cv2

    pose = cameras.world_from_camera[frame]
    known = np.isfinite(scene_m)
    directions = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    points = transform(pose, directions[known] * scene_m[known][:, None]).astype(np.float32)
    dark = np.zeros(scene_m.shape, np.float32)
    hits = rays.cast(points + np.float32(2e-3) * sun, _all(sun, len(points)))
    dark[known] = np.clip(1 - hits.distances / SHADOW_M, 0, 1)
    dark = cv2.GaussianBlur(dark, (0, 0), max(SHADOW_PX * cameras.width, 0.5))
    return np.round(image * (1 - (1 - SHADOW) * dark[..., None])).astype(np.uint8)


def _window(meshes: Sequence[Mesh], cameras: Cameras, pose: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns that can show the meshes."""
    local = transform(invert(pose), np.concatenate([_corners(v) for v, _ in meshes]))
    if local[:, 2].min() < 0.02:  # corners behind the camera cannot be projected
        return slice(0, cameras.height), slice(0, cameras.width)
    u, v = project(cameras.intrinsics_px, local)
    ends = ((v, cameras.height), (u, cameras.width))
    found = [slice(max(0, int(x.min()) - 1), min(size, int(x.max()) + 2)) for x, size in ends]
    return found[0], found[1]


def _corners(vertices: np.ndarray) -> np.ndarray:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return np.where(np.indices((2, 2, 2)).reshape(3, 8).T > 0, high, low)


def _from_eye(directions: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    towards = (directions @ pose[:3, :3].T).reshape(-1, 3).astype(np.float32)
    return _all(pose[:3, 3], len(towards)), towards


def _all(vector: np.ndarray, count: int) -> np.ndarray:
    return np.broadcast_to(vector.astype(np.float32), (count, 3))
