"""What a hand carried, and how: the motion that explains the colors of a clip best.

A thing that was grasped moves as the hand does. Tried are every thing that a finger tip comes near
to, every pair of frames in which it may have been grasped and released, and three ways in which a
thing goes with a hand: without turning, turning only as things turn that stand on a surface, and as
one body with the palm. A trial costs the mean difference between the thing's colors and those of
the clip where it would be seen. The end of the best is then moved and turned a little until thing
and background, drawn together, look most like the clip.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from egosim_jax.geometry import beside, invert, pixels_of, transform, umeyama
from egosim_jax.rendering.reference import splat
from egosim_jax.state.fuse import widened
from egosim_jax.types import Action, Cameras, Clip, Kind, SceneState

PALM: dict[Kind, list[int]] = {"human": [0, 1, 5, 9, 13, 17], "robot": [0, 1, 2]}
"""Joints that move as one body: wrist and knuckles; all of a gripper."""
TIPS: dict[Kind, list[int]] = {"human": [4, 8, 12], "robot": [1, 2]}
"""Joints that grasp: thumb, index and middle finger."""
REACH_M = 0.06
"""A thing may be grasped if a finger tip comes so near to it."""
LEAST_POINTS, SOME_POINTS, LEAST_SEEN = 30, 150, 0.2
"""A thing needs so many points; about so many are compared in a trial, of which so large a share
must be in sight."""
CAP, UNKNOWN = 90.0, 40.0
"""Largest difference of colors that counts, in levels, and what counts where none is predicted."""
BETTER, LEAST_GAIN, NAMED = 0.8, 5.0, 0.9
"""A motion is believed if it costs so much less than rest, as a factor and in levels; what the
prompt names is believed more easily, by the last factor."""
STEPS_M, STEPS_DEGREES = (0.012, 0.006, 0.003), (12.0, 6.0, 3.0)
"""Of the refinement, round after round."""
LAST, AROUND_PX, POINT_PX = 3, 0.03, 2
"""Frames at the end that the refinement looks at, at least; how far around the thing, as a share of
the width; and the size of its points."""
PLANE_M, AROUND_M = 0.006, 0.15
"""Tolerance of the surface that a thing stands on, and how far around it is looked for."""
LIGHT = (0.45, 1.2)
"""Least and greatest light on what is compared, relative to the state's."""
BLUR_PX = 0.7
"""Of the clip before it is compared, since generated frames are softer than points."""


@dataclass(frozen=True, kw_only=True)
class Thing:
    """A thing as the state knows it, and the surface that it stands on."""

    number: int
    points_m: Float[np.ndarray, "n 3"]
    colors: Float32[np.ndarray, "n 3"]
    normal: Float[np.ndarray, " 3"]
    offset_m: float
    """The surface is where normal . x + offset = 0."""

    @classmethod
    def of(cls, number: int, state: SceneState) -> Thing:
        """The thing of that id; without a surface around it, one that faces up."""
        own = state.object_ids == number
        points = state.points_m[own].astype(float)
        normal, offset = _surface_under(points, state.points_m[~own])
        colors = state.colors[own].astype(np.float32)
        return cls(number=number, points_m=points, colors=colors, normal=normal, offset_m=offset)


@dataclass(frozen=True, kw_only=True)
class Carried:
    """A thing that a hand moved between two frames."""

    thing: Thing
    grasped: int
    released: int
    path: Float[np.ndarray, "f 4 4"]
    """Its motion from where it was before, frame by frame."""
    cost: float
    """Mean difference of colors, in levels."""


def carried(
    clip: Clip, action: Action, state: SceneState, hidden: Bool[np.ndarray, "f h w"]
) -> list[Carried]:
    """What each hand carried; a thing that two might have goes to the better explanation.

    `hidden` is what hands cover. A hand that is missing in any frame is not followed.
    """
    shown = _smooth(clip.frames)
    found: dict[int, Carried] = {}
    for hand in range(action.joints_m.shape[1]):
        joints = action.joints_m[:, hand]
        if np.isfinite(joints).all():
            best = _best(joints, action, state, shown, hidden)
            if best is not None:
                best = _refined(best, action, state, shown, hidden)
                before = found.get(best.thing.number)
                if before is None or best.cost < before.cost:
                    found[best.thing.number] = best
    return list(found.values())


