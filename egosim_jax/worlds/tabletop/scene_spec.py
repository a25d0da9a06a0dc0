"""Scenes of your own: bodies with their places, in Python or as a JSON file.

    {"format": "egosim_jax.scene", "version": 1, "room": 0,
     "objects": [{"shape": "box", "color": "red", "place_m": [0.1, 0.3], "turn_degrees": 20},
                 {"shape": "cup", "color": "blue", "on": "red box"},
                 {"shape": "lidded box", "color": "green", "place_m": [-0.1, 0.3], "opening": 1}]}

The name of a body is its color and shape, such as "red box"; a drawer is a "cabinet", a lidded box
a "chest". Missing keys have their defaults; unknown keys are refused.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, get_args, no_type_check

import numpy as np

from egosim_jax.geometry import rotation_z
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import check_version, quote, quote_path, read_json
from egosim_jax.types import InputError, check_seed
from egosim_jax.worlds.tabletop.bodies import (
    COLORS,
    LOOSE,
    TABLE_SIZE_M,
    Body,
    Pattern,
    Shape,
    build_loose,
    make_drawer,
    make_lidded_box,
)
from egosim_jax.worlds.tabletop.scene import Scene, make_room
from egosim_jax.worlds.tabletop.support import (
    FLOOR_M,
    footprints,
    inside_chest,
    separation,
    support_below,
)

FORMAT, VERSION = "egosim_jax.scene", 1
SIZE_M = (0.02, 0.20)
"""Minimum and maximum width or height of a loose body in meters."""
MAX_OBJECTS = 40
"""Maximum number of bodies of a scene."""
NAMES = {"drawer": "cabinet", "lidded box": "chest"}
"""Nouns for furniture in names."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Object:
    """Description of one body of a scene."""

    shape: Shape
    """Class of its shape."""
    color: str
    """Name of its color; a black one is never the target of a script."""
    place_m: tuple[float, float] | None = None
    """Position x and y of its center in meters; None: the center of the body named by `on`."""
    on: str | None = None
    """Name of a supporting body earlier in the list; None: the table."""
    turn_degrees: float = 0.0
    """Rotation about the vertical in degrees; 0 for furniture."""
    width_m: float | None = None
    """Width and depth of a loose body in meters; None: 0.072, or 0.09 for a ring."""
    height_m: float | None = None
    """Height of a loose body in meters; None: 0.075, 0.03 for a ring. A ball has its width."""
    pattern: Pattern = "plain"
    """Pattern of a loose body."""
    opening: float = 0.0
    """Opening of furniture, from closed (0) to open (1)."""

    @property
    def name(self) -> str:
        """Name of the body in the scene."""
        return f"{self.color} {NAMES.get(self.shape, self.shape)}"

    @property
    def loose(self) -> bool:
        """True for a body that can be picked up."""
        return self.shape in LOOSE

    def __post_init__(self) -> None:
        """Raise `InputError` for an invalid value."""
        for field, value, known in (
            ("shape", self.shape, get_args(Shape)),
            ("color", self.color, tuple(COLORS)),
            ("pattern", self.pattern, get_args(Pattern)),
        ):
            if not isinstance(value, str) or value not in known:
                raise InputError(
                    f"An object has the {field} {quote(value)}: it must be one of "
                    f"{', '.join(known)}."
                )
        if (self.place_m is None) == (self.on is None):
            raise InputError(
                f"The {self.name} has {'both' if self.on else 'neither'} place_m and on: give "
                "place_m for the table, or on for another body."
            )
        for field, low, high in (
            ("turn_degrees", -360.0, 360.0),
            ("width_m", *SIZE_M),
            ("height_m", *SIZE_M),
            ("opening", 0.0, 1.0),
        ):
            value = getattr(self, field)
            if value is not None and not (_is_number(value) and low <= value <= high):
                raise InputError(
                    f"{field} of the {self.name} is {quote(value)}: it must be a number from "
                    f"{low:g} to {high:g}."
                )
        if self.loose and self.opening:
            raise InputError(f"The {self.name} cannot be opened: remove opening.")
        if not self.loose and (self.turn_degrees or self.width_m or self.height_m or self.on):
            raise InputError(
                f"The {self.name} has a fixed size and direction, and is on the table: remove "
                "turn_degrees, width_m, height_m and on."
            )
        if self.place_m is not None:
            self._check_place()

    def _check_place(self) -> None:
        x, y, _ = TABLE_SIZE_M
        place = self.place_m
        fits = isinstance(place, (tuple, list)) and len(place) == 2 and all(map(_is_number, place))
        if not fits or not (abs(place[0]) <= x / 2 and 0 <= place[1] <= y):  # type: ignore[index]
            shown = list(place) if fits else quote(place)  # type: ignore[arg-type]
            raise InputError(
                f"place_m of the {self.name} is {shown}: it must be x from {-x / 2:g} to "
                f"{x / 2:g} and y from 0 to {y:g}, on the table."
            )

    def build(self) -> Body:
        """Return the body at the origin."""
        if self.shape == "drawer":
            return make_drawer(self.color)
        if self.shape == "lidded box":
            return make_lidded_box(self.color)
        ring = self.shape == "ring"
        width = float(self.width_m or (0.09 if ring else 0.072))
        height = (
            width if self.shape == "ball" else float(self.height_m or (0.03 if ring else 0.075))
        )
        if ring and height >= width / 2:
            raise InputError(
                f"The {self.name} is {width:g} m wide and {height:g} m high: a ring must be lower "
                "than half its width. Lower height_m."
            )
        return build_loose(self.shape, self.color, (width, width, height), self.pattern)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def make_scene(objects: Sequence[Object], *, room: int = 0) -> Scene:
    """Build a scene of bodies; `room` seeds the colors of table and walls.

    Raises `InputError` if two bodies have equal names or overlap, or if `on` does not name an
    earlier body that can support others.
    """
    check_seed(room, name="room")
    if not 0 < len(objects) <= MAX_OBJECTS:
        raise InputError(f"A scene of {len(objects)} objects: give 1 to {MAX_OBJECTS}.")
    scene = Scene(bodies=(), room=make_room(np.random.default_rng(room)), openings={})
    for item in objects:
        if item.name in scene.openings or any(body.name == item.name for body in scene.bodies):
            raise InputError(
                f"A scene has two objects named {item.name}: names must differ. Change a color."
            )
        body = item.build()
        pose = np.eye(4)
        pose[:3, :3] = rotation_z(np.radians(item.turn_degrees))
        pose[:2, 3] = item.place_m if item.on is None else _below(scene, item)
        body = dataclasses.replace(body, world_from_body=pose)
        openings = {} if item.loose else {body.name: float(item.opening)}
        scene = dataclasses.replace(
            scene, bodies=(*scene.bodies, body), openings={**scene.openings, **openings}
        )
        if item.on is not None:
            scene = _put_on(scene, item)
    _check_apart(scene)
    return scene


