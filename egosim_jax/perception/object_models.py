"""Models of the objects of a state, which their motions are found with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from egosim_jax.geometry import invert, transform, upward
from egosim_jax.perception.grasps import is_along_edge
from egosim_jax.perception.pose_refinement import ObjectModel
from egosim_jax.state.new_objects import with_objects
from egosim_jax.state.planes import support_planes
from egosim_jax.types import SceneState


@dataclass(frozen=True, kw_only=True)
class Support:
    """Fit of the plane that supports an object."""

    tolerance_m: float = 0.006
    """Inlier distance of the plane, in meters."""
    radius_m: float = 0.15
    """Radius around the object's center in which points determine the plane, in meters."""
    min_points: int = 30
    """Minimum number of points of an object, and of a surface."""

    def plane(
        self,
        points_m: Float[np.ndarray, "n 3"],
        others_m: Float32[np.ndarray, "m 3"],
        up: Float[np.ndarray, " 3"],
        eye_m: Float[np.ndarray, " 3"] | None,
    ) -> Float[np.ndarray, " 4"]:
        """Fit the horizontal plane (a, b, c, d) with the most inliers around an object (RANSAC).

        A box next to the object may have more points than the ground, so vertical planes are
        excluded. Without a horizontal one, return a plane of unknown height. `up` and `eye_m` as in
        `upward`.
        """
        distances = np.linalg.norm(others_m - points_m.mean(axis=0), axis=1)
        found = support_planes(
            others_m[distances < self.radius_m],
            up,
            eye_m=eye_m,
            tolerance_m=self.tolerance_m,
            min_points=self.min_points,
            max_planes=1,
        )
        return found[0].plane if found else np.array([*up, np.nan])


class ObjectModels:
    """Models of the objects of a state, each made when it is first needed."""

    def __init__(self, state: SceneState, first_camera: Float[np.ndarray, "4 4"], support: Support):
        """`first_camera` is the clip's first pose (world from camera)."""
        self.state, self.support = state, support
        self._up, self._eye_m = upward(state, first_camera)
        self._made: dict[int, ObjectModel] = {}

    def of(self, number: int) -> ObjectModel:
        """Return the model of an object. Its plane is horizontal if no surface is around it.

        An object in a hand last rested where it was first observed, as far as the state knows.
        """
        if number not in self._made:
            state = self.state
            own = state.object_ids == number
            points, others = state.points_m[own].astype(float), state.points_m[~own]
            self._made[number] = ObjectModel(
                number=number,
                points_m=points,
                colors=state.colors[own].astype(np.float32),
                plane=self.support.plane(points, others, self._up, self._eye_m),
                since_rest=_since_rest(number, points, state),
            )
        return self._made[number]

    def near(
        self, tips_m: Float[np.ndarray, "f t 3"], *, reach_m: float, compared: int
    ) -> list[int]:
        """Return the ids of the objects within reach of a fingertip, by some of their points."""
        tips, state, near = tips_m.reshape(-1, 3), self.state, []
        for number in np.unique(state.object_ids[state.object_ids > 0]).tolist():
            points = state.points_m[state.object_ids == number]
            if len(points) >= self.support.min_points:
                some = points[:: max(1, len(points) // compared)]
                gaps = np.linalg.norm(tips[:, None] - some[None], axis=-1)
                if gaps.min() <= reach_m:
                    near.append(number)
        return near

    def add(self, new: Mapping[int, Float32[np.ndarray, "n 3"]]) -> None:
        """Give points without an id to new objects."""
        self.state = with_objects(self.state, new)


def _since_rest(
    number: int, points_m: Float[np.ndarray, "n 3"], state: SceneState
) -> Float[np.ndarray, "4 4"] | None:
    """Return the motion of an object in a hand since it rested; None for others and on a hinge."""
    pose = state.world_from_object.get(number)
    if pose is None or number not in state.held.values():
        return None
    rested = transform(invert(pose), points_m)
    return None if is_along_edge(rested, pose[None]) else pose
