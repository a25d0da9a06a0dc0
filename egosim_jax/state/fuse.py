"""What was perceived becomes part of the state: U of EgoSim's equation S_k = U(S_{k-1}, O_k).

1. Depth is fused into surfaces, without the hands: one of everything that stood still, and one of
   each thing that was tracked, in its own coordinates, so that all frames count wherever it was.
2. What the memory knows of a tracked thing moves with it.
3. Free space is carved: a remembered point goes if the last frames that could have seen it look
   through it. (The original does not, and a moved thing leaves a ghost.)
4. New points replace remembered ones within 5 mm, and take over the colors of the nearest of the
   same thing: what was seen once is not painted again from a generated clip, whose colors drift
   from clip to clip. (The original paints again.)

Fusing the same again changes nothing, clips that see different places may be fused in either order,
and the points come out in one order, so that equal states are equal arrays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from egosim_jax.geometry import beside, invert, pixels_of, transform
from egosim_jax.state.filter import disappeared_objects
from egosim_jax.state.tsdf import Fusion, steady, surface
from egosim_jax.types import Perceived, SceneState

REPLACE_M = 0.005
"""A new point takes the place of remembered ones within so much."""
THROUGH_M, DOUBT = 0.02, 2
"""A point is looked through if the surface lies so far behind it; a verdict wavers between -DOUBT
and DOUBT, down one for each frame that looks through and up one for each that sees the point."""
NEIGHBORS, DEVIATIONS = 20, 2.0
"""Outliers are farther from so many neighbors than most by so many deviations."""
BORDER = 5 / 832
"""Around hands, as a share of the width: what is not trusted."""


@dataclass(frozen=True, kw_only=True)
class _Points:
    """Points as the state keeps them."""

    points_m: Float32[np.ndarray, "n 3"]
    colors: UInt8[np.ndarray, "n 3"]
    object_ids: Int[np.ndarray, " n"]
    last_seen: Int[np.ndarray, " n"]

    def __getitem__(self, chosen: np.ndarray) -> _Points:
        return _Points(**{name: array[chosen] for name, array in vars(self).items()})


def fuse(state: SceneState, perceived: Perceived, *, fusion: Fusion | None = None) -> SceneState:
    """The state after what was perceived; a clip in which nothing is known leaves its points."""
    lost = disappeared_objects(perceived.object_ids, dict(perceived.interacted_frames)) - set(
        perceived.world_from_object
    )
    sure = steady(perceived.depth_m)
    new = _observed(perceived, sure, lost, fusion or Fusion())
    old = _moved(state, perceived, lost)
    old = _carved(old, perceived, sure)
    new = replace(new, colors=_remembered(new, old))
    old = old[~_near(old.points_m, new.points_m, REPLACE_M)]
    everything = _ordered(_together([old, new]))
    poses = {n: path[-1] for n, path in perceived.world_from_object.items()}
    return replace(
        state,
        **vars(everything),
        step=max(state.step, perceived.step),
        names={**state.names, **perceived.names},
        world_from_object={**state.world_from_object, **poses},
    )


def _observed(
    perceived: Perceived, sure: Bool[np.ndarray, "f h w"], lost: set[int], fusion: Fusion
) -> _Points:
    """Surfaces of the background and of every thing that is not lost, at the end of the clip."""
    trusted = sure & ~widened(perceived.object_ids < 0, BORDER)
    pieces = []
    for number in sorted(set(np.unique(perceived.object_ids).tolist()) - lost):
        if number < 0:
            continue
        seen = trusted & (perceived.object_ids == number)
        path = perceived.world_from_object.get(number)
        if path is None and number in perceived.interacted_frames:
            seen = _last_view(seen)  # it moved, but how is not known
        cameras = perceived.cameras if path is None else beside(perceived.cameras, path)
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
    return _without_outliers(_together(pieces))


def widened(mask: Bool[np.ndarray, "f h w"], border: float) -> Bool[np.ndarray, "f h w"]:
    """The mask and what is within a border of it, a share of the width but at least a pixel."""
    import cv2

    border = max(1, round(border * mask.shape[2]))
    square = np.ones((2 * border + 1, 2 * border + 1), np.uint8)
    return np.stack([cv2.dilate(frame.astype(np.uint8), square) > 0 for frame in mask])


def _last_view(seen: Bool[np.ndarray, "f h w"]) -> Bool[np.ndarray, "f h w"]:
    frames = np.flatnonzero(seen.any(axis=(1, 2)))
    last = np.arange(len(seen)) == (frames[-1] if len(frames) else -1)
    return seen & last[:, None, None]


def _moved(state: SceneState, perceived: Perceived, lost: set[int]) -> _Points:
    """The memory with tracked things where they ended, and without those that are lost."""
    points = state.points_m.copy()
    for number, path in perceived.world_from_object.items():
        before = state.world_from_object.get(number, np.eye(4))
        own = state.object_ids == number
        if own.any() and not np.array_equal(before, path[-1]):
            there = transform(path[-1] @ invert(before), points[own].astype(np.float64))
            points[own] = there.astype(np.float32)
    kept = ~np.isin(state.object_ids, list(lost))
    return _Points(
        points_m=points,
        colors=state.colors,
        object_ids=state.object_ids,
        last_seen=state.last_seen,
    )[kept]


def _carved(old: _Points, perceived: Perceived, sure: Bool[np.ndarray, "f h w"]) -> _Points:
    """The points that the last frames that could have seen them did not look through."""
    verdict = np.zeros(len(old.points_m), int)
    confirmed = np.zeros(len(verdict), bool)
    depth = np.where(sure, perceived.depth_m, np.nan)
    for frame in range(len(depth)):
        behind = _surface_behind(old, perceived, depth[frame], frame)
        here = np.abs(behind) <= THROUGH_M
        verdict = np.clip(verdict + here - (behind > THROUGH_M), -DOUBT, DOUBT)
        confirmed |= here
    seen = np.where(confirmed, np.maximum(old.last_seen, perceived.step), old.last_seen)
    return replace(old, last_seen=seen.astype(np.int32))[verdict >= 0]


def _surface_behind(
    old: _Points, perceived: Perceived, depth_m: Float32[np.ndarray, "h w"], frame: int
) -> Float[np.ndarray, " n"]:
    """How far behind each point the frame's surface lies; NaN where the frame says nothing."""
    cameras = perceived.cameras
    camera_from_world = invert(cameras.world_from_camera[frame])
    local = transform(camera_from_world, old.points_m.astype(np.float64))
    for number, path in perceived.world_from_object.items():
        own = old.object_ids == number
        then = camera_from_world @ path[frame] @ invert(path[-1])
        local[own] = transform(then, old.points_m[own].astype(np.float64))
    row, column, inside = pixels_of(cameras, local)
    behind = np.full(len(local), np.nan)
    behind[inside] = depth_m[row[inside], column[inside]] - local[inside, 2]
    return behind


