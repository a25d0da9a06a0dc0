"""Solids of the MuJoCo world: primitives, and meshes made in code, with procedural textures."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import mujoco
import numpy as np

SIDES = 24
"""Number of sides of a round mesh."""
SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "ellipsoid": mujoco.mjtGeom.mjGEOM_ELLIPSOID,
    "mesh": mujoco.mjtGeom.mjGEOM_MESH,
}


@dataclass(frozen=True)
class Mesh:
    """Triangles of a closed surface, outwards."""

    vertices_m: np.ndarray
    faces: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Part:
    """One geometry of a solid: a primitive or a mesh."""

    shape: Literal["box", "cylinder", "sphere", "capsule", "ellipsoid", "mesh"]
    size_m: tuple[float, ...] = ()
    """Half sizes, or radius and half length, as in MuJoCo."""
    center_m: tuple[float, float, float] = (0, 0, 0)
    turn: tuple[float, float, float, float] = (1, 0, 0, 0)
    """Rotation as a quaternion (w, x, y, z)."""
    mesh: Mesh | None = None


@dataclass(frozen=True, kw_only=True)
class Solid:
    """A rigid body that stands on z = 0 in its own coordinates; jaws take it along x."""

    parts: tuple[Part, ...]
    height_m: float
    reach_m: float
    """Radius of a vertical cylinder around the origin that contains the solid."""
    half_depth_m: float
    """Half of its size along y."""


@dataclass(frozen=True, kw_only=True)
class Texture:
    """Albedo as a function of the position in a body's coordinates."""

    colors: tuple[tuple[int, int, int], tuple[int, int, int]]
    pattern: Literal["plain", "checks", "stripes", "spots", "grain"] = "plain"
    period_m: float = 0.02
    phase: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def __call__(self, points_m: np.ndarray) -> np.ndarray:
        """Return RGB from 0 to 1 of points."""
        x, y, z = np.moveaxis(2 * np.pi * points_m / self.period_m + self.phase, -1, 0)
        share = {
            "plain": lambda: 0.06 * np.sin(x + 2 * z) * np.sin(y - z),
            "checks": lambda: np.sin(x) * np.sin(y + 0.3) * np.sin(z + 0.7) > 0,
            "stripes": lambda: np.sin(x + 0.6 * y + z) > 0,
            "spots": lambda: np.cos(x) + np.cos(y) + np.cos(z) > 1.2,
            "grain": lambda: (
                0.5
                + 0.3 * np.sin(0.25 * y + 1.7 * np.sin(0.04 * x) + 0.6 * np.sin(0.31 * x))
                + 0.2 * np.sin(x + 0.8 * np.sin(0.7 * y))
            ),
        }[self.pattern]()
        first, second = np.array(self.colors) / 255
        return first + np.asarray(share, float)[..., None] * (second - first)


def lathe(profile_m: list[tuple[float, float]]) -> Mesh:
    """Return a surface of revolution: the profile (radius, z), counterclockwise, about z."""
    angles = np.linspace(0, 2 * np.pi, SIDES, endpoint=False)
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(SIDES)], axis=1)
    vertices = np.concatenate([r * ring + [0, 0, z] for r, z in profile_m])
    return Mesh(vertices, _strips(len(profile_m), SIDES))


