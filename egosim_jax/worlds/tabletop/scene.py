"""Scenes of the tabletop world: poses of all bodies, free places, and random scenes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from egosim_jax.geometry import rotation_z
from egosim_jax.types import InputError
from egosim_jax.worlds.tabletop.bodies import (
    COLORS,
    LID_M,
    LOOSE,
    REACH_M,
    TABLE_SIZE_M,
    Body,
    Paint,
    Part,
    Pattern,
    box,
    make_drawer,
    make_lidded_box,
    make_loose,
)
from egosim_jax.worlds.tabletop.raycast import Placed

TABLE, FLOOR, WALL, FIRST_BODY, FIRST_HAND = 1, 2, 3, 10, 100
"""Instance ids in renderings.

Body i has 10 + 2 i, and its case, if any, 11 + 2 i. Hand i has 100 + 2 i, and its forearm
101 + 2 i.
"""
DRAWER_M = 0.075
"""Travel of an open drawer in meters."""
LID_DEGREES = 100.0
"""Rotation of an open lid in degrees."""
WOODS = (
    (196, 178, 150), (170, 168, 160), (118, 92, 72), (105, 112, 120), (214, 200, 172), (88, 78, 70),
    (150, 122, 92),
)  # fmt: skip
"""RGB of table tops: oak, ash, walnut, slate, birch, wenge, teak."""
GAP_M = 0.035
"""Minimum distance between the footprints of two bodies, in meters."""
MIN_BODIES = 3
"""Minimum number of bodies on a table."""
MAX_BODIES = 6
"""Maximum number of bodies on a table."""
CLOTH_COLOR = (2, 2, 2)
"""RGB of black cloths, which look like unobserved pixels of a prior."""
CLOTH_M = (0.08, 0.30)
"""Minimum and maximum side length of a cloth in meters."""
CLOTH_AREA_M = (-0.34, 0.34, 0.06, 0.52)
"""Minimum and maximum x, then y, of the centers of cloths in meters: in view or at its border."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """All bodies and their poses at one moment."""

    bodies: tuple[Body, ...]
    """Bodies on the table, with their poses."""
    room: tuple[Placed, ...]
    """Table, floor and walls."""
    openings: Mapping[str, float]
    """Opening of each articulated body by name, from closed (0) to open (1)."""

    def body(self, name: str) -> Body:
        """Return the body with a name."""
        return next(body for body in self.bodies if body.name == name)

    def with_pose(self, name: str, world_from_body: Float[np.ndarray, "4 4"]) -> Scene:
        """Return the scene with another pose of one body."""
        bodies = (
            replace(body, world_from_body=world_from_body) if body.name == name else body
            for body in self.bodies
        )
        return replace(self, bodies=tuple(bodies))

    def with_opening(self, name: str, opening: float) -> Scene:
        """Return the scene with another opening of one articulated body."""
        return replace(self, openings={**self.openings, name: opening})

    def instance_id(self, name: str) -> int:
        """Return the instance id of a body, or of its moving part."""
        return FIRST_BODY + 2 * [body.name for body in self.bodies].index(name)

    def names(self) -> dict[int, str]:
        """Return the names of all bodies and cases by instance id."""
        names = {}
        for body in self.bodies:
            names[self.instance_id(body.name)] = body.name
            if body.articulated:
                names[self.instance_id(body.name) + 1] = f"case of the {body.name}"
        return names

    def first_part_pose(self, name: str) -> Float[np.ndarray, "4 4"]:
        """Return the pose of a body or, if it is articulated, of its moving part."""
        body = self.body(name)
        if not body.articulated:
            return body.world_from_body
        return body.world_from_body @ moving_part(body, self.openings[name])

    def placed(self) -> list[Placed]:
        """Return every part of room and bodies with its pose, without hands."""
        items = list(self.room)
        for body in self.bodies:
            first = self.instance_id(body.name)
            poses = self.first_part_pose(body.name), body.world_from_body
            items += [
                Placed(part=part, world_from_part=pose, instance_id=first + index)
                for index, (part, pose) in enumerate(zip(body.parts, poses, strict=False))
            ]
        return items

    def free_place(
        self, body: Body, rng: np.random.Generator, *, away_m: tuple[float, float] = (0, np.inf)
    ) -> Float[np.ndarray, " 2"] | None:
        """Sample a free x and y for a body in meters, or None if 200 samples fail.

        `away_m` is the minimum and maximum distance from its present place, in meters.
        """
        start = body.world_from_body[:2, 3]
        for _ in range(200):
            place = rng.uniform([REACH_M[0], REACH_M[2]], [REACH_M[1], REACH_M[3]])
            if not away_m[0] <= np.linalg.norm(place - start) <= away_m[1]:
                continue
            if all(
                np.linalg.norm(place - other.world_from_body[:2, 3])
                > footprint(body) + footprint(other) + GAP_M
                for other in self.bodies
                if other.name != body.name
            ):
                return place
        return None


def footprint(body: Body) -> float:
    """Return the radius of the circle that a body occupies in meters, open drawer included."""
    reach = DRAWER_M + 0.03 if body.shape == "drawer" else 0.0
    return float(np.hypot(body.size_m[0], body.size_m[1]) / 2 + reach / 2)


def moving_part(body: Body, opening: float) -> Float[np.ndarray, "4 4"]:
    """Return the pose `body_from_part` of a drawer or a lid at an opening in [0, 1]."""
    pose = np.eye(4)
    if body.shape == "drawer":
        pose[1, 3] = -DRAWER_M * opening
        return pose
    angle = np.radians(LID_DEGREES) * opening
    hinge = np.array([0.0, body.size_m[1] / 2, body.size_m[2] - LID_M])
    cosine, sine = np.cos(angle), np.sin(angle)
    pose[:3, :3] = [[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]]
    pose[:3, 3] = hinge - pose[:3, :3] @ hinge
    return pose


def sample_scene(rng: np.random.Generator) -> Scene:
    """Sample a scene of 3 to 6 bodies in different colors, at most one of them articulated."""
    while len((scene := _scatter(rng)).bodies) < MIN_BODIES:
        pass  # sample again: too few bodies found a free place
    return scene


def with_cloths(scene: Scene, rng: np.random.Generator, max_cloths: int) -> Scene:
    """Return the scene with up to `max_cloths` black cloths on the table, under its bodies."""
    # Without cloths a model need not read the mask: black in a prior is unobserved unless it has
    # the outline of a black body.
    if max_cloths < 0:
        raise InputError(
            f"{max_cloths} cloths cannot be put on a table: the number must be at least 0. "
            "(--black-cloths)"
        )
    cloths = []
    for number in range(rng.integers(max_cloths + 1)):
        x, y = rng.uniform(*CLOTH_M, 2) / 2
        height = 5e-4 * (number + 1)  # 0.5 mm apart, so overlapping cloths have no equal depth
        cloth = Part.plain("cloth", box((-x, -y, 0), (x, y, height)), CLOTH_COLOR)
        pose = np.eye(4)
        pose[:3, :3] = rotation_z(rng.uniform(-np.pi, np.pi))
        pose[:2, 3] = rng.uniform(CLOTH_AREA_M[::2], CLOTH_AREA_M[1::2])
        cloths.append(Placed(part=cloth, world_from_part=pose, instance_id=TABLE))
    return replace(scene, room=(*scene.room, *cloths))


def _scatter(rng: np.random.Generator) -> Scene:
    """Place random bodies one after another; skip those without a free place."""
    scene = Scene(bodies=(), room=make_room(rng), openings={})
    names = list(rng.permutation(list(COLORS)))
    count = int(rng.integers(MIN_BODIES, MAX_BODIES + 1))
    candidates: list[Body] = []
    if rng.random() < 0.5:
        make = make_drawer if rng.random() < 0.5 else make_lidded_box
        candidates.append(make(str(names.pop())))
    while len(candidates) < count:
        candidates.append(make_loose(LOOSE[rng.integers(len(LOOSE))], str(names.pop()), rng))
    for body in candidates:
        place = scene.free_place(body, rng)
        if place is None:
            continue
        pose = np.eye(4)
        if not body.articulated:
            pose[:3, :3] = rotation_z(rng.uniform(-np.pi, np.pi))
        pose[:2, 3] = place
        scene = replace(
            scene,
            bodies=(*scene.bodies, replace(body, world_from_body=pose)),
            openings={**scene.openings, **({body.name: 0.0} if body.articulated else {})},
        )
    return scene


def make_room(rng: np.random.Generator) -> tuple[Placed, ...]:
    """Return table, floor and three walls in random colors."""
    x, y, z = TABLE_SIZE_M
    wood = np.array(WOODS[rng.integers(len(WOODS))]) + rng.normal(0, 6, 3)
    walls = rng.uniform(150, 205) + rng.normal(0, 12, 3)
    floors = rng.uniform(75, 125) + rng.normal(0, 8, 3)
    pieces: list[tuple[str, tuple, np.ndarray, Pattern, float, int]] = [
        ("table", box((-x / 2, 0, -z), (x / 2, y, 0)), wood, "grain", 0.06, TABLE),
        ("floor", box((-2.5, -1.5, -0.76), (2.5, 2.5, -0.74)), floors, "checks", 0.30, FLOOR),
        ("far wall", box((-2.5, 1.6, -0.75), (2.5, 1.62, 1.8)), walls, "stripes", 0.24, WALL),
        ("left wall", box((-2.0, -1.5, -0.75), (-1.98, 1.6, 1.8)), walls, "plain", 0.24, WALL),
        ("right wall", box((1.98, -1.5, -0.75), (2.0, 1.6, 1.8)), walls, "plain", 0.24, WALL),
    ]
    placed = []
    for name, (vertices, triangles), color, pattern, scale, number in pieces:
        first, second = np.clip(color, 0, 255), np.clip(color * 0.86, 0, 255)
        paint = Paint(color=_rgb(first), second=_rgb(second), pattern=pattern, scale_m=scale)
        part = Part(name=name, vertices_m=vertices, triangles=triangles, paint=paint)
        placed.append(Placed(part=part, world_from_part=np.eye(4), instance_id=number))
    return tuple(placed)


def _rgb(color: np.ndarray) -> tuple[int, int, int]:
    red, green, blue = (int(value) for value in color)
    return red, green, blue
