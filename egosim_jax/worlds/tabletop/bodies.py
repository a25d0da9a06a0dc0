"""Bodies of the tabletop world: meshes, solid textures and articulated furniture.

World axes: x right, y away from the wearer, z up, in meters; the table top is z = 0 and its near
edge y = 0. The origin of a body is the center of its underside.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Int

from egosim_jax.rendering.mesh import vertex_normals
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop.embree import Mesh, make_mesh

Shape = Literal["box", "cylinder", "ball", "cone", "ring", "cup", "lidded box", "drawer"]
LOOSE: tuple[Shape, ...] = ("box", "cylinder", "ball", "cone", "ring", "cup")
"""Shapes of bodies that can be picked up."""
COLORS = {
    "red": (196, 48, 43),
    "orange": (226, 126, 38),
    "yellow": (230, 197, 56),
    "green": (58, 150, 72),
    "blue": (44, 92, 190),
    "purple": (126, 64, 160),
    "white": (226, 224, 216),
    "black": (16, 16, 17),
}
"""RGB by color name in captions."""
STATIC_COLOR = "black"
"""Color of bodies that are never manipulated.

Perception cannot segment black by color, and in a prior only the mask distinguishes black from
unobserved pixels.
"""
TABLE_SIZE_M = (1.3, 0.62, 0.03)
"""Extent of the table top in meters."""
REACH_M = (-0.20, 0.20, 0.15, 0.37)
"""Minimum and maximum x, then y, of placed bodies in meters: within view and reach."""
HANDLE_M = 0.016
"""Width of a handle between the fingertips, in meters."""
LID_M = 0.012
"""Thickness of a chest's lid in meters; its hinge is at the far upper edge of the case."""

Pattern = Literal["plain", "stripes", "checks", "grain"]


