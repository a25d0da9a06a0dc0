"""Rays cast by Embree: through Open3D or, where it is not installed, through embreex.

Both give the same ids, depths within 3e-7 m and the same colors, except that a few pixels of a clip
are rounded otherwise by 1 of 255. embreex is a small wheel for machines that make clips and train.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float32, Int32

from egosim_jax.runtime.open3d import load_open3d
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop.primitives import Mesh


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


@runtime_checkable
class Rays(Protocol):
    """Meshes that rays can hit."""

    def cast(
        self, origins_m: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]
    ) -> Hits:
        """Return the first hit of each ray."""
        ...

    def blocked(
        self, origins_m: Float32[np.ndarray, "n 3"], directions: Float32[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Return whether each ray hits anything."""
        ...


def rays_among(meshes: Sequence[Mesh]) -> Rays:
    """Return the ray caster of some meshes in world frame, for one thread.

    Clips are made in parallel processes. Raises `InputError` if neither package is installed.
    """
    for load, caster in ((load_open3d, _Open3D), (partial(import_module, "embreex"), _Embreex)):
        try:
            load()
        except ImportError:
            continue
        return caster(meshes)
    raise InputError(
        "Neither Open3D nor embreex is installed: ray casting needs one of them. "
        "Run pip install open3d-cpu, or the smaller pip install embreex."
    )


class _Open3D:
    def __init__(self, meshes: Sequence[Mesh]):
        o3d = load_open3d()

        self.tensor = o3d.core.Tensor
        self.scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        for vertices, triangles in meshes:
            points = self.tensor(vertices.astype(np.float32))
            self.scene.add_triangles(points, self.tensor(triangles.astype(np.uint32)))

    def cast(self, origins_m: np.ndarray, directions: np.ndarray) -> Hits:
        found = self.scene.cast_rays(self._rays(origins_m, directions), nthreads=1)
        return Hits(
            distances=found["t_hit"].numpy(),
            meshes=found["geometry_ids"].numpy().view(np.int32),
            triangles=found["primitive_ids"].numpy().view(np.int32),
            weights=found["primitive_uvs"].numpy(),
            normals=found["primitive_normals"].numpy(),
        )

    def blocked(self, origins_m: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return self.scene.test_occlusions(self._rays(origins_m, directions), nthreads=1).numpy()

    def _rays(self, origins_m: np.ndarray, directions: np.ndarray) -> Any:
        return self.tensor(np.concatenate([origins_m, directions], axis=1))


class _Embreex:
    def __init__(self, meshes: Sequence[Mesh]):
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.scene = EmbreeScene(robust=True)  # as Open3D
        for vertices, triangles in meshes:
            TriangleMesh(self.scene, vertices.astype(np.float32), triangles.astype(np.int32))

    def cast(self, origins_m: np.ndarray, directions: np.ndarray) -> Hits:
        found = self.scene.run(origins_m, directions, output=1)
        missed = found["geomID"] < 0
        length = np.sqrt(np.square(found["Ng"]).sum(axis=1))
        length[missed] = 1
        return Hits(
            distances=np.where(missed, np.float32(np.inf), found["tfar"]),
            meshes=found["geomID"],
            triangles=found["primID"],
            weights=np.stack([found["u"], found["v"]], axis=1),
            normals=found["Ng"] * (1 / length)[:, None],
        )

    def blocked(self, origins_m: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return self.scene.run(origins_m, directions, query="OCCLUDED") != -1