def _best(
    joints_m: Float[np.ndarray, "f j 3"],
    action: Action,
    state: SceneState,
    shown: Float32[np.ndarray, "f h w 3"],
    hidden: Bool[np.ndarray, "f h w"],
) -> Carried | None:
    best: Carried | None = None
    for number in _near_tips(joints_m, action.kind, state):
        thing = Thing.of(number, state)
        name = state.names.get(number, "").lower()
        trust = NAMED if name and name in action.prompt.lower() else 1.0
        still = np.repeat(np.eye(4)[None], len(joints_m), axis=0)
        rest = _cost(thing, still, action.cameras, shown, hidden)
        least = min(BETTER * rest, rest - LEAST_GAIN)
        for grasped, released, path in _paths(joints_m[:, PALM[action.kind]], thing.normal):
            cost = trust * _cost(thing, path, action.cameras, shown, hidden)
            if cost < least and (best is None or cost < best.cost):
                best = Carried(
                    thing=thing, grasped=grasped, released=released, path=path, cost=cost
                )
    return best


def _near_tips(joints_m: Float[np.ndarray, "f j 3"], kind: Kind, state: SceneState) -> list[int]:
    """The things that a finger tip comes near to."""
    tips = joints_m[:, TIPS[kind]].reshape(-1, 3)
    near = []
    for number in np.unique(state.object_ids[state.object_ids > 0]).tolist():
        points = state.points_m[state.object_ids == number]
        if len(points) >= LEAST_POINTS:
            some = points[:: max(1, len(points) // SOME_POINTS)]
            gaps = np.linalg.norm(tips[:, None] - some[None], axis=-1)
            if gaps.min() <= REACH_M:
                near.append(number)
    return near


def _surface_under(
    points_m: Float[np.ndarray, "n 3"], others_m: Float32[np.ndarray, "m 3"]
) -> tuple[Float[np.ndarray, " 3"], float]:
    """Normal and offset of the plane that most points around a thing lie on."""
    import open3d as o3d

    near = others_m[np.linalg.norm(others_m - points_m.mean(axis=0), axis=1) < AROUND_M]
    if len(near) < LEAST_POINTS:
        return np.array([0.0, 0.0, 1.0]), float("nan")
    o3d.utility.random.seed(0)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(near))
    plane, _ = cloud.segment_plane(PLANE_M, 3, 500)
    return np.array(plane[:3]), float(plane[3])


def _paths(
    palm_m: Float[np.ndarray, "f j 3"], normal: Float[np.ndarray, " 3"]
) -> Iterator[tuple[int, int, Float[np.ndarray, "f 4 4"]]]:
    """Frame of the grasp, frame of the release, and the motion, in each of the three ways."""
    rigid = np.stack([umeyama(palm_m[0], there) for there in palm_m])
    middle = palm_m.mean(axis=1)
    upright, sliding = rigid.copy(), rigid.copy()
    for frame, motion in enumerate(rigid):
        upright[frame, :3, :3] = _twist(motion[:3, :3], normal)
        sliding[frame, :3, :3] = np.eye(3)
        for other in (upright, sliding):
            other[frame, :3, 3] = middle[frame] - other[frame, :3, :3] @ middle[0]
    frames = range(len(palm_m))
    for grasped, released in product(frames, frames):
        if released - grasped >= 2:
            when = np.clip(frames, grasped, released)
            for motion in (sliding, upright, rigid):
                yield grasped, released, motion[when] @ invert(motion[grasped])


def _twist(
    rotation: Float[np.ndarray, "3 3"], axis: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "3 3"]:
    """The part of a rotation that turns about an axis (swing-twist decomposition)."""
    import cv2

    turn = cv2.Rodrigues(rotation)[0][:, 0]
    half = np.linalg.norm(turn) / 2
    along = np.sinc(half / np.pi) * (turn @ axis) / 2
    return cv2.Rodrigues(2 * np.arctan2(along, np.cos(half)) * axis)[0]


def _cost(
    thing: Thing,
    path: Float[np.ndarray, "f 4 4"],
    cameras: Cameras,
    shown: Float32[np.ndarray, "f h w 3"],
    hidden: Bool[np.ndarray, "f h w"],
) -> float:
    """Mean difference between the thing's colors and the clip's where they would be seen.

    Points behind a hand say nothing; infinite if too few are in sight.
    """
    every = max(1, len(thing.points_m) // SOME_POINTS)
    points, colors = thing.points_m[::every], thing.colors[::every]
    there = transform(invert(cameras.world_from_camera) @ path, points)
    row, column, inside = pixels_of(cameras, there)
    frame = np.broadcast_to(np.arange(len(path))[:, None], column.shape)
    place = frame[inside], row[inside], column[inside]
    seen = ~hidden[place]
    if seen.sum() < LEAST_SEEN * column.size:
        return float("inf")
    expected = np.broadcast_to(colors, (*column.shape, 3))[inside][seen]
    return float(np.minimum(_gaps(shown[place][seen], expected), CAP).mean())


def _refined(
    best: Carried,
    action: Action,
    state: SceneState,
    shown: Float32[np.ndarray, "f h w 3"],
    hidden: Bool[np.ndarray, "f h w"],
) -> Carried:
    """The same with its end moved, and turned on the surface, as far as that explains more."""
    frames = np.arange(len(best.path))[min(best.released, len(best.path) - LAST) :]
    scene = _Neighborhood.of(best, state, frames, shown, hidden, action.cameras)
    if not scene.counted.any():
        return best  # hands cover all of it to the end
    share = np.clip(
        (np.arange(len(best.path)) - best.grasped) / (best.released - best.grasped), 0, 1
    )
    change, least = np.zeros(4), scene.cost(best.path[frames])
    for meters, degrees in zip(STEPS_M, STEPS_DEGREES, strict=True):
        steps = np.diag([meters, meters, meters, np.radians(degrees)])
        improved = True
        while improved:
            improved = False
            for step in (*steps, *-steps):
                cost = scene.cost(_nudged(best, change + step, share)[frames])
                if cost < least:
                    change, least, improved = change + step, cost, True
    return replace(best, path=_nudged(best, change, share))


def _nudged(
    best: Carried, change: Float[np.ndarray, " 4"], share: Float[np.ndarray, " f"]
) -> Float[np.ndarray, "f 4 4"]:
    """The path with a share of the change at each frame: moved, and turned about its middle."""
    import cv2

    middle = transform(best.path, best.thing.points_m.mean(axis=0)[None])[:, 0]
    nudges = np.repeat(np.eye(4)[None], len(best.path), axis=0)
    for nudge, part, center in zip(nudges, share, middle, strict=True):
        nudge[:3, :3] = cv2.Rodrigues(part * change[3] * best.thing.normal)[0]
        nudge[:3, 3] = center + part * change[:3] - nudge[:3, :3] @ center
    return nudges @ best.path


@dataclass(frozen=True, kw_only=True)
class _Neighborhood:
    """Where a thing ends, in some frames: what the clip shows there, and what is behind it."""

    thing: Thing
    cameras: Cameras
    shown: Float32[np.ndarray, "f h w 3"]
    background: Float32[np.ndarray, "f h w 3"]
    """NaN where the state knows of none."""
    background_m: Float32[np.ndarray, "f h w"]
    counted: Bool[np.ndarray, "f h w"]

    @classmethod
    def of(
        cls,
        best: Carried,
        state: SceneState,
        frames: Int[np.ndarray, " g"],
        shown: Float32[np.ndarray, "f h w 3"],
        hidden: Bool[np.ndarray, "f h w"],
        cameras: Cameras,
    ) -> _Neighborhood:
        """What is needed to judge ends near that of the path."""
        cameras = replace(cameras, world_from_camera=cameras.world_from_camera[frames])
        others = state.object_ids != best.thing.number
        depth, index = splat(state.points_m[others], cameras, point_px=POINT_PX)
        colors = state.colors[others].astype(np.float32)
        background = np.append(colors, np.full((1, 3), np.nan, np.float32), axis=0)[index]
        there = beside(cameras, best.path[frames])
        _, drawn = splat(best.thing.points_m, there, point_px=POINT_PX)
        return cls(
            thing=best.thing,
            cameras=cameras,
            shown=shown[frames],
            background=background,
            background_m=depth,
            counted=widened(drawn >= 0, AROUND_PX) & ~hidden[frames],
        )

    def cost(self, path: Float[np.ndarray, "f 4 4"]) -> float:
        """Mean difference between the picture with the thing there and the clip's."""
        there = beside(self.cameras, path)
        depth, index = splat(self.thing.points_m, there, point_px=POINT_PX)
        nearer = (index >= 0) & (depth < self.background_m)
        drawn = np.where(nearer[..., None], self.thing.colors[index], self.background)
        gaps = _gaps(self.shown[self.counted], drawn[self.counted])
        return float(np.minimum(np.where(np.isnan(gaps), UNKNOWN, gaps), CAP).mean())


def _gaps(
    shown: Float32[np.ndarray, "n 3"], expected: Float32[np.ndarray, "n 3"]
) -> Float32[np.ndarray, " n"]:
    """Differences of colors in the light that makes them least: a carried thing lies in shadow."""
    strength = np.maximum((expected**2).sum(axis=1), 1)
    light = np.clip((shown * expected).sum(axis=1) / strength, *LIGHT)
    return np.sqrt(np.square(shown - light[:, None] * expected).mean(axis=1))


def _smooth(frames: UInt8[np.ndarray, "f h w 3"]) -> Float32[np.ndarray, "f h w 3"]:
    import cv2

    return np.stack([cv2.GaussianBlur(f.astype(np.float32), (0, 0), BLUR_PX) for f in frames])