def tube(path_m: np.ndarray, radius_m: float) -> Mesh:
    """Return a tube along a path in the plane of x and z, with closed ends."""
    angles = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    ahead = np.gradient(path_m, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    side = np.cross(ahead, [0.0, 1.0, 0.0])
    circle = np.cos(angles)[:, None, None] * side + np.sin(angles)[:, None, None] * [0, 1.0, 0]
    rings = (path_m + radius_m * circle).swapaxes(0, 1)
    faces = _strips(len(path_m), 10)[: -2 * 10]
    ends = [[0, k + 1, k] for k in range(1, 9)]
    first = 10 * (len(path_m) - 1)
    ends += [[first, first + k, first + k + 1] for k in range(1, 9)]
    return Mesh(rings.reshape(-1, 3), np.concatenate([faces, ends]))


def _strips(rings: int, sides: int) -> np.ndarray:
    """Return the triangles between successive rings; the last ring joins the first."""
    faces = []
    for i in range(rings):
        for k in range(sides):
            a, b = i * sides + k, i * sides + (k + 1) % sides
            c, d = (x % (rings * sides) for x in (a + sides, b + sides))
            faces += [[a, b, d], [a, d, c]]
    return np.array(faces)


def prism(corners_m: list[tuple[float, float]], height_m: float, top: float = 1.0) -> Mesh:
    """Return a prism over counterclockwise corners that all see the first one.

    The top is smaller or larger by a factor.
    """
    low, n = np.array(corners_m), len(corners_m)
    vertices = np.concatenate([np.c_[low, np.zeros(n)], np.c_[top * low, np.full(n, height_m)]])
    faces = [[0, k + 1, k] for k in range(1, n - 1)]
    faces += [[n, n + k, n + k + 1] for k in range(1, n - 1)]
    for k in range(n):
        m = (k + 1) % n
        faces += [[k, m, n + m], [k, n + m, n + k]]
    return Mesh(vertices, np.array(faces))


def block(x: float, y: float, z: float) -> Solid:
    """Return a box of full sizes."""
    part = Part(shape="box", size_m=(x / 2, y / 2, z / 2), center_m=(0, 0, z / 2))
    return Solid(parts=(part,), height_m=z, reach_m=float(np.hypot(x, y)) / 2, half_depth_m=y / 2)


def can(radius: float, z: float) -> Solid:
    """Return a standing cylinder."""
    part = Part(shape="cylinder", size_m=(radius, z / 2), center_m=(0, 0, z / 2))
    return Solid(parts=(part,), height_m=z, reach_m=radius, half_depth_m=radius)


def ball(x: float, y: float, z: float) -> Solid:
    """Return an ellipsoid of half sizes, a sphere if they are equal."""
    part = Part(shape="ellipsoid", size_m=(x, y, z), center_m=(0, 0, z))
    if x == y == z:
        part = Part(shape="sphere", size_m=(x,), center_m=(0, 0, z))
    return Solid(parts=(part,), height_m=2 * z, reach_m=max(x, y), half_depth_m=y)


def rod(radius: float, length: float) -> Solid:
    """Return a capsule along y, on its side."""
    turn = (np.sqrt(0.5), np.sqrt(0.5), 0, 0)
    half = length / 2 - radius
    part = Part(shape="capsule", size_m=(radius, half), center_m=(0, 0, radius), turn=turn)
    return Solid(parts=(part,), height_m=2 * radius, reach_m=length / 2, half_depth_m=length / 2)


def turned(profile_m: list[tuple[float, float]]) -> Solid:
    """Return a solid of revolution."""
    reach, height = np.max(profile_m, axis=0).tolist()
    part = Part(shape="mesh", mesh=lathe(profile_m))
    return Solid(parts=(part,), height_m=height, reach_m=reach, half_depth_m=reach)


def mug() -> Solid:
    """Return a mug: a hollow wall with a handle towards +y."""
    body = turned(
        [(1e-4, 0), (0.034, 0), (0.036, 0.08), (0.031, 0.08), (0.029, 0.006), (1e-4, 0.006)]
    )
    angles = np.linspace(-1.25, 1.25, 12)
    arc = np.stack([0.028 * np.cos(angles) + 0.026, 0 * angles, 0.026 * np.sin(angles) + 0.04], 1)
    quarter = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))
    handle = Part(shape="mesh", mesh=tube(arc, 0.005), turn=quarter)
    return Solid(parts=(*body.parts, handle), height_m=0.08, reach_m=0.06, half_depth_m=0.059)


def cut(corners_m: list[tuple[float, float]], height_m: float, top: float = 1.0) -> Solid:
    """Return a prism or its frustum as a solid."""
    reach = float(np.linalg.norm(corners_m, axis=1).max()) * max(1.0, top)
    part = Part(shape="mesh", mesh=prism(corners_m, height_m, top))
    depth = float(np.abs(np.array(corners_m)[:, 1]).max())
    return Solid(parts=(part,), height_m=height_m, reach_m=reach, half_depth_m=depth)


def regular(sides: int, radius: float) -> list[tuple[float, float]]:
    """Return the corners of a regular polygon."""
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    return [(radius * float(np.cos(a)), radius * float(np.sin(a))) for a in angles]


BOTTLE = [(1e-4, 0), (0.03, 0), (0.03, 0.075), (0.012, 0.1), (0.012, 0.13), (1e-4, 0.13)]
BOWL = [(1e-4, 0), (0.022, 0), (0.047, 0.045), (0.043, 0.045), (0.02, 0.006), (1e-4, 0.006)]
ELL = [
    (0.0125, -0.02), (0.0125, 0.04), (-0.0125, 0.04), (-0.0125, -0.045), (0.0675, -0.045),
    (0.0675, -0.02),
]  # fmt: skip
SOLIDS: dict[str, Callable[[], Solid]] = {
    "box": lambda: block(0.06, 0.045, 0.075),
    "cube": lambda: block(0.05, 0.05, 0.05),
    "book": lambda: block(0.13, 0.1, 0.025),
    "crate": lambda: block(0.15, 0.11, 0.08),
    "brick": lambda: block(0.08, 0.08, 0.05),
    "card": lambda: block(0.055, 0.085, 0.004),
    "can": lambda: can(0.032, 0.1),
    "tin": lambda: can(0.042, 0.045),
    "plate": lambda: can(0.048, 0.01),
    "sphere": lambda: ball(0.034, 0.034, 0.034),
    "ellipsoid": lambda: ball(0.03, 0.045, 0.026),
    "capsule": lambda: rod(0.02, 0.11),
    "pen": lambda: rod(0.006, 0.14),
    "mug": mug,
    "bowl": lambda: turned(BOWL),
    "bottle": lambda: turned(BOTTLE),
    "L": lambda: cut(ELL, 0.05),
    "hexagon": lambda: cut(regular(6, 0.038), 0.06),
    "wedge": lambda: cut([(-0.03, -0.03), (0.03, -0.03), (0.0, 0.04)], 0.05),
    "frustum": lambda: cut(regular(4, 0.05), 0.06, top=0.6),
}
"""Solids by name, from 4 mm to 15 cm."""
