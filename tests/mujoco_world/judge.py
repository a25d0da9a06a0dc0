"""Comparison of the points of a state, after a film is perceived and fused, with their places."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from egosim_jax.geometry import transform
from egosim_jax.perception import Perception
from egosim_jax.state.depth import state_from_depth
from egosim_jax.state.fuse import REPLACE_M, fuse
from egosim_jax.types import SceneState
from tests.mujoco_world.world import Film

Ids = Literal["none", "auto", "true"]
"""Ids of the scene: none, those that `find_objects` finds, or MuJoCo's own."""
NEAR_M, MOVED_M = 0.01, 0.02
"""A point is in place within the first distance; it has moved by more than the second."""
MIN_MOVED, MAX_LEFT, MIN_STILL = 0.90, 0.02, 0.99


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Shares of the points of the first image, by the objects that they truly belong to."""

    moved: float
    """Share of the moved object's points that are in place at the end."""
    left: float
    """Share of the moved object's points that are still where they were."""
    still: float
    """Share of the other objects' points that are in place at the end."""
    dragged: float
    """Points of the scenery that moved, in points of the moved object."""
    error_m: float
    """Median distance of the moved object's points from their places, in meters."""
    notes: tuple[str, ...]
    before: SceneState
    after: SceneState
    """State at the end; new points are magenta."""
    marks: SceneState
    """The same, with colors: green in place, red not, yellow scenery that moved, else gray."""

    @property
    def passed(self) -> bool:
        """Return whether the judge accepts the result."""
        return self.moved >= MIN_MOVED and self.left <= MAX_LEFT and self.still >= MIN_STILL


def state_of(film: Film, ids: Ids) -> SceneState:
    """Return the state of the first image, which has no gripper."""
    cameras, given, names = film.action.cameras, None, None
    if ids == "true":
        given, names = film.ids, film.names
    if ids == "auto":
        from egosim_jax.state.instances import find_objects

        given = find_objects(film.scene, film.depth_m, cameras.intrinsics_px)
        names = {n: f"object {n}" for n in np.unique(given[given > 0]).tolist()}
    return state_from_depth(
        film.scene,
        film.depth_m,
        cameras.intrinsics_px,
        cameras.world_from_camera[0],
        object_ids=given,
        names=names,
    )


def judge(film: Film, perception: Perception, ids: Ids) -> Verdict:
    """Perceive the film as if it were generated, and compare the fused state with MuJoCo."""
    state, known = state_of(film, ids), state_of(film, "true")
    starts, owners = known.points_m, known.object_ids
    places = starts.astype(float)
    for number, path in film.motions.items():
        own = owners == number
        places[own] = transform(path[-1], places[own])
    perceived = perception(film.clip, film.action, state)
    # Fusion carries colors along and looks at no color, so they can say which point is which.
    index = np.arange(len(starts))
    tags = np.stack([index >> 16, index >> 8 & 255, index & 255], axis=1).astype(np.uint8)
    white = np.full_like(perceived.frames, 255)
    fused = fuse(replace(state, colors=tags), replace(perceived, frames=white))
    tag = fused.colors.astype(int) @ [1 << 16, 1 << 8, 1]
    old = np.flatnonzero(tag < len(starts))  # the rest are new points
    source = tag[old]
    error, behind = (
        _nearest(np.linalg.norm(fused.points_m[old] - wanted[source], axis=1), source, len(index))
        for wanted in (places, starts)
    )
    error = _inherit(error, starts, owners)
    target, scenery = owners == film.target_id, owners == 0
    others = ~target & ~scenery
    gone = np.linalg.norm(places - starts, axis=1) > MOVED_M
    shown = np.full(fused.colors.shape, (255, 0, 255), np.uint8)
    shown[old] = state.colors[source]
    colors = np.full(fused.colors.shape, 170, np.uint8)
    wrong = error[source] > NEAR_M
    colors[old[scenery[source]]] = 110
    colors[old[scenery[source] & wrong]] = 240, 220, 40
    colors[old[target[source]]] = 40, 190, 60
    colors[old[~scenery[source] & wrong]] = 230, 40, 40
    return Verdict(
        moved=float((error[target] <= NEAR_M).mean()),
        left=float(((behind <= NEAR_M) & gone)[target].mean()),
        still=float((error[others] <= NEAR_M).mean()) if others.any() else 1.0,
        dragged=float(wrong[scenery[source]].sum() / target.sum()),
        error_m=float(np.median(error[target])),
        notes=perceived.notes,
        before=state,
        after=replace(fused, colors=shown),
        marks=replace(fused, colors=colors),
    )


def _nearest(distances: np.ndarray, source: np.ndarray, count: int) -> np.ndarray:
    """Return the least distance by source; infinite for a source without any."""
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, source, distances)
    return nearest


def _inherit(error: np.ndarray, starts: np.ndarray, owners: np.ndarray) -> np.ndarray:
    """Give a point that a new one replaced the error of its nearest neighbor that is left.

    A new point replaces all within `REPLACE_M`, and carries the color of one of them.
    """
    found = error.copy()
    for number in np.unique(owners):
        (lost,) = np.nonzero((owners == number) & np.isinf(error))
        (kept,) = np.nonzero((owners == number) & np.isfinite(error))
        if len(lost) and len(kept):
            gaps, nearest = KDTree(starts[kept]).query(starts[lost])
            found[lost] = np.where(gaps <= REPLACE_M, error[kept[nearest]], np.inf)
    return found