def _without_outliers(new: _Points) -> _Points:
    import open3d as o3d

    if len(new.points_m) <= NEIGHBORS:
        return new
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(new.points_m))
    _, kept = cloud.remove_statistical_outlier(NEIGHBORS, DEVIATIONS)
    return new[np.array(kept, int)]


def _near(
    points_m: Float32[np.ndarray, "n 3"], others_m: Float32[np.ndarray, "m 3"], radius_m: float
) -> Bool[np.ndarray, " n"]:
    """Which points have one of the others within the radius."""
    import open3d as o3d

    if not len(points_m) or not len(others_m):
        return np.zeros(len(points_m), bool)
    clouds = [o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p)) for p in (points_m, others_m)]
    return np.asarray(clouds[0].compute_point_cloud_distance(clouds[1])) <= radius_m


def _remembered(new: _Points, old: _Points) -> UInt8[np.ndarray, "n 3"]:
    """The colors of new points: of the nearest remembered one that they replace, or their own."""
    import open3d as o3d

    colors = new.colors.copy()
    for number in np.intersect1d(new.object_ids, old.object_ids):
        here = np.flatnonzero(new.object_ids == number)
        there = np.flatnonzero(old.object_ids == number)
        index = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor(old.points_m[there]))
        index.knn_index()
        nearest, square = (x.numpy() for x in index.knn_search(new.points_m[here], 1))
        near = square[:, 0] <= REPLACE_M**2
        colors[here[near]] = old.colors[there[nearest[near, 0]]]
    return colors


def _together(pieces: list[_Points]) -> _Points:
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


def _ordered(points: _Points) -> _Points:
    """In one order whatever the history: by thing, place and color."""
    return points[np.lexsort((*points.colors.T, *points.points_m.T, points.object_ids))]
