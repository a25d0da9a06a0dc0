"""What stands in the tabletop world: shapes, their paint, and where they are put at the start.

The world's axes: x right, y away from the wearer, z up, in meters; the table top is z = 0 and its
near edge y = 0. A body's own origin lies in the middle of its underside.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Int

from egosim_jax.types import InputError

Shape = Literal["box", "cylinder", "ball", "cone", "ring", "cup", "lidded box", "drawer"]
LOOSE: tuple[Shape, ...] = ("box", "cylinder", "ball", "cone", "ring", "cup")
"""Shapes that can be picked up."""
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
STAYS = "black"
"""Color of things that are never acted on. In a prior they look like what was never seen, so that
the mask has to tell; and a black thing could not be found in a picture by its color."""
TABLE_SIZE_M = (1.3, 0.62, 0.03)
REACH_M = (-0.20, 0.20, 0.15, 0.37)
"""Least and greatest x and y at which things are put: within sight and reach."""


Pattern = Literal["plain", "stripes", "checks", "grain"]


@dataclass(frozen=True, kw_only=True)
class Paint:
    """A solid texture: a color at every point of a body's own space."""

    color: tuple[int, int, int]
    """RGB."""
    second: tuple[int, int, int]
    """RGB of the pattern."""
    pattern: Pattern
    """What alternates between the two."""
    scale_m: float
    """Length of a repetition."""

    def at(self, points_m: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """RGB in [0, 1] at points of the body's space."""
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
    """A rigid piece: a triangle mesh in its own space, and its paint."""

    name: str
    vertices_m: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    paint: Paint
    smooth: bool = False
    """Whether the mesh stands for a round surface, shaded without facets."""

    @cached_property
    def vertex_normals(self) -> Float32[np.ndarray, "v 3"]:
        """Of each vertex: the mean of its triangles' normals, by area."""
        a, b, c = (self.vertices_m[self.triangles[:, k]] for k in range(3))
        faces = np.cross(b - a, c - a)
        normals = np.zeros_like(self.vertices_m)
        for k in range(3):
            np.add.at(normals, self.triangles[:, k], faces)
        length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
        return (normals / length[:, None]).astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Body:
    """A thing on the table."""

    name: str
    """What a caption calls it, such as "red box"; unique in a scene."""
    shape: Shape
    size_m: tuple[float, float, float]
    """Extent along its own axes."""
    parts: tuple[Part, ...]
    """The first is what moves when the thing is opened or carried; loose bodies have one."""
    world_from_body: Float[np.ndarray, "4 4"]
    """Pose at the start."""

    @property
    def stays(self) -> bool:
        """Whether it is left alone."""
        return self.name.startswith(STAYS)

    @property
    def articulated(self) -> bool:
        """Whether it is opened instead of carried."""
        return len(self.parts) > 1


def mesh(kind: str, **sizes: float | int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of an Open3D shape."""
    import open3d as o3d

    shape = getattr(o3d.geometry.TriangleMesh, f"create_{kind}")(**sizes)
    return np.asarray(shape.vertices).copy(), np.asarray(shape.triangles).copy()


def box(
    low: tuple[float | int, ...], high: tuple[float | int, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """A box between two corners."""
    extent = np.subtract(high, low).astype(float)
    if (extent <= 0).any():
        raise InputError(f"A box from {low} to {high} is empty: every side must be positive.")
    vertices, triangles = mesh("box", width=extent[0], height=extent[1], depth=extent[2])
    return vertices + np.array(low), triangles


def join(*pieces: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one."""
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in pieces)])
    vertices = np.concatenate([vertices for vertices, _ in pieces])
    triangles = [tri + start for (_, tri), start in zip(pieces, starts, strict=False)]
    return vertices, np.concatenate(triangles)


def split_edges(
    vertices: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[np.ndarray, np.ndarray]:
    """The same surface with vertices doubled along edges sharper than 50 degrees.

    Normals that are means over a vertex's triangles then stay sharp where the shape is.
    """
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals = normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None]
    points, faces = [], triangles.copy()
    for vertex in range(len(vertices)):
        left = [tuple(corner) for corner in np.argwhere(triangles == vertex)]
        while left:
            group = [left.pop()]
            for corner in group:
                near = [
                    o for o in left if normals[o[0]] @ normals[corner[0]] > np.cos(np.radians(50))
                ]
                group += near
                left = [other for other in left if other not in near]
            for face, corner in group:
                faces[face, corner] = len(points)
            points.append(vertices[vertex])
    return np.array(points), faces


