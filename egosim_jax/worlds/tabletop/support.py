"""Bodies at rest: supports, stable orientations, and bodies that push each other aside.

Everything is quasi-static. A body in no hand rests on the highest surface under its center, in the
nearest stable orientation; a fall takes no time. Two bodies overlap if both their footprints and
their height ranges do. The body of lower rank then moves horizontally by the minimum separating
distance (separating axis test). Furniture never moves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from jaxtyping import Float

from egosim_jax.geometry import invert, smallest_rotation, transform
from egosim_jax.worlds.tabletop.bodies import LID_M, TABLE_SIZE_M, Body
from egosim_jax.worlds.tabletop.scene import LID_DEGREES, Scene
from egosim_jax.worlds.tabletop.solids import Solid, solids_of

FLOOR_M = -0.74
"""Height of the floor in meters."""
TOUCH_M = 0.004
"""Height ranges that overlap by less than this only touch, in meters."""
OVERLAP_M = 0.001
"""Footprints that overlap by less than this are apart, in meters."""
LID_OPEN = 0.6
"""Minimum opening of a chest that receives bodies."""
WALL_M, CHEST_FLOOR_M = 0.007, 0.007
"""Thickness of a chest's walls and of its floor, in meters."""
UPRIGHT = 0.999
"""Minimum cosine of the tilt of an upright body."""
MAX_ROUNDS = 8
"""Maximum number of rounds in which bodies push each other aside."""
RANKS = {"furniture": 3, "held": 2, "pushed": 1}
"""Ranks of bodies when they meet: the lower one moves; a body at rest has 0."""


@dataclass(frozen=True, kw_only=True)
class Footprint:
    """Horizontal outline of a solid, a polygon or a disc, and its heights."""

    corners_m: Float[np.ndarray, "k 2"]
    """Corners of the polygon, or the center of the disc, in meters."""
    radius_m: float
    """Radius of the disc; 0 for a polygon."""
    low_m: float
    """Height of its underside in meters."""
    high_m: float
    """Height of its upper side in meters."""


def bottom_and_top(body: Body) -> tuple[float, float]:
    """Return the minimum and maximum height of a loose body in meters."""
    if body.world_from_body[2, 2] > 1 - 1e-9:
        low = float(body.world_from_body[2, 3])
        return low, low + body.size_m[2]
    heights = transform(body.world_from_body, body.parts[0].vertices_m)[:, 2]
    return float(heights.min()), float(heights.max())


def footprints(scene: Scene, body: Body) -> list[Footprint]:
    """Return the footprints of a body; a cabinet has one of its case and one of its open drawer."""
    if not body.articulated:
        return [_footprint(body)]
    outlines = []
    for solid in solids_of(body.shape, body.size_m):
        moving = solid.part == 0
        if solid.handle or (
            moving and (body.shape == "lidded box" or not scene.openings[body.name])
        ):
            continue
        pose = scene.first_part_pose(body.name) if moving else body.world_from_body
        if moving:  # the solid is only the front of the drawer: extend it to the tray
            y = body.size_m[1]
            solid = Solid(form="box", size_m=(solid.size_m[0], y, solid.size_m[2]),
                          origin_m=(0.0, -0.006, solid.origin_m[2]))  # fmt: skip
        outlines.append(_box_footprint(solid, pose))
    return outlines


def _footprint(body: Body) -> Footprint:
    low, high = bottom_and_top(body)
    pose, radius = body.world_from_body, body.size_m[0] / 2
    if body.shape != "box" and abs(pose[2, 2]) > UPRIGHT:
        corners = pose[None, :2, 3]
    elif body.shape == "ball":
        corners = transform(pose, np.array([[0, 0, radius]]))[:, :2]
    else:
        from scipy.spatial import ConvexHull

        flat, radius = transform(pose, body.parts[0].vertices_m)[:, :2], 0.0
        corners = flat[ConvexHull(flat).vertices]
    return Footprint(corners_m=corners, radius_m=radius, low_m=low, high_m=high)


