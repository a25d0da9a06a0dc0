"""Pictures of the world by ray casting: colour, depth and ids, exact at every pixel centre.

A surface of colour c and normal n shows c * (ambient + sun * max(0, n . l)), where the sun's part
falls away in shadow. Colours are means over s x s rays a pixel; depth and ids are of the ray
through the pixel's centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from einops import rearrange, reduce
from jaxtyping import Float, Float32, Int, UInt8

from egosim_jax.geometry import finer, pixel_rays
from egosim_jax.worlds.tabletop.bodies import Part

SUN = np.array([-0.42, -0.35, 0.84])
"""Towards the light; from behind the wearer's left shoulder."""
AMBIENT, SUNLIGHT = 0.55, 0.55
SKY = np.array([0.0, 0.0, 0.0])
RAYS = 2
"""Rays along each side of a pixel, of which the colour is the mean."""


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A part where it is at one moment."""

    part: Part
    world_from_part: Float[np.ndarray, "4 4"]
    number: int
    """Its id in the picture; 0 means nothing."""


@dataclass(frozen=True, kw_only=True)
class Picture:
    """One frame."""

    colours: UInt8[np.ndarray, "h w 3"]
    depth_m: Float32[np.ndarray, "h w"]
    """Along the camera's axis; infinite where there is nothing."""
    ids: Int[np.ndarray, "h w"]


class Stage:
    """The parts at one moment, ready to be looked at."""

    def __init__(self, placed: Sequence[Placed]):
        import open3d as o3d

        self.placed = list(placed)
        self.scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        self.normals = []
        for item in self.placed:
            pose, part = item.world_from_part, item.part
            vertices = part.vertices_m @ pose[:3, :3].T + pose[:3, 3]
            self.scene.add_triangles(
                o3d.core.Tensor(vertices.astype(np.float32)),
                o3d.core.Tensor(part.triangles.astype(np.uint32)),
            )
            self.normals.append(_normals(vertices, part) if part.smooth else None)

    def look(
        self,
        world_from_camera: Float[np.ndarray, "4 4"],
        intrinsics_px: Float[np.ndarray, "3 3"],
        *,
        height: int,
        width: int,
    ) -> Picture:
        """The picture from a camera."""
        rays = pixel_rays(intrinsics_px, height=height, width=width)
        middle = self._cast(world_from_camera, rearrange(rays, "h w c -> (h w) c"))
        depth, geometry = middle["t_hit"], middle["geometry_ids"]
        numbers = np.array([*(item.number for item in self.placed), 0])
        ids = numbers[np.where(np.isfinite(depth), geometry, len(self.placed)).astype(int)]
        return Picture(
            colours=self._colours(world_from_camera, intrinsics_px, height, width),
            depth_m=rearrange(depth, "(h w) -> h w", h=height),
            ids=rearrange(ids, "(h w) -> h w", h=height),
        )

    def _colours(
        self, pose: np.ndarray, intrinsics_px: np.ndarray, height: int, width: int
    ) -> UInt8[np.ndarray, "h w 3"]:
        split = finer(intrinsics_px, RAYS)
        rays = pixel_rays(split, height=RAYS * height, width=RAYS * width)
        rays = rearrange(rays, "h w c -> (h w) c")
        hits = self._cast(pose, rays)
        light = np.empty((len(rays), 3))
        light[:] = SKY
        (found,) = np.nonzero(np.isfinite(hits["t_hit"]))
        points = pose[:3, 3] + hits["t_hit"][found, None] * (rays[found] @ pose[:3, :3].T)
        albedo, normals = self._surface(points, {name: hit[found] for name, hit in hits.items()})
        facing = np.einsum("nc,nc->n", normals, rays[found] @ pose[:3, :3].T)
        normals = np.where(facing[:, None] > 0, -normals, normals)
        sun = SUN / np.linalg.norm(SUN)
        cosine = np.clip(normals @ sun, 0, None)
        lit = ~self._shadowed(points + 1e-3 * normals, sun)
        light[found] = albedo * (AMBIENT + SUNLIGHT * cosine * lit)[:, None]
        light = reduce(light, "(h y w x) c -> h w c", "mean", h=height, w=width, y=RAYS, x=RAYS)
        return np.round(255 * np.clip(light, 0, 1)).astype(np.uint8)

    def _surface(
        self, points: np.ndarray, hits: dict[str, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Colour and normal at points that rays have met."""
        albedo, normals = np.empty_like(points), hits["primitive_normals"].astype(np.float64)
        for number, (item, smooth) in enumerate(zip(self.placed, self.normals, strict=True)):
            (here,) = np.nonzero(hits["geometry_ids"] == number)
            if not len(here):
                continue
            pose = item.world_from_part
            albedo[here] = item.part.paint.at((points[here] - pose[:3, 3]) @ pose[:3, :3])
            if smooth is not None:
                corners = item.part.triangles[hits["primitive_ids"][here]]
                u, v = hits["primitive_uvs"][here].T[..., None]
                mixed = (1 - u - v) * smooth[corners[:, 0]]
                mixed = mixed + u * smooth[corners[:, 1]] + v * smooth[corners[:, 2]]
                normals[here] = mixed / np.maximum(np.linalg.norm(mixed, axis=1), 1e-9)[:, None]
        return albedo, normals

    def _shadowed(self, points: np.ndarray, sun: np.ndarray) -> np.ndarray:
        import open3d as o3d

        rays = np.concatenate([points, np.broadcast_to(sun, points.shape)], axis=1)
        return self.scene.test_occlusions(o3d.core.Tensor(rays.astype(np.float32))).numpy()

    def _cast(self, pose: np.ndarray, rays: np.ndarray) -> dict[str, np.ndarray]:
        """What camera rays with z = 1 meet, so that distances along them are depths."""
        import open3d as o3d

        turned = rays @ pose[:3, :3].T
        both = np.concatenate([np.broadcast_to(pose[:3, 3], turned.shape), turned], axis=1)
        hits = self.scene.cast_rays(o3d.core.Tensor(both.astype(np.float32)))
        return {name: tensor.numpy() for name, tensor in hits.items()}


def _normals(vertices: np.ndarray, part: Part) -> np.ndarray:
    """Of each vertex: the mean of its triangles' normals, by area."""
    a, b, c = (vertices[part.triangles[:, k]] for k in range(3))
    faces = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, part.triangles[:, k], faces)
    return normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
