"""Renderer of shaded meshes by Open3D's ray casting, the reference for `mesh_jitted`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from egosim_jax.geometry import invert, pixel_rays, transform
from egosim_jax.rendering.mesh import AMBIENT, DIFFUSE, MovingMesh, vertex_normals
from egosim_jax.rendering.skeleton import NEAR_M
from egosim_jax.runtime.open3d import load_open3d
from egosim_jax.types import Cameras, InputError


def draw_mesh(
    mesh: MovingMesh, cameras: Cameras
) -> tuple[UInt8[np.ndarray, "f h w 3"], Float32[np.ndarray, "f h w"]]:
    """Draw a mesh; return the image and its depth, black and infinite off the mesh.

    Triangles with a non-finite vertex are missing. Nothing nearer than 1 cm is drawn.
    """
    shape = len(mesh.vertices_m), cameras.height, cameras.width
    image, depth = np.zeros((*shape, 3), np.uint8), np.full(shape, np.inf, np.float32)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    for frame, pose in enumerate(cameras.world_from_camera):
        vertices = transform(invert(pose), mesh.vertices_m[frame])
        given = np.isfinite(vertices).all(axis=1)[mesh.triangles].all(axis=1)
        if given.any():
            _draw(image[frame], depth[frame], vertices, mesh, given, rays)
    return image, depth


def draw_scene(
    vertices_m: Float[np.ndarray, "v 3"],
    triangles: Int[np.ndarray, "t 3"],
    colors: UInt8[np.ndarray, "v 3"],
    cameras: Cameras,
) -> tuple[UInt8[np.ndarray, "f h w 3"], UInt8[np.ndarray, "f h w"]]:
    """Draw a scene in the colors of its vertices, without light, along a camera path.

    Returns the image and the mask: 255, and black, where no triangle is seen. Raises `InputError`
    if the first frame shows none.
    """
    o3d = load_open3d()

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(vertices_m.astype(np.float32)), o3d.core.Tensor(triangles.astype(np.uint32))
    )
    shape = len(cameras.world_from_camera), cameras.height, cameras.width
    image, mask = np.zeros((*shape, 3), np.uint8), np.full(shape, 255, np.uint8)
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    for frame, pose in enumerate(cameras.world_from_camera):
        ways = rays @ pose[:3, :3].T
        both = np.concatenate([pose[:3, 3] + NEAR_M * ways, ways], axis=-1).astype(np.float32)
        hits = scene.cast_rays(o3d.core.Tensor(both))
        seen = np.isfinite(hits["t_hit"].numpy())
        u, v = hits["primitive_uvs"].numpy()[seen].T
        corners = colors[triangles[hits["primitive_ids"].numpy()[seen]]]
        share = np.stack([1 - u - v, u, v], axis=1)
        image[frame][seen] = np.rint(np.einsum("nk,nkc->nc", share, corners))
        mask[frame][seen] = 0
    if mask[0].all():
        raise InputError(
            f"None of the {len(triangles)} triangles of the scene is visible in the first frame: "
            "the camera must look at the scene, in the same world coordinates."
        )
    return image, mask


def _draw(
    image: UInt8[np.ndarray, "h w 3"],
    depth: Float32[np.ndarray, "h w"],
    vertices: Float[np.ndarray, "v 3"],
    mesh: MovingMesh,
    given: np.ndarray,
    rays: Float[np.ndarray, "h w 3"],
) -> None:
    """Draw the given triangles of one frame, in camera coordinates."""
    o3d = load_open3d()

    triangles = mesh.triangles[given]
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(
        o3d.core.Tensor(np.nan_to_num(vertices).astype(np.float32)),
        o3d.core.Tensor(triangles.astype(np.uint32)),
    )
    start = NEAR_M * rays
    both = np.concatenate([start, rays], axis=-1).astype(np.float32)
    hits = scene.cast_rays(o3d.core.Tensor(both), nthreads=1)
    distance = hits["t_hit"].numpy()
    seen = np.isfinite(distance)
    corners = triangles[hits["primitive_ids"].numpy()[seen]]
    u, v = hits["primitive_uvs"].numpy()[seen].T
    share = np.stack([1 - u - v, u, v], axis=1)
    normals = vertex_normals(np.where(np.isfinite(vertices), vertices, 0.0), triangles)
    normal, color = (np.einsum("nk,nkc->nc", share, x[corners]) for x in (normals, mesh.colors))
    depth[seen] = distance[seen] + np.float32(NEAR_M)
    towards = -rays[seen]
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
    cosine = (normal * towards).sum(axis=1) / np.maximum(size, 1e-12)
    light = AMBIENT + DIFFUSE * np.maximum(cosine, 0)
    image[seen] = np.round(255 * np.clip(color * light[:, None], 0, 1))
