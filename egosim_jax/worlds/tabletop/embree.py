"""Meshes of simple shapes, and rays cast among meshes by Embree, both through Open3D."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from egosim_jax.runtime.open3d import load_open3d

Mesh = tuple[Float[np.ndarray, "_ 3"], Int[np.ndarray, "_ 3"]]
"""Vertices, and the vertex indices of each triangle, counterclockwise from outside."""
UPWARD = (0.013, 0.007, 1.0)
"""Direction in which crossings are counted: along no edge of an upright shape."""


def make_mesh(
    shape: Literal["box", "sphere", "cylinder", "cone", "torus"], *sizes: float | int
) -> Mesh:
    """Return the mesh of a shape, by Open3D's `create_...` with the given sizes."""
    mesh = getattr(load_open3d().geometry.TriangleMesh, f"create_{shape}")(*sizes)
    return np.array(mesh.vertices), np.array(mesh.triangles, int)


@dataclass(frozen=True, kw_only=True)
class Hits:
    """First hit of each ray."""

    distances: Float32[np.ndarray, " n"]
    """Distances in lengths of the ray's direction; infinite where a ray hits nothing."""
    meshes: Int32[np.ndarray, " n"]
    """Numbers of meshes; -1 where a ray hits nothing."""
    triangles: Int32[np.ndarray, " n"]
    """Numbers of triangles in their mesh; -1 where a ray hits nothing."""
    weights: Float32[np.ndarray, "n 2"]
    """Weights of the triangle's second and third vertex; 0 where a ray hits nothing."""
    normals: Float32[np.ndarray, "n 3"]
    """Unit normals of triangles; 0 where a ray hits nothing."""


class Rays:
    """Meshes in world frame that rays can hit, for one thread: clips are made in processes."""

    def __init__(self, meshes: Sequence[Mesh]):
        o3d = load_open3d()
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        for vertices, triangles in meshes:
            points = self._tensor(vertices.astype(np.float32))
            self._scene.add_triangles(points, self._tensor(triangles.astype(np.uint32)))

    def cast(
        self, origins_m: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]
    ) -> Hits:
        """Return the first hit of each ray."""
        hits = self._scene.cast_rays(self._rays(origins_m, directions), nthreads=1)
        return Hits(
            distances=hits["t_hit"].numpy(),
            meshes=hits["geometry_ids"].numpy().view(np.int32),
            triangles=hits["primitive_ids"].numpy().view(np.int32),
            weights=hits["primitive_uvs"].numpy(),
            normals=hits["primitive_normals"].numpy(),
        )

    def blocked(
        self, origins_m: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Return whether each ray hits anything."""
        return self._scene.test_occlusions(self._rays(origins_m, directions), nthreads=1).numpy()

    def contain(self, point_m: Float[np.ndarray, " 3"]) -> bool:
        """Return whether a point is inside a closed mesh: a ray crosses surfaces an odd number."""
        ray = np.array([[*point_m, *UPWARD]], np.float32)
        return bool(self._scene.count_intersections(self._tensor(ray), nthreads=1).numpy()[0] % 2)

    def _rays(self, origins_m: np.ndarray, directions: np.ndarray) -> Any:
        return self._tensor(np.concatenate([origins_m, directions], axis=1))