def _box_footprint(solid: Solid, pose: np.ndarray) -> Footprint:
    x, y, z = solid.size_m
    corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y]]) / 2
    local = np.concatenate([corners, np.zeros((4, 1))], axis=1) + np.asarray(solid.origin_m)
    world = transform(pose, local)
    low = float(world[0, 2])
    return Footprint(corners_m=world[:, :2], radius_m=0.0, low_m=low, high_m=low + z)


def separation(a: Footprint, b: Footprint) -> Float[np.ndarray, " 2"] | None:
    """Return the shortest horizontal motion in meters of `a` out of `b`; None if they are apart."""
    if min(a.high_m, b.high_m) - max(a.low_m, b.low_m) < TOUCH_M:
        return None
    best, way = np.inf, np.zeros(2)
    for axis in _axes(a, b):
        first, second = a.corners_m @ axis, b.corners_m @ axis
        reach = a.radius_m + b.radius_m
        forward = second.max() - first.min() + reach
        back = first.max() - second.min() + reach
        if min(forward, back) < OVERLAP_M:
            return None
        if min(forward, back) < best:
            best = min(forward, back)
            way = axis * forward if forward <= back else -axis * back
    return way


def _axes(a: Footprint, b: Footprint) -> list[np.ndarray]:
    """Return the candidate separating axes: edge normals, and directions from discs to corners."""
    axes = []
    for one, other in ((a, b), (b, a)):
        if not one.radius_m:
            edges = np.roll(one.corners_m, -1, axis=0) - one.corners_m
            normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
            axes += list(normals / np.linalg.norm(normals, axis=1, keepdims=True))
        else:
            gaps = other.corners_m - one.corners_m
            nearest = gaps[np.linalg.norm(gaps, axis=1).argmin()]
            length = np.linalg.norm(nearest)
            axes.append(nearest / length if length > 1e-9 else np.array([1.0, 0.0]))
    return axes


def inside_chest(scene: Scene, body: Body, chest: Body) -> Float[np.ndarray, " 2"] | None:
    """Return the motion in meters that puts a body between the walls of an open chest below it.

    Return None if the chest is closed, the body's center is not above it, or the body does not fit.
    """
    if chest.shape != "lidded box" or scene.openings[chest.name] < LID_OPEN:
        return None
    outline = footprints(scene, body)[0]
    local = outline.corners_m - chest.world_from_body[:2, 3]  # furniture is never rotated
    low, high = local.min(axis=0) - outline.radius_m, local.max(axis=0) + outline.radius_m
    half = np.array(chest.size_m[:2]) / 2 - WALL_M
    if (np.abs((low + high) / 2) > half).any() or (high - low > 2 * half).any():
        return None
    return np.maximum(0, -half - low) - np.maximum(0, high - half)


def support_below(scene: Scene, body: Body) -> tuple[float, str | None]:
    """Return the height in meters and name of a body's support; None: table or floor."""
    low, _ = bottom_and_top(body)
    center = footprints(scene, body)[0].corners_m.mean(axis=0)
    x, y, _ = TABLE_SIZE_M
    # A body already below the table top fell off its edge, and belongs to the floor.
    on_table = abs(center[0]) <= x / 2 and 0 <= center[1] <= y
    best: tuple[float, str | None] = (0.0 if on_table and low > FLOOR_M / 2 else FLOOR_M, None)
    for other in scene.bodies:
        if other.name == body.name:
            continue
        if inside_chest(scene, body, other) is not None:
            tops = [other.world_from_body[2, 3] + CHEST_FLOOR_M]
        else:
            tops = [f.high_m for f in _tops(scene, other) if _contains(f, center)]
        for top in tops:
            if best[0] < top <= low + TOUCH_M * 3:
                best = top, other.name
    return best


