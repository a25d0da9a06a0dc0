"""Objects of a state in level coordinates: z is up, and the main support is at z = 0."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32

from egosim_jax.dynamics.grips import is_along_edge
from egosim_jax.dynamics.solids import NEAR_SUPPORT_M, Solid, make_solid
from egosim_jax.dynamics.support import MIN_UNDER, TOUCH_M, UNDER_M, Body, is_inside
from egosim_jax.geometry import invert, level_axes, transform
from egosim_jax.state.new_objects import is_among
from egosim_jax.state.planes import main_support, vertical
from egosim_jax.types import SceneState
from egosim_jax.types.arrays import Plane, Points, Pose, Poses

MIN_POINTS = 30
"""Minimum number of points of an object that moves."""
BASE_SHARE = 0.02
"""Fraction of an object's points that may be below its base: points mixed at silhouettes."""


@dataclass(frozen=True, kw_only=True)
class LevelScene:
    """Objects of a state, in level coordinates."""

    level_from_world: Float[np.ndarray, "4 4"]
    """Rigid transform to the coordinates in which z is up."""
    eye_m: Float[np.ndarray, " 3"]
    """Place of the camera that sees the objects."""
    solids: Mapping[int, Solid]
    """Solids of the objects within reach, by id."""
    background_m: Float32[np.ndarray, "n 3"]
    """Points in the world that are of no solid; objects may stand on them."""
    ground_m: Float[np.ndarray, "n 3"]
    """The same points in level coordinates."""

    def plane(self, number: int) -> Plane:
        """Return the plane in the world under an object; its unit normal points up."""
        solid = self.solids.get(number)
        height = solid.base_m - solid.lifted_m if solid else 0.0
        return np.array([0, 0, 1, -height]) @ self.level_from_world

    def with_object(self, number: int, points_m: Points) -> LevelScene:
        """Return the scene with one more object, of points of the background in the world."""
        rest = ~is_among(self.background_m, points_m.astype(np.float32))
        scene = replace(self, background_m=self.background_m[rest], ground_m=self.ground_m[rest])
        return scene.with_solid(number, transform(self.level_from_world, points_m))

    def with_solid(self, number: int, points_m: Points) -> LevelScene:
        """Return the scene with one more object, of points in level coordinates."""
        base = _base(points_m, self.solids, self.ground_m)
        solid = make_solid(number, points_m, base_m=base, eye_m=self.eye_m)
        return replace(self, solids={**self.solids, **({number: solid} if solid else {})})


def level_scene(
    state: SceneState,
    world_from_camera: Pose,
    reached_m: Float[np.ndarray, "p 3"],
    *,
    reach_m: float,
) -> LevelScene:
    """Return the objects of a state within reach of some points in the world."""
    level = _level(state, world_from_camera) if len(reached_m) else np.eye(4)
    reached, eye = (transform(level, p) for p in (reached_m, world_from_camera[None, :3, 3]))
    low = reached.min(axis=0, initial=np.inf) - reach_m
    high = reached.max(axis=0, initial=-np.inf) + reach_m
    ground = transform(level, state.points_m.astype(float))
    near_ground = (state.object_ids == 0) & ((ground >= low) & (ground <= high)).all(axis=1)
    scene = LevelScene(
        level_from_world=level,
        eye_m=eye[0],
        solids={},
        background_m=state.points_m[near_ground],
        ground_m=ground[near_ground],
    )
    near, moved = {}, {}
    for number in np.unique(state.object_ids[state.object_ids > 0]).tolist():
        points = ground[state.object_ids == number]
        if len(points) < MIN_POINTS or (points.max(0) < low).any() or (points.min(0) > high).any():
            continue
        pose = state.world_from_object.get(number)
        if pose is not None and number in state.held.values():
            pose = level @ pose @ invert(level)
            rested = transform(invert(pose), points)
            if not is_along_edge(rested, pose):  # on a hinge, it stays on it
                points, moved[number] = rested, pose
        near[number] = points
    for number in sorted(near, key=lambda number: _low(near[number])):
        scene = scene.with_solid(number, near[number])
    solids = {
        number: solid.lifted(moved[number]) if number in moved else solid
        for number, solid in scene.solids.items()
    }
    return replace(scene, solids=solids)


def _low(points_m: Points) -> float:
    return float(np.quantile(points_m[:, 2], BASE_SHARE))


def _base(
    points_m: Points, below: Mapping[int, Solid], background_m: Float[np.ndarray, "m 3"]
) -> float:
    """Return the height of an object's support: the table's, or the top of a lower object's.

    Points of no object around its lowest points are of a lower object, too.

    A camera above a round object does not see its lowest part. An object that is higher above the
    table than its visible part is tall hangs, as a drawer in its case does.
    """
    low_m = _low(points_m)
    middle = (points_m.min(axis=0) + points_m.max(axis=0))[:2] / 2
    tops = [
        body.high_m
        for body in (Body(solid, np.eye(4)) for solid in below.values())
        if body.high_m <= low_m + TOUCH_M and is_inside(body.outline_m, middle)
    ]
    if tops:
        return max(tops)
    box = points_m.min(axis=0) - UNDER_M, points_m.max(axis=0) + UNDER_M
    near = ((background_m > box[0]) & (background_m < box[1]))[:, :2].all(axis=1)
    level = background_m[near & (np.abs(background_m[:, 2] - low_m) < TOUCH_M), 2]
    if len(level) >= MIN_UNDER:
        return float(np.median(level))
    return 0.0 if low_m < max(NEAR_SUPPORT_M, np.ptp(points_m[:, 2])) else low_m


def _level(state: SceneState, world_from_camera: Pose) -> Pose:
    """Return the transform to level coordinates, by the plane that most background points are on.

    Without a plane, z is up and 0 is the height of the lowest point.
    """
    plane = main_support(state, world_from_camera)
    if plane is None:
        up = vertical(state, world_from_camera)
        plane = np.array([*up, -float(np.quantile(state.points_m @ up, 0.01))])
    level = np.eye(4)
    level[:3, :3], level[2, 3] = level_axes(plane[:3]).T, plane[3]
    return level


def to_world(scene: LevelScene, motion: Poses) -> Poses:
    """Return a motion in level coordinates as a motion in the world."""
    return invert(scene.level_from_world) @ motion @ scene.level_from_world
