"""Ray-cast rendering of the tabletop world: color, depth and ids, exact at every pixel center.

A surface of color c and normal n is shaded as c * (ambient + sun * max(0, n . l)) in the light and
as c * ambient in shadow. A pixel's color is the mean over s x s rays; its depth and id are from the
ray through its center.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from einops import rearrange, reduce
from jaxtyping import Float, Float32, Int, UInt8

from egosim_jax.geometry import pixel_rays, transform, upsample_intrinsics
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop.bodies import Part
from egosim_jax.worlds.tabletop.embree import Hits, Rays

SUN = np.array([-0.25, -0.50, 0.83])
"""Direction towards the light, behind the wearer's left shoulder."""
AMBIENT = 0.62
"""Intensity of the ambient light."""
SUNLIGHT = 0.48
"""Intensity of the directional light."""
SKY = np.array([0.0, 0.0, 0.0])
"""RGB in [0, 1] where a ray hits nothing."""
RAYS = 2
"""Color samples along each side of a pixel."""


@dataclass(frozen=True, kw_only=True)
class Placed:
    """A part with its pose at one moment."""

    part: Part
    """Mesh and texture of a body to render."""
    world_from_part: Float[np.ndarray, "4 4"]
    """Pose in the world."""
    instance_id: int
    """Instance id in renderings, at least 1; 0 is a ray without a hit."""


@dataclass(frozen=True, kw_only=True)
class Frame:
    """A rendered frame: color, depth and ids."""

    colors: UInt8[np.ndarray, "h w 3"]
    """RGB of every pixel."""
    depth_m: Float32[np.ndarray, "h w"]
    """Depth along the camera axis in meters; infinite where a ray hits nothing."""
    ids: Int[np.ndarray, "h w"]
    """Instance ids; 0 where a ray hits nothing."""


class RayCaster:
    """Renderer of the placed parts of one moment."""

    def __init__(self, placed: Sequence[Placed]):
        self.placed = list(placed)
        self.rays = Rays(
            [
                (transform(item.world_from_part, item.part.vertices_m), item.part.triangles)
                for item in self.placed
            ]
        )

    def render(
        self,
        world_from_camera: Float[np.ndarray, "4 4"],
        intrinsics_px: Float[np.ndarray, "3 3"],
        *,
        height: int,
        width: int,
    ) -> Frame:
        """Render from a camera. Raises `InputError` if the camera is inside an object."""
        self._refuse_inside(world_from_camera[:3, 3])
        rays = _world_rays(world_from_camera, intrinsics_px, height=height, width=width)
        middle = self._cast(world_from_camera, rays)
        ids = np.array([*(item.instance_id for item in self.placed), 0])[middle.meshes]
        return Frame(
            colors=self._colors(world_from_camera, intrinsics_px, height, width),
            depth_m=rearrange(middle.distances, "(h w) -> h w", h=height),
            ids=rearrange(ids, "(h w) -> h w", h=height),
        )

    def _refuse_inside(self, eye_m: np.ndarray) -> None:
        if self.rays.contain(eye_m):
            place = ", ".join(f"{value:.3f}" for value in eye_m)
            raise InputError(
                f"The camera at ({place}) m is inside an object; it must be outside all objects. "
                "Move the camera or the object."
            )

    def _colors(
        self, pose: np.ndarray, intrinsics_px: np.ndarray, height: int, width: int
    ) -> UInt8[np.ndarray, "h w 3"]:
        split = upsample_intrinsics(intrinsics_px, RAYS)
        rays = _world_rays(pose, split, height=RAYS * height, width=RAYS * width)
        hits = self._cast(pose, rays)
        sky = hits.meshes < 0
        points = np.where(sky, 0, hits.distances)[:, None] * rays + pose[:3, 3].astype(np.float32)
        albedo, normals = self._surface(points, hits)
        facing = np.einsum("nc,nc->n", normals, rays)
        normals = np.where(facing[:, None] > 0, -normals, normals)  # towards the camera
        sun = (SUN / np.linalg.norm(SUN)).astype(np.float32)
        cosine = np.clip(normals @ sun, 0, None)
        # Shadow rays start 1 mm off the surface, which would otherwise shadow itself.
        lit, faces_sun = np.zeros(len(points), bool), (cosine > 0) & ~sky
        starts = points[faces_sun] + np.float32(1e-3) * normals[faces_sun]
        lit[faces_sun] = ~self.rays.blocked(starts, np.broadcast_to(sun, starts.shape))
        light = albedo * (AMBIENT + SUNLIGHT * cosine * lit)[:, None]
        light[sky] = SKY
        light = reduce(light, "(h y w x) c -> h w c", "mean", h=height, w=width, y=RAYS, x=RAYS)
        return np.round(255 * np.clip(light, 0, 1)).astype(np.uint8)

    def _surface(
        self, points: Float32[np.ndarray, "n 3"], hits: Hits
    ) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"]]:
        """Return albedo and normal at ray hits; arbitrary where a ray hits nothing."""
        albedo, normals = np.zeros_like(points), hits.normals
        order = np.argsort(hits.meshes.astype(np.int16), kind="stable")  # 16 bits: by radix
        starts = np.searchsorted(hits.meshes[order], np.arange(len(self.placed) + 1))
        for item, start, end in zip(self.placed, starts[:-1], starts[1:], strict=True):
            if start == end:
                continue
            hit, part = order[start:end], item.part
            pose = item.world_from_part.astype(np.float32)
            albedo[hit] = part.paint.at((points[hit] - pose[:3, 3]) @ pose[:3, :3])
            if part.smooth:
                corners = part.vertex_normals[part.triangles[hits.triangles[hit]]]
                u, v = hits.weights[hit].T
                mixed = np.einsum("nk,nkc->nc", np.stack([1 - u - v, u, v], axis=1), corners)
                length = np.maximum(np.linalg.norm(mixed, axis=1), 1e-9)
                normals[hit] = mixed / length[:, None] @ pose[:3, :3].T
        return albedo, normals

    def _cast(self, pose: np.ndarray, rays: Float32[np.ndarray, "n 3"]) -> Hits:
        """Cast rays from the camera."""
        return self.rays.cast(np.broadcast_to(pose[:3, 3].astype(np.float32), rays.shape), rays)


def _world_rays(
    pose: np.ndarray, intrinsics_px: np.ndarray, *, height: int, width: int
) -> Float32[np.ndarray, "n 3"]:
    """Return world directions of camera rays with unit z, whose hit distances are depths."""
    rays = pixel_rays(intrinsics_px, height=height, width=width)
    return rearrange(rays @ pose[:3, :3].T, "h w c -> (h w) c").astype(np.float32)