def _tops(scene: Scene, body: Body) -> list[Footprint]:
    """Return the flat upper sides of a body; a ball, a cone or a tilted cylinder has none."""
    if body.articulated:
        outlines = footprints(scene, body)
        if body.shape == "lidded box" and scene.openings[body.name] < LID_OPEN:
            return [replace(outlines[0], high_m=body.world_from_body[2, 3] + body.size_m[2])]
        return outlines
    upright = abs(body.world_from_body[2, 2]) > UPRIGHT
    flat = body.shape == "box" or (upright and body.shape in ("cylinder", "cup", "ring"))
    return footprints(scene, body) if flat else []


def _contains(outline: Footprint, point_m: Float[np.ndarray, " 2"]) -> bool:
    if outline.radius_m:
        return bool(np.linalg.norm(point_m - outline.corners_m[0]) <= outline.radius_m)
    edges = np.roll(outline.corners_m, -1, axis=0) - outline.corners_m
    gaps = point_m - outline.corners_m
    turns = edges[:, 0] * gaps[:, 1] - edges[:, 1] * gaps[:, 0]
    return bool((turns >= 0).all() or (turns <= 0).all())


def supporters(scene: Scene) -> dict[str, str]:
    """Return the supporting body of each loose body by name, without bodies on the table."""
    supports = {}
    for body in scene.bodies:
        if not body.articulated:
            height, name = support_below(scene, body)
            if name is not None and abs(bottom_and_top(body)[0] - height) < TOUCH_M:
                supports[body.name] = name
    return supports


def riders(scene: Scene, name: str) -> list[str]:
    """Return the names of the bodies that rest on a body, directly or on others."""
    names, resting_on = [name], supporters(scene)
    for below in names:
        names += [top for top, under in resting_on.items() if under == below and top not in names]
    return names[1:]


def move(scene: Scene, name: str, world_from_body: Float[np.ndarray, "4 4"]) -> Scene:
    """Move a body to a pose, together with all bodies that rest on it."""
    motion = world_from_body @ invert(scene.body(name).world_from_body)
    for rider in riders(scene, name):
        scene = scene.with_pose(rider, motion @ scene.body(rider).world_from_body)
    return scene.with_pose(name, world_from_body)


def shift(scene: Scene, name: str, way_m: Float[np.ndarray, " 2"]) -> Scene:
    """Move a body horizontally, together with all bodies that rest on it."""
    pose = scene.body(name).world_from_body.copy()
    pose[:2, 3] += way_m
    return move(scene, name, pose)


def push_aside(scene: Scene, ranks: Mapping[str, int]) -> tuple[Scene, set[str]]:
    """Separate overlapping bodies; return the scene and the names of the moved bodies.

    `ranks` has the bodies that just moved. Bodies that a few rounds cannot separate, such as a body
    between a hand and furniture, keep overlapping.
    """
    ranks = {
        body.name: RANKS["furniture"] if body.articulated else ranks.get(body.name, 0)
        for body in scene.bodies
    }
    moved: set[str] = set()
    for _ in range(MAX_ROUNDS):
        again = False
        for first, second in combinations([body.name for body in scene.bodies], 2):
            low, high = sorted((second, first), key=lambda name: ranks[name])
            if ranks[high] == 0 or ranks[low] == RANKS["furniture"]:
                continue
            way = _apart(scene, low, high)
            if way is None:
                continue
            moved |= {low, *riders(scene, low)}
            scene = shift(scene, low, way)
            ranks[low] = max(ranks[low], RANKS["pushed"])  # it now pushes bodies at rest
            again = True
        if not again:
            break
    return scene, moved


