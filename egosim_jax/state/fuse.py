"""State update: U of EgoSim's equation S_k = U(S_{k-1}, O_k).

0. Points that the clip shows to be an object get its new id (`new_objects`).
1. Depth is fused into surfaces, without the hands: one for everything static, and one for each
   tracked object in its own coordinates, so that all frames contribute wherever the object was.
2. Points of the state that belong to a tracked object move with it.
3. Free space is carved: a point of the state is removed if the last frames that could have observed
   it see through it. (The original does not carve: moved objects leave ghost points.)
4. New points replace points of the state within 5 mm, and take the color of the nearest one of the
   same object, even if it is carved. Generated colors drift from clip to clip, so an observed
   surface is not repainted. (The original repaints.)

The update is idempotent, and clips of different places commute. The points have a canonical order,
so equal states are equal arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from egosim_jax.geometry import cameras_in_object_frame, invert, pixels_of, transform
from egosim_jax.runtime.open3d import load_open3d, nearest, point_cloud
from egosim_jax.state.filter import disappeared_objects
from egosim_jax.state.new_objects import with_objects
from egosim_jax.state.tsdf import Fusion, surface, valid_depth_mask
from egosim_jax.types import Perceived, SceneState
from egosim_jax.types.arrays import Masks, Points

REPLACE_M = 0.005
"""Distance within which a new point replaces points of the state, in meters."""
FREE_SPACE_MARGIN_M = 0.02
"""A frame sees through a point if the surface is this far behind it, in meters."""
VOTE_LIMIT = 2
"""Limit of a point's votes: -1 per frame that sees through it, +1 per frame that observes it."""
OUTLIER_NEIGHBORS = 20
"""Neighbors whose mean distance decides whether a point is an outlier."""
OUTLIER_DEVIATIONS = 2.0
"""Standard deviations of that distance beyond which a point is an outlier."""
HAND_MARGIN = 5 / 832
"""Border around hands in which depth is not used, as a fraction of the image width."""


