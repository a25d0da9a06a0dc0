"""New objects of a state: points of the background that turned out to be an object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float32

from egosim_jax.types import SceneState


def next_object_id(state: SceneState) -> int:
    """Return the lowest id above all ids of a state."""
    used = {0, int(state.object_ids.max()), *state.names, *state.world_from_object}
    return max(used) + 1


def without_ids(state: SceneState) -> SceneState:
    """Return the state with all points in the background, as a camera sees them."""
    return replace(
        state, object_ids=np.zeros_like(state.object_ids), names={}, world_from_object={}, held={}
    )


def with_objects(
    state: SceneState, new_objects: Mapping[int, Float32[np.ndarray, "n 3"]]
) -> SceneState:
    """Return the state with each new object's points labeled by its id.

    The points are found by their exact coordinates, in any order of the state. An id that the state
    has stays as it is: its object may have moved since, and another point may be in its place.
    """
    ids = state.object_ids.copy()
    for number in new_objects.keys() - set(np.unique(ids).tolist()):
        ids[(ids == 0) & is_among(state.points_m, new_objects[number])] = number
    return replace(state, object_ids=ids)


def is_among(
    points_m: Float32[np.ndarray, "n 3"], others_m: Float32[np.ndarray, "m 3"]
) -> Bool[np.ndarray, " n"]:
    """Return which points have exactly the coordinates of one of the others."""
    exact = np.dtype((np.void, points_m.dtype.itemsize * 3))
    points, others = (np.ascontiguousarray(x).view(exact)[:, 0] for x in (points_m, others_m))
    return np.isin(points, others)