def _apart(scene: Scene, low: str, high: str) -> Float[np.ndarray, " 2"] | None:
    """Return the motion in meters that separates the body `low` from `high`; None if apart."""
    body, other = scene.body(low), scene.body(high)
    gap = np.linalg.norm((body.world_from_body - other.world_from_body)[:2, 3])
    # Bounding circles skip the exact test of bodies far apart.
    if gap > sum(np.hypot(*b.size_m[:2]) / 2 + 0.1 * b.articulated for b in (body, other)) + 0.1:
        return None
    inner = inside_chest(scene, body, other) if other.articulated else None
    if inner is not None:
        deep = bottom_and_top(body)[0] < other.world_from_body[2, 3] + other.size_m[2] - LID_M
        return inner if deep and np.abs(inner).max() > OVERLAP_M else None
    outline = footprints(scene, body)[0]
    ways = [separation(outline, f) for f in footprints(scene, other)]
    overlaps = [way for way in ways if way is not None]
    return max(overlaps, key=lambda way: float(np.linalg.norm(way))) if overlaps else None


def settle(scene: Scene, name: str) -> Scene:
    """Return the scene after a body in no hand came to rest."""
    body = scene.body(name)
    pose = body.world_from_body.copy()
    # Rotate about the center, not about the origin on the underside.
    middle = transform(pose, np.array([[0, 0, body.size_m[2] / 2]]))[0]
    pose[:3, :3] = stable_rotation(body)
    pose[:3, 3] = middle - pose[:3, :3] @ [0, 0, body.size_m[2] / 2]
    scene = scene.with_pose(name, pose)
    for _ in range(MAX_ROUNDS):
        body = scene.body(name)
        for chest in scene.bodies:
            inner = inside_chest(scene, body, chest)
            if inner is not None:
                scene = shift(scene, name, inner)
        body = scene.body(name)
        height, _ = support_below(scene, body)
        pose = body.world_from_body.copy()
        pose[2, 3] += height - bottom_and_top(body)[0]
        scene = scene.with_pose(name, pose)
        ways = [_apart(scene, name, other.name) for other in scene.bodies if other.name != name]
        overlaps = [way for way in ways if way is not None]
        if not overlaps:
            break
        scene = shift(scene, name, overlaps[0])  # it slides off bodies that do not support it
    return scene


def stable_rotation(body: Body) -> Float[np.ndarray, "3 3"]:
    """Return the stable orientation of a loose body that is nearest to its present one."""
    rotation = body.world_from_body[:3, :3]
    down = -rotation[2]  # in the frame of the body
    flat = down * [1, 1, 0]
    side = flat / max(float(np.linalg.norm(flat)), 1e-9)
    x, _, z = body.size_m
    candidates = [np.array([0, 0, -1.0]), np.array([0, 0, 1.0])]
    if body.shape == "ball":
        return rotation
    if body.shape == "box":
        candidates += [sign * axis for axis in np.eye(3)[:2] for sign in (-1.0, 1.0)]
    elif body.shape == "cone":
        slope = np.array([z, x / 2]) / np.hypot(z, x / 2)
        candidates = [candidates[0], side * slope[0] + np.array([0, 0, slope[1]])]
    elif body.shape in ("cylinder", "cup"):
        candidates.append(side)
    best = max(candidates, key=lambda way: float(way @ down))
    return smallest_rotation((rotation @ best)[None], np.array([[0, 0, -1.0]]))[0] @ rotation


def min_opening(scene: Scene, chest: Body) -> float:
    """Return the minimum opening of a lid above the bodies in its chest."""
    x, y, z = chest.size_m
    opened, minimum = scene.with_opening(chest.name, 1.0), 0.0
    for body in scene.bodies:
        if body.articulated or inside_chest(opened, body, chest) is None:
            continue
        points = transform(
            invert(chest.world_from_body) @ body.world_from_body, body.parts[0].vertices_m
        )
        points = points[(np.abs(points[:, 0]) <= x / 2) & (np.abs(points[:, 1]) < y / 2)]
        angles = np.arctan2(points[:, 2] - (z - LID_M), y / 2 - points[:, 1])
        if len(angles):
            minimum = max(minimum, float(np.degrees(angles.max())) / LID_DEGREES)
    return minimum