def _outline(shape: Shape, size: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
    """The mesh of a loose body."""
    x, y, z = size
    radius = x / 2
    if shape == "box":
        return box((-x / 2, -y / 2, 0), (x / 2, y / 2, z))
    if shape == "ball":
        vertices, triangles = mesh("sphere", radius=radius, resolution=24)
        return vertices + [0, 0, radius], triangles
    if shape == "ring":
        tube = z / 2
        vertices, triangles = mesh(
            "torus", torus_radius=radius - tube, tube_radius=tube,
            radial_resolution=40, tubular_resolution=16,
        )  # fmt: skip
        return vertices + [0, 0, tube], triangles
    if shape == "cone":
        return mesh("cone", radius=radius, height=z, resolution=40)
    wall = 0.006
    outside, sides = mesh("cylinder", radius=radius, height=z, resolution=40, split=1)
    solid = outside + [0, 0, z / 2], sides
    if shape == "cylinder":
        return solid
    # A cup is a cylinder whose upper end is a dark disc a little lower than its rim.
    return _tube(radius, radius - wall, z)


def _tube(outer: float, inner: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    """A cylinder with a hole from above that ends at its floor."""
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1)
    floor = 0.006
    rings = [(outer, 0.0), (outer, height), (inner, height), (inner, floor)]
    vertices = np.concatenate([circle * r + [0, 0, z] for r, z in rings] + [[[0, 0, floor]]])
    count, here = len(angles), np.arange(len(angles))
    after = (here + 1) % count
    faces = []
    for ring in range(3):
        a, b = here + ring * count, after + ring * count
        faces += [np.stack([a, b, b + count], 1), np.stack([a, b + count, a + count], 1)]
    faces.append(np.stack([here + 3 * count, after + 3 * count, np.full(count, 4 * count)], 1))
    return vertices, np.concatenate(faces)


def darker(color: tuple[int, int, int]) -> tuple[int, int, int]:
    """The same color in shade."""
    red, green, blue = (int(0.58 * value) for value in color)
    return red, green, blue


def make_loose(shape: Shape, color: str, rng: np.random.Generator) -> Body:
    """A thing to pick up, of random size, at the origin."""
    width = float(rng.uniform(0.066, 0.08))
    height = float(rng.uniform(0.065, 0.09))
    if shape == "ball":
        height = width
    if shape == "ring":
        width, height = float(rng.uniform(0.08, 0.10)), 0.03
    size = (width, width, height)
    vertices, triangles = split_edges(*_outline(shape, size))
    choices: tuple[Pattern, ...] = ("plain",)
    if shape == "box":
        choices = ("plain", "plain", "stripes", "checks")
    if shape in ("cylinder", "cup"):
        choices = ("plain", "stripes")
    pattern = choices[int(rng.integers(len(choices)))]
    second = darker(COLORS[color])
    paint = Paint(color=COLORS[color], second=second, pattern=pattern, scale_m=0.03)
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
    """A cabinet whose drawer slides out towards the wearer (-y)."""
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
    body, second = COLORS[color], darker(COLORS[color])
    plain = Paint(color=body, second=second, pattern="plain", scale_m=0.05)
    light = replace(plain, color=(205, 190, 165))
    return Body(
        name=f"{color} cabinet",
        shape="drawer",
        size_m=(width, depth, height),
        parts=(
            Part(name="drawer", vertices_m=tray[0], triangles=tray[1], paint=light),
            Part(name="case", vertices_m=case[0], triangles=case[1], paint=plain),
        ),
        world_from_body=np.eye(4),
    )


def make_lidded_box(color: str) -> Body:
    """A box whose lid turns about its far upper edge; the lid's own origin lies on that hinge."""
    width, depth, height, wall, lid = 0.13, 0.10, 0.06, 0.007, 0.012
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
    body, second = COLORS[color], darker(COLORS[color])
    plain = Paint(color=second, second=body, pattern="plain", scale_m=0.05)
    return Body(
        name=f"{color} chest",
        shape="lidded box",
        size_m=(width, depth, height + lid),
        parts=(
            Part(
                name="lid",
                vertices_m=cover[0],
                triangles=cover[1],
                paint=replace(plain, color=body),
            ),
            Part(name="case", vertices_m=case[0], triangles=case[1], paint=plain),
        ),
        world_from_body=np.eye(4),
    )