@dataclass(frozen=True, kw_only=True)
class Paint:
    """A solid texture: a color at every point of a body's local frame."""

    color: tuple[int, int, int]
    """RGB of the texture."""
    second: tuple[int, int, int] = (0, 0, 0)
    """RGB of the pattern; a plain paint does not use it."""
    pattern: Pattern = "plain"
    """Alternation between both colors."""
    scale_m: float = 0.03
    """Period of the pattern in meters."""

    def at(self, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Return RGB in [0, 1] at points in the body's local frame."""
        first, second = np.array([self.color, self.second], points_m.dtype) / 255
        if self.pattern == "plain":
            return np.broadcast_to(first, points_m.shape)
        x, y, z = (points_m / self.scale_m).T
        if self.pattern == "stripes":
            share = (np.floor(2 * z) % 2 == 0).astype(points_m.dtype)
        elif self.pattern == "checks":
            share = (np.floor(x + 1e-4) + np.floor(y + 1e-4) + np.floor(z + 1e-4)) % 2
        else:
            bend = (
                np.sin(1.7 * x) + 0.5 * np.sin(4.1 * x + 2.0 * y) + 0.3 * np.sin(9.3 * x - 3.1 * y)
            )
            share = 0.5 + 0.5 * np.sin(2 * np.pi * y + bend)
        return first + share[:, None] * (second - first)


@dataclass(frozen=True, kw_only=True)
class Part:
    """A rigid part: a textured triangle mesh in its local frame."""

    name: str
    """Name of the body, for debugging."""
    vertices_m: Float[np.ndarray, "v 3"]
    """Vertices of the mesh in meters."""
    triangles: Int[np.ndarray, "t 3"]
    """Vertex indices of each triangle."""
    paint: Paint
    """Texture of the mesh."""
    smooth: bool = False
    """Interpolate vertex normals, for round surfaces."""

    @classmethod
    def plain(
        cls, name: str, mesh: Mesh, color: tuple[int, int, int], *, smooth: bool = False
    ) -> Part:
        """Return a part of one color."""
        vertices, triangles = mesh
        paint = Paint(color=color)
        return cls(name=name, vertices_m=vertices, triangles=triangles, paint=paint, smooth=smooth)

    @cached_property
    def vertex_normals(self) -> Float32[np.ndarray, "v 3"]:
        """Area-weighted mean normal of the triangles of each vertex."""
        return vertex_normals(self.vertices_m, self.triangles).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Body:
    """An object on the table."""

    name: str
    """Name in captions, such as "red box"; unique in a scene."""
    shape: Shape
    """Class of its shape."""
    size_m: tuple[float, float, float]
    """Extent along the axes of its local frame in meters."""
    parts: tuple[Part, ...]
    """Rigid parts; only the first one moves when the body is opened."""
    world_from_body: Float[np.ndarray, "4 4"]
    """Pose in the world."""

    @property
    def static(self) -> bool:
        """True for a body that is never manipulated."""
        return self.name.startswith(STATIC_COLOR)

    @property
    def articulated(self) -> bool:
        """True for a body that is opened instead of carried."""
        return len(self.parts) > 1

    @property
    def grip_m(self) -> float:
        """Width between the fingertips that grasp it, in meters: of a rim, a handle or the body."""
        if self.articulated:
            return HANDLE_M
        if self.shape == "ring":
            return self.size_m[2]
        return 0.55 * self.size_m[0] if self.shape == "cone" else self.size_m[0]


def box(low: tuple[float | int, ...], high: tuple[float | int, ...]) -> Mesh:
    """Return the mesh of an axis-aligned box between two corners."""
    extent = np.subtract(high, low).astype(float)
    if (extent <= 0).any():
        raise InputError(
            f"The box from {low} to {high} is empty: each coordinate of the second corner must "
            "exceed the same coordinate of the first."
        )
    vertices, triangles = make_mesh("box", *extent)
    return vertices + np.array(low), triangles


def join(*pieces: Mesh) -> Mesh:
    """Concatenate meshes into one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
    vertices = np.concatenate([vertices for vertices, _ in pieces])
    triangles = [tri + start for (_, tri), start in zip(pieces, starts, strict=False)]
    return vertices, np.concatenate(triangles)


def split_edges(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """Duplicate vertices along edges sharper than 50 degrees.

    A vertex normal is a mean over the triangles of the vertex, so a shared vertex would shade a
    sharp edge as a round one.
    """
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    points, faces = [], triangles.copy()
    corners = np.argsort(triangles, axis=None, kind="stable")
    counts = np.bincount(triangles.ravel(), minlength=len(vertices))
    for vertex, around in enumerate(np.split(corners, np.cumsum(counts)[:-1])):
        of_corners = normals[around // 3]
        near = of_corners @ of_corners.T > np.cos(np.radians(50))
        if near.all():  # as at most vertices of round bodies
            faces.flat[around] = len(points)
            points.append(vertices[vertex])
            continue
        left = np.ones(len(around), bool)
        while left.any():
            group = np.zeros_like(left)
            reached = np.arange(len(left)) == np.flatnonzero(left)[-1]
            while reached.any():
                group |= reached
                left &= ~reached
                reached = left & near[reached].any(axis=0)
            faces.flat[around[group]] = len(points)
            points.append(vertices[vertex])
    return np.array(points), faces


def _outline(shape: Shape, size: tuple[float, float, float]) -> Mesh:
    """Return the mesh of a loose body."""
    x, y, z = size
    radius = x / 2
    if shape == "box":
        return box((-x / 2, -y / 2, 0), (x / 2, y / 2, z))
    if shape == "ball":
        vertices, triangles = make_mesh("sphere", radius, 24)
        return vertices + [0, 0, radius], triangles
    if shape == "ring":
        tube = z / 2
        vertices, triangles = make_mesh("torus", radius - tube, tube, 40, 16)
        return vertices + [0, 0, tube], triangles
    if shape == "cone":
        return make_mesh("cone", radius, z, 40)
    if shape == "cup":
        return _cup(radius, z)
    vertices, triangles = make_mesh("cylinder", radius, z, 40, 1)
    return vertices + [0, 0, z / 2], triangles


def _cup(outer: float, height: float) -> Mesh:
    """Return the mesh of a cup: a cylinder that is open at the top."""
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    wall = floor = 0.006
    inner = outer - wall
    rings = [(outer, 0.0), (outer, height), (inner, height), (inner, floor)]
    vertices = np.concatenate([circle * r + [0, 0, z] for r, z in rings] + [[[0, 0, floor]]])
    count, start = len(angles), np.arange(len(angles))
    end = (start + 1) % count
    faces = []
    for ring in range(3):
        a, b = start + ring * count, end + ring * count
        faces += [np.stack([a, b, b + count], 1), np.stack([a, b + count, a + count], 1)]
    faces.append(np.stack([start + 3 * count, end + 3 * count, np.full(count, 4 * count)], 1))
    return vertices, np.concatenate(faces)


def darker(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return a color at 58 % of its brightness."""
    red, green, blue = (int(0.58 * value) for value in color)
    return red, green, blue


def make_loose(shape: Shape, color: str, rng: np.random.Generator) -> Body:
    """Return a loose body of random size and pattern at the origin."""
    width = float(rng.uniform(0.066, 0.08))
    height = float(rng.uniform(0.065, 0.09))
    if shape == "ball":
        height = width
    if shape == "ring":
        width, height = float(rng.uniform(0.08, 0.10)), 0.03
    choices: tuple[Pattern, ...] = ("plain",)
    if shape == "box":
        choices = ("plain", "plain", "stripes", "checks")
    if shape in ("cylinder", "cup"):
        choices = ("plain", "stripes")
    pattern = choices[int(rng.integers(len(choices)))]
    return build_loose(shape, color, (width, width, height), pattern)


def build_loose(
    shape: Shape, color: str, size: tuple[float, float, float], pattern: Pattern
) -> Body:
    """Return a loose body at the origin; `size` is its extent along x, y and z in meters."""
    vertices, triangles = split_edges(*_outline(shape, size))
    paint = Paint(color=COLORS[color], second=darker(COLORS[color]), pattern=pattern)
    part = Part(
        name=shape, vertices_m=vertices, triangles=triangles, paint=paint, smooth=shape != "box"
    )
    return Body(
        name=f"{color} {shape}",
        shape=shape,
        size_m=size,
        parts=(part,),
        world_from_body=np.eye(4),
    )


def make_drawer(color: str) -> Body:
    """Return a cabinet whose drawer slides towards the wearer (-y)."""
    width, depth, height, wall = 0.16, 0.12, 0.08, 0.008
    x, y = width / 2, depth / 2
    case = join(
        box((-x, -y, 0), (x, y, wall)),
        box((-x, -y, height - wall), (x, y, height)),
        box((-x, -y, wall), (-x + wall, y, height - wall)),
        box((x - wall, -y, wall), (x, y, height - wall)),
        box((-x, y - wall, wall), (x, y, height - wall)),
    )
    left, right, low, high = -x + 0.011, x - 0.011, 0.011, height - 0.011
    tray = join(
        box((left, -y - 0.006, low), (right, -y + 0.002, high)),
        box((left, -y + 0.002, low), (right, y - 0.012, low + 0.004)),
        box((left, -y + 0.002, low), (left + 0.004, y - 0.012, high - 0.02)),
        box((right - 0.004, -y + 0.002, low), (right, y - 0.012, high - 0.02)),
        box((-0.02, -y - 0.026, height / 2 - 0.006), (0.02, -y - 0.006, height / 2 + 0.006)),
    )
    return Body(
        name=f"{color} cabinet",
        shape="drawer",
        size_m=(width, depth, height),
        parts=(
            Part.plain("drawer", tray, (205, 190, 165)),
            Part.plain("case", case, COLORS[color]),
        ),
        world_from_body=np.eye(4),
    )


def make_lidded_box(color: str) -> Body:
    """Return a box whose lid rotates about its far upper edge."""
    width, depth, height, wall, lid = 0.13, 0.10, 0.06, 0.007, LID_M
    x, y = width / 2, depth / 2
    case = join(
        box((-x, -y, 0), (x, y, wall)),
        box((-x, -y, wall), (-x + wall, y, height)),
        box((x - wall, -y, wall), (x, y, height)),
        box((-x + wall, -y, wall), (x - wall, -y + wall, height)),
        box((-x + wall, y - wall, wall), (x - wall, y, height)),
    )
    cover = join(
        box((-x, -y, height + 0.001), (x, y, height + lid)),
        box((-0.018, -y - 0.014, height + 0.002), (0.018, -y, height + lid - 0.001)),
    )
    return Body(
        name=f"{color} chest",
        shape="lidded box",
        size_m=(width, depth, height + lid),
        parts=(
            Part.plain("lid", cover, COLORS[color]),
            Part.plain("case", case, darker(COLORS[color])),
        ),
        world_from_body=np.eye(4),
    )
