"""Solids of the tabletop world: distance and normal at any point, for contacts.

Each body is a union of solids in the frames of its parts: a loose body has one, furniture has a
case, a moving part and its handle. The distance is negative inside. Boxes, cylinders and cones are
intersections of half-spaces and round sides. Their distance is the maximum over these: exact except
outside an edge, where it is too small by up to a factor of sqrt(3).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float

from egosim_jax.geometry import invert, transform
from egosim_jax.worlds.tabletop.bodies import LID_M, Body, Shape
from egosim_jax.worlds.tabletop.scene import DRAWER_M, Scene

Form = Literal["box", "cylinder", "ball", "cone", "ring"]


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A solid in the frame of a body's part; its origin is the center of its underside."""

    form: Form
    """Class of its shape."""
    size_m: tuple[float, float, float]
    """Extent along x, y and z in meters."""
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Center of its underside in the frame of the part, in meters."""
    part: int = 0
    """Index of the body's part; part 0 moves."""
    handle: bool = False
    """True for the handle of furniture."""

    def at(
        self, points_m: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
        """Return the distance in meters and outward unit normal of the surface at points."""
        local = points_m - np.asarray(self.origin_m)
        x, y, z = self.size_m
        if self.form == "ball":
            return _from_center(local - [0, 0, x / 2], x / 2)
        flat = np.hypot(local[:, 0], local[:, 1])
        outward = local * [1, 1, 0] / np.maximum(flat, 1e-9)[:, None]
        if self.form == "ring":
            tube = z / 2
            circle = outward * (x / 2 - tube) + [0, 0, tube]
            return _from_center(local - circle, tube)
        up = np.broadcast_to([0.0, 0.0, 1.0], local.shape)
        if self.form == "cone":
            slope = np.array([z, x / 2]) / np.hypot(z, x / 2)
            side = flat * slope[0] + (local[:, 2] - z) * slope[1]
            return _largest([(side, outward * slope[0] + up * slope[1]), (-local[:, 2], -up)])
        faces = [(local[:, 2] - z, up), (-local[:, 2], -up)]
        if self.form == "cylinder":
            return _largest([(flat - x / 2, outward), *faces])
        for axis, size in enumerate((x, y)):
            way = np.zeros_like(local)
            way[:, axis] = np.where(local[:, axis] < 0, -1.0, 1.0)
            faces.append((np.abs(local[:, axis]) - size / 2, way))
        return _largest(faces)


def _from_center(
    gaps_m: Float[np.ndarray, "n 3"], radius_m: float
) -> tuple[np.ndarray, np.ndarray]:
    length = np.linalg.norm(gaps_m, axis=1)
    return length - radius_m, gaps_m / np.maximum(length, 1e-9)[:, None]


def _largest(faces: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    distances = np.stack([distance for distance, _ in faces])
    chosen, index = distances.argmax(axis=0), np.arange(distances.shape[1])
    return distances[chosen, index], np.stack([normal for _, normal in faces])[chosen, index]


FORMS: dict[Shape, Form] = {
    "box": "box", "cylinder": "cylinder", "cup": "cylinder", "ball": "ball", "cone": "cone",
    "ring": "ring",
}  # fmt: skip
"""Form of each loose shape; a cup counts as a full cylinder."""


@cache
def solids_of(shape: Shape, size_m: tuple[float, float, float]) -> tuple[Solid, ...]:
    """Return the solids of a body, in the frames of its parts."""
    x, y, z = size_m
    if shape == "drawer":
        front, handle = (x - 0.022, 0.008, z - 0.022), (0.04, 0.02, 0.012)
        return (
            Solid(form="box", size_m=front, origin_m=(0.0, -y / 2 - 0.002, 0.011)),
            Solid(
                form="box", size_m=handle,
                origin_m=(0.0, -y / 2 - 0.016, z / 2 - 0.006), handle=True,
            ),
            Solid(form="box", size_m=size_m, part=1),
        )  # fmt: skip
    if shape == "lidded box":
        lid = LID_M
        return (
            Solid(form="box", size_m=(x, y, lid), origin_m=(0.0, 0.0, z - lid)),
            Solid(
                form="box", size_m=(0.036, 0.014, lid - 0.003),
                origin_m=(0.0, -y / 2 - 0.007, z - lid + 0.002), handle=True,
            ),
            Solid(form="box", size_m=(x, y, z - lid), part=1),
        )  # fmt: skip
    return (Solid(form=FORMS[shape], size_m=size_m),)


def surface_of(
    scene: Scene, body: Body, points_m: Float[np.ndarray, "n 3"], *, handle: bool = False
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Return the signed distance, world normal and whether the part moves, at each point.

    With `handle`, only the handle of furniture counts; a loose body counts completely.
    """
    solids = []
    for solid in solids_of(body.shape, body.size_m):
        if handle and body.articulated and not solid.handle:
            continue
        moving = solid.part == 0
        pose = scene.first_part_pose(body.name) if moving else body.world_from_body
        distance, normal = solid.at(transform(invert(pose), points_m))
        solids.append((distance, normal @ pose[:3, :3].T, np.full(len(points_m), moving)))
    distances = np.stack([distance for distance, *_ in solids])
    nearest, index = distances.argmin(axis=0), np.arange(len(points_m))
    return tuple(np.stack(values)[nearest, index] for values in zip(*solids, strict=True))  # type: ignore[return-value]


def bodies_near(scene: Scene, points_m: Float[np.ndarray, "p 3"], margin_m: float) -> list[Body]:
    """Return the bodies that may be nearer to a point than the margin, by bounding spheres."""
    centers = np.array([body.world_from_body[:3, 3] for body in scene.bodies]).reshape(-1, 3)
    gaps = points_m[:, None] - centers
    nearest = np.sqrt((gaps**2).sum(axis=-1).min(axis=0))
    return [
        body
        for body, gap in zip(scene.bodies, nearest, strict=True)
        if gap < np.linalg.norm(body.size_m) + DRAWER_M * body.articulated + margin_m
    ]