def _below(scene: Scene, item: Object) -> np.ndarray:
    names = [body.name for body in scene.bodies]
    if item.on not in names:
        raise InputError(
            f"The {item.name} is on {quote(item.on)}, which is not before it: on must be one of "
            f"{', '.join(names) or 'the objects before'}."
        )
    return scene.body(item.on).world_from_body[:2, 3]


def _put_on(scene: Scene, item: Object) -> Scene:
    pose = scene.body(item.name).world_from_body.copy()
    pose[2, 3] = -FLOOR_M  # above all bodies: `support_below` looks down from there
    scene = scene.with_pose(item.name, pose)
    height, below = support_below(scene, scene.body(item.name))
    if below != item.on:
        raise InputError(
            f"The {item.name} does not stand on the {item.on}: a supporting body must be flat "
            f"and carry no other; it would rest on {below or 'the table'}. Change on."
        )
    pose[2, 3] = height
    return scene.with_pose(item.name, pose)


def _check_apart(scene: Scene) -> None:
    for one, other in combinations(scene.bodies, 2):
        if any(inside_chest(scene, *pair) is not None for pair in ((one, other), (other, one))):
            continue
        for a in footprints(scene, one):
            for b in footprints(scene, other):
                way = separation(a, b)
                if way is not None:
                    overlap = 1000 * float(np.linalg.norm(way))
                    raise InputError(
                        f"The {one.name} and the {other.name} overlap by {overlap:.0f} mm: bodies "
                        "must be apart. Change place_m."
                    )


def read_scene(path: Path | str) -> Scene:
    """Read a scene from a JSON file. Raises `InputError` for a damaged or invalid file."""
    path = Path(path)
    written = read_json(path)
    name = quote_path(path)
    if not isinstance(written, dict) or written.get("format") != FORMAT:
        raise InputError(f"{name} does not describe a scene: its format must be {FORMAT}.")
    check_version(written.get("version"), VERSION, source=name)
    unknown = sorted(written.keys() - {"format", "version", "room", "objects"})
    objects, room = written.get("objects"), written.get("room", 0)
    if unknown or not isinstance(objects, list) or type(room) is not int:
        raise InputError(
            f"{name}: a scene has format, version, objects (a list) and room (a whole number); "
            f"unknown: {', '.join(map(quote, unknown)) or 'none'}, objects: {quote(objects)}, "
            f"room: {quote(room)}."
        )
    try:
        return make_scene([_object(item) for item in objects], room=room)
    except InputError as error:
        raise InputError(f"{name}: {error}") from error


def _object(item: Any) -> Object:
    names = [field.name for field in dataclasses.fields(Object)]
    unknown = sorted(item.keys() - set(names)) if isinstance(item, dict) else [item]
    if unknown or not {"shape", "color"} <= item.keys():
        wrong = quote(unknown[0]) if unknown else "no shape or color"
        raise InputError(
            f"An object is {quote(item)} with {wrong}: it must have shape and color, and may have "
            f"{', '.join(names[2:])}."
        )
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in item.items()}
    return Object(**values)


def write_scene(path: Path | str, objects: Sequence[Object], *, room: int = 0) -> None:
    """Write a scene as JSON, without default values. Raises the errors of `make_scene`."""
    make_scene(objects, room=room)  # refuse an invalid scene before writing
    items = [
        {f.name: v for f in dataclasses.fields(Object) if (v := getattr(item, f.name)) != f.default}
        for item in objects
    ]
    written = {"format": FORMAT, "version": VERSION, "room": room, "objects": items}
    with atomic_write(Path(path)) as temporary:
        temporary.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")