@dataclass(frozen=True, kw_only=True)
class _Points:
    """Points with the attributes that a state stores."""

    points_m: Float32[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    object_ids: Int[np.ndarray, " n"]
    last_seen: Int[np.ndarray, " n"]

    def __getitem__(self, chosen: np.ndarray) -> _Points:
        return _Points(**{name: array[chosen] for name, array in vars(self).items()})


def fuse(state: SceneState, perceived: Perceived, *, fusion: Fusion | None = None) -> SceneState:
    """Return the state after a clip; a clip without known depth keeps the points."""
    state = with_objects(state, perceived.new_objects)
    disappeared = disappeared_objects(perceived.object_ids, dict(perceived.interacted_frames))
    disappeared -= set(perceived.world_from_object)
    valid = valid_depth_mask(perceived.depth_m)
    new = reconstruct(perceived, valid, disappeared, fusion or Fusion())
    old = apply_motion(state, perceived, disappeared)
    # Before carving, which on a second update may remove new points of the first one: they would
    # then take the color of a neighbor.
    new = replace(new, colors=transfer_colors(new, old))
    old = carve_free_space(old, perceived, valid)
    old = old[nearest(old.points_m, new.points_m) > REPLACE_M]
    points = canonical_sort(concat([old, new]))
    poses = {n: path[-1] for n, path in perceived.world_from_object.items()}
    return replace(
        state,
        **vars(points),
        step=max(state.step, perceived.step),
        names={**state.names, **perceived.names},
        world_from_object={**state.world_from_object, **poses},
        held=dict(perceived.held),
    )


def reconstruct(
    perceived: Perceived, valid: Masks, disappeared: set[int], fusion: Fusion
) -> _Points:
    """Return the surfaces of background and objects at the clip's end, without disappeared ones."""
    usable = valid & ~dilate(perceived.object_ids < 0, HAND_MARGIN)
    pieces = []
    for number in sorted(set(np.unique(perceived.object_ids).tolist()) - disappeared):
        if number < 0:
            continue
        seen = usable & (perceived.object_ids == number)
        path = perceived.world_from_object.get(number)
        if path is None and number in perceived.interacted_frames:
            seen = _last_visible_frame(seen)  # it moved, by an unknown motion
        cameras = (
            perceived.cameras if path is None else cameras_in_object_frame(perceived.cameras, path)
        )
        depth = np.where(seen, perceived.depth_m, 0).astype(np.float32)
        points, colors = surface(depth, perceived.frames, cameras, fusion=fusion)
        if path is not None:
            points = transform(path[-1], points.astype(np.float64)).astype(np.float32)
        ids = np.full(len(points), number, np.int32)
        pieces.append(
            _Points(
                points_m=points,
                colors=colors,
                object_ids=ids,
                last_seen=np.full_like(ids, perceived.step),
            )
        )
    return _remove_outliers(concat(pieces))


def dilate(mask: Masks, border: float) -> Masks:
    """Return masks dilated by a border: a fraction of the image width, at least one pixel."""
    import cv2

    border = max(1, round(border * mask.shape[2]))
    square = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    return np.stack([cv2.dilate(frame.astype(np.uint8), square) > 0 for frame in mask])


def _last_visible_frame(seen: Masks) -> Masks:
    frames = np.flatnonzero(seen.any(axis=(1, 2)))
    last = np.arange(len(seen)) == (frames[-1] if len(frames) else -1)
    return seen & last[:, None, None]


def apply_motion(state: SceneState, perceived: Perceived, disappeared: set[int]) -> _Points:
    """Return the state's points at the clip's end, without disappeared objects."""
    points = state.points_m.copy()
    for number, path in perceived.world_from_object.items():
        before = state.world_from_object.get(number, np.eye(4))
        chosen = state.object_ids == number
        # An object that stays keeps its exact coordinates: rounding would break idempotence.
        if chosen.any() and not np.array_equal(before, path[-1]):
            moved = transform(path[-1] @ invert(before), points[chosen].astype(np.float64))
            points[chosen] = moved.astype(np.float32)
    kept = ~np.isin(state.object_ids, list(disappeared))
    return _Points(
        points_m=points,
        colors=state.colors,
        object_ids=state.object_ids,
        last_seen=state.last_seen,
    )[kept]


def carve_free_space(old: _Points, perceived: Perceived, valid: Masks) -> _Points:
    """Remove the points that the last frames with a view of them see through."""
    votes = np.zeros(len(old.points_m), int)
    observed = np.zeros(len(votes), bool)
    depth = np.where(valid, perceived.depth_m, np.nan)
    points = old.points_m.astype(np.float64)
    for frame in np.flatnonzero(valid.any(axis=(1, 2))).tolist():
        behind = _surface_behind(points, old.object_ids, perceived, depth[frame], frame)
        here = np.abs(behind) <= FREE_SPACE_MARGIN_M
        through = behind > FREE_SPACE_MARGIN_M
        votes = np.clip(votes + here - through, -VOTE_LIMIT, VOTE_LIMIT)
        observed |= here
    seen = np.where(observed, np.maximum(old.last_seen, perceived.step), old.last_seen)
    return replace(old, last_seen=seen.astype(np.int32))[votes >= 0]


def _surface_behind(
    points_m: Points,
    object_ids: Int[np.ndarray, " n"],
    perceived: Perceived,
    depth_m: Float32[np.ndarray, "h w"],
    frame: int,
) -> Float[np.ndarray, " n"]:
    """Return the distance in meters of a frame's surface behind each point; NaN where unknown."""
    cameras = perceived.cameras
    camera_from_world = invert(cameras.world_from_camera[frame])
    local = transform(camera_from_world, points_m)
    for number, path in perceived.world_from_object.items():
        chosen = object_ids == number
        camera_from_end = camera_from_world @ path[frame] @ invert(path[-1])
        local[chosen] = transform(camera_from_end, points_m[chosen])
    row, column, inside = pixels_of(cameras, local)
    behind = np.full(len(local), np.nan)
    behind[inside] = depth_m[row[inside], column[inside]] - local[inside, 2]
    return behind


def _remove_outliers(new: _Points) -> _Points:
    if len(new.points_m) <= OUTLIER_NEIGHBORS:
        return new
    cloud = point_cloud(new.points_m)
    _, kept = cloud.remove_statistical_outlier(OUTLIER_NEIGHBORS, OUTLIER_DEVIATIONS)
    return new[np.array(kept, int)]


def transfer_colors(new: _Points, old: _Points) -> UInt8[np.ndarray, "n 3"]:
    """Return the colors of new points, from the nearest old point that they replace, if any."""
    o3d = load_open3d()

    colors = new.colors.copy()
    for number in np.intersect1d(new.object_ids, old.object_ids):
        chosen = np.flatnonzero(new.object_ids == number)
        candidates = np.flatnonzero(old.object_ids == number)
        index = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(old.points_m[candidates]))
        index.knn_index()
        nearest, square = (x.numpy() for x in index.knn_search(new.points_m[chosen], 1))
        near = square[:, 0] <= REPLACE_M**2
        colors[chosen[near]] = old.colors[candidates[nearest[near, 0]]]
    return colors


def concat(pieces: list[_Points]) -> _Points:
    """Return the points of all pieces; without pieces, no points."""
    empty = _Points(
        points_m=np.zeros((0, 3), np.float32),
        colors=np.zeros((0, 3), np.uint8),
        object_ids=np.zeros(0, np.int32),
        last_seen=np.zeros(0, np.int32),
    )
    names = vars(empty)
    return _Points(
        **{name: np.concatenate([getattr(p, name) for p in [empty, *pieces]]) for name in names}
    )


def canonical_sort(points: _Points) -> _Points:
    """Return the points sorted by object, position and color, independent of their history."""
    return points[np.lexsort((*points.colors.T, *points.points_m.T, points.object_ids))]
