"""Surfaces that a clip shows for the first time, found without networks.

A pixel that no point of the state explains may continue a plane of the background: the table next
to its observed part, the table under an object that moved away, or the floor. It does if its ray
meets the plane near observed points of the plane, and its color is one of theirs. A table ends at
its edge, and the frames show where: beyond it the colors are other ones, or closer to another
surface. Other sides of a moved object are inside its convex hull. Everything else stays
unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from egosim_jax.dynamics.solids import hull_on_plane
from egosim_jax.geometry import invert, pixel_rays, transform
from egosim_jax.perception.objects.film import ColorCost
from egosim_jax.perception.pipeline import Observation
from egosim_jax.rendering.reference import add_margin, close_gaps, splat
from egosim_jax.state.fuse import dilate
from egosim_jax.state.planes import fit_plane
from egosim_jax.types import Action, Cameras, Clip, Counted, SceneState
from egosim_jax.types.arrays import (
    Colors,
    DepthMaps,
    IdMaps,
    Masks,
    Plane,
    Points,
    Poses,
    Vector,
    Video,
)


@dataclass(frozen=True, kw_only=True)
class NewSurfaces(Counted):
    """Stage that sets the depth of pixels that continue a plane of the state."""

    max_frames: int = 9
    """Maximum number of frames that are searched, evenly spaced, without the last ones."""
    last_frames: int = 3
    """Number of last frames that are searched too: as many as fusion asks for, at least."""
    max_planes: int = 4
    """Maximum number of planes of the background."""
    tolerance_m: float = 0.006
    """Inlier distance of a plane, in meters."""
    min_points: int = 300
    """Minimum number of points of a plane, of `plane_points`."""
    plane_points: int = 6000
    """Number of background points in which planes are searched."""
    reach: float = 0.2
    """Maximum distance from observed points of a plane, as a fraction of the depth."""
    max_depth_m: float = 3.0
    """Maximum depth in meters."""
    compared_points: int = 24
    """Number of the nearest points of a plane whose colors a pixel may have."""
    max_residual: float = 12.0
    """Maximum color difference from one of them, in 8-bit levels."""
    margin: float = 0.02
    """Border around hands and moved objects without new surfaces, as a fraction of the width."""
    side_margin: float = 0.1
    """Border around a moved object in which its other sides may be, as a fraction of the width."""
    side_reach_m: float = 0.03
    """Maximum distance of other sides from the object's observed points, in meters."""
    bin: int = 12
    """Size of the bins of the colors of other surfaces, in 8-bit levels."""
    min_wall: int = 40
    """Minimum number of points of a wall, of `plane_points`."""
    min_bin: int = 5
    """Minimum number of points of a bin."""
    color: ColorCost = field(default_factory=partial(ColorCost, min_light=0.7, max_light=1.15))
    """Comparison of colors."""

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `depth_m` and `object_ids` where a new surface is seen; leave them elsewhere."""
        cameras, ids, depth, motions, supports = (
            so_far.require(name, "NewSurfaces")
            for name in ("cameras", "object_ids", "depth_m", "motions", "support_planes")
        )
        count = len(clip.frames)
        chosen = np.linspace(0, count - 1, min(count, self.max_frames)).round().astype(int)
        # What a moved object uncovers late is in few frames.
        chosen = np.union1d(chosen, np.arange(max(0, count - self.last_frames), count))
        motions = {number: motion[chosen] for number, motion in motions.items()}
        cameras = replace(cameras, world_from_camera=cameras.world_from_camera[chosen])
        depth, ids = depth.copy(), ids.copy()
        depth[chosen], ids[chosen] = self._add(
            clip.frames[chosen], cameras, depth[chosen], ids[chosen], motions, supports, state
        )
        return replace(so_far, depth_m=depth, object_ids=ids)

    def _add(
        self,
        frames: Video,
        cameras: Cameras,
        depth: DepthMaps,
        ids: IdMaps,
        motions: Mapping[int, Poses],
        supports: Mapping[int, Plane],
        state: SceneState,
    ) -> tuple[DepthMaps, IdMaps]:
        """Return depth and object ids with new surfaces."""
        rest = ~np.isin(state.object_ids, list(motions))
        known_m, index = close_gaps(*splat(state.points_m[rest], add_margin(cameras), point_px=1))
        new = (index < 0) & (ids == 0) & ~np.isfinite(depth) & ~dilate(ids < 0, self.margin)
        pixels = _Pixels.of(new, frames, cameras, self)
        planes = self._planes(state, rest, list(supports.values()))
        pixels.compete(self._other_colors(state, planes))
        apart = ~dilate(ids > 0, self.margin)
        for plane in planes:
            pixels.offer(plane, apart)
        for number, motion in motions.items():
            hull = _hull(number, motion, supports[number], state)
            if hull is not None and len(hull.points_m) >= self.compared_points:
                pixels.offer(hull, dilate(ids == number, self.side_margin))
        background = (index >= 0) & (state.object_ids[rest][index] == 0) & (ids == 0)
        depth[new], ids[new] = pixels.depth_m, pixels.object_ids
        # With a seam, or an outline of unobserved pixels would stay between new and old points.
        for plane in planes:
            there = plane_depth(plane.plane, cameras)
            with np.errstate(invalid="ignore"):
                continued = new & (np.abs(there - depth) <= self.tolerance_m)
                flush = background & (np.abs(there - known_m) <= self.tolerance_m)
            seam = dilate(continued, 0.0) & flush
            depth[seam] = there[seam]
        return depth, ids

    def _other_colors(self, state: SceneState, planes: Sequence[_Plane]) -> Colors:
        """Return the colors, in bins, of background points that are on none of the planes."""
        points = state.points_m[state.object_ids == 0]
        away = np.full(len(points), np.inf)
        for plane in planes:
            away = np.minimum(away, np.abs(points @ plane.plane[:3] + plane.plane[3]))
        colors = state.colors[state.object_ids == 0][away > 2 * self.tolerance_m]
        bins, counts = np.unique(colors // self.bin, axis=0, return_counts=True)
        bins = bins[counts >= self.min_bin]
        return (bins.astype(np.float32) + 0.5) * self.bin

    def _planes(
        self, state: SceneState, rest: Bool[np.ndarray, " n"], supports: list[Plane]
    ) -> list[_Plane]:
        """Return the planes below moved objects, and the largest planes of the background."""
        planes = []
        some = np.flatnonzero(rest)
        some = some[:: max(1, len(some) // self.plane_points)]
        for plane in supports:
            gaps = np.abs(state.points_m[some] @ plane[:3] + plane[3])
            planes.append(_Plane(plane=plane, **_points_of(state, some[gaps <= self.tolerance_m])))
        some = some[state.object_ids[some] == 0]
        while len(some) >= self.min_points and len(planes) < len(supports) + self.max_planes:
            plane, inliers = fit_plane(state.points_m[some], self.tolerance_m)
            if len(inliers) < self.min_points:
                break
            planes.append(_Plane(plane=plane, **_points_of(state, some[inliers])))
            some = np.delete(some, inliers)
        if planes and len(some) >= self.min_wall:
            wall, inliers = self._wall(state.points_m[some], planes[0].plane[:3])
            if len(inliers) >= self.min_wall:
                planes.append(_Plane(plane=wall, **_points_of(state, some[inliers])))
        return [plane for plane in planes if len(plane.points_m) >= self.compared_points]

    def _wall(
        self, points_m: Float32[np.ndarray, "n 3"], up: Vector
    ) -> tuple[Plane, Int[np.ndarray, " k"]]:
        """Return the plane along `up` with the most inliers, and the inliers.

        The frames show a strip of a wall, which does not determine a plane of any direction. Copies
        of the points, far above them, make it one along `up`.
        """
        copies = np.concatenate([points_m, points_m + self.max_depth_m * up])
        plane, _ = fit_plane(copies, self.tolerance_m)
        plane = plane / np.linalg.norm(plane[:3])
        inliers = np.flatnonzero(np.abs(points_m @ plane[:3] + plane[3]) <= self.tolerance_m)
        upright = abs(float(plane[:3] @ up)) < 0.02
        return plane, inliers if upright else inliers[:0]


@dataclass(frozen=True, kw_only=True)
class _Surface:
    """A surface that may have more pixels than the state has points, with those points."""

    points_m: Float[np.ndarray, "n 3"]
    colors: Float32[np.ndarray, "n 3"]
    object_ids: Int32[np.ndarray, " n"]


@dataclass(frozen=True, kw_only=True)
class _Plane(_Surface):
    plane: Float[np.ndarray, " 4"]
    """Plane a x + b y + c z + d = 0."""

    def meet(
        self, eye: Points, toward: Points, frame: Int[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Points]:
        """Return depths, and where the rays meet the plane."""
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = -(eye @ self.plane[:3] + self.plane[3]) / (toward @ self.plane[:3])
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.inf)
        return depth, eye + np.where(np.isfinite(depth), depth, 0)[:, None] * toward


@dataclass(frozen=True, kw_only=True)
class _Hull(_Surface):
    faces: Float[np.ndarray, "m 4"]
    """Outward planes of the faces."""
    motion: Float[np.ndarray, "f 4 4"]
    """World motion in each frame."""

    def meet(
        self, eye: Points, toward: Points, frame: Int[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Points]:
        """Return depths, and where the rays meet the hull, before its motion."""
        back = invert(self.motion)[frame]
        eye = transform(back, eye[:, None])[:, 0]
        toward = np.einsum("nij,nj->ni", back[:, :3, :3], toward)
        speed = toward @ self.faces[:, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            times = -(eye @ self.faces[:, :3].T + self.faces[:, 3]) / speed
        enter = np.where(speed < 0, times, -np.inf).max(axis=1)
        leave = np.where(speed > 0, times, np.inf).min(axis=1)
        depth = np.where((enter > 0) & (enter <= leave), enter, np.inf)
        return depth, eye + np.where(np.isfinite(depth), depth, 0)[:, None] * toward


def _points_of(state: SceneState, chosen: Int[np.ndarray, " n"]) -> dict[str, np.ndarray]:
    return {
        "points_m": state.points_m[chosen].astype(float),
        "colors": state.colors[chosen].astype(np.float32),
        "object_ids": state.object_ids[chosen],
    }


def _hull(number: int, motion: Poses, plane: Plane, state: SceneState) -> _Hull | None:
    """Return the hull of a moved object; None if its points do not span a volume."""
    chosen = np.flatnonzero(state.object_ids == number)
    hull = hull_on_plane(state.points_m[chosen].astype(float), plane)
    if hull is None:
        return None
    return _Hull(faces=hull.equations, motion=motion, **_points_of(state, chosen))


@dataclass(frozen=True, kw_only=True)
class _Pixels:
    """Pixels without a point of the state, and the best of the surfaces that they may show."""

    new: Bool[np.ndarray, "f h w"]
    frame: Int[np.ndarray, " n"]
    eye: Float[np.ndarray, "n 3"]
    toward: Float[np.ndarray, "n 3"]
    shown: Float32[np.ndarray, "n 3"]
    residual: Float32[np.ndarray, " n"]
    depth_m: Float32[np.ndarray, " n"]
    object_ids: Int32[np.ndarray, " n"]
    config: NewSurfaces

    @classmethod
    def of(cls, new: Masks, frames: Video, cameras: Cameras, config: NewSurfaces) -> _Pixels:
        frame, row, column = np.nonzero(new)
        rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
        poses = cameras.world_from_camera[frame]
        return cls(
            new=new,
            frame=frame,
            eye=poses[:, :3, 3],
            toward=np.einsum("nij,nj->ni", poses[:, :3, :3], rays[row, column]),
            shown=frames[new].astype(np.float32),
            residual=np.full(len(frame), config.max_residual, np.float32),
            depth_m=np.full(len(frame), np.inf, np.float32),
            object_ids=np.zeros(len(frame), np.int32),
            config=config,
        )

    def compete(self, colors: Colors) -> None:
        """Limit the color difference from a surface to that from the nearest of other colors.

        A wall behind a table may look like the table in another light, but it looks more like the
        wall.
        """
        for color in colors:
            apart = self.config.color.apart(self.shown, color[None])
            np.minimum(self.residual, apart, out=self.residual)

    def offer(self, surface: _Plane | _Hull, where: Masks) -> None:
        """Take a surface in the pixels `where` it is near its points and has a better color."""
        from scipy.spatial import KDTree

        config = self.config
        (some,) = np.nonzero(where[self.new])
        depth, met = surface.meet(self.eye[some], self.toward[some], self.frame[some])
        ahead = depth < config.max_depth_m
        some, depth, met = some[ahead], depth[ahead], met[ahead]
        nearest = KDTree(surface.points_m).query(met, k=config.compared_points)
        gaps, near = (np.asarray(x) for x in nearest)
        reach = config.side_reach_m if isinstance(surface, _Hull) else config.reach * depth
        close = gaps[:, 0] <= reach
        some, depth, near = some[close], depth[close], near[close]
        apart = config.color.apart(self.shown[some][:, None], surface.colors[near]).min(axis=1)
        better = apart < self.residual[some]
        some = some[better]
        self.residual[some], self.depth_m[some] = apart[better], depth[better]
        self.object_ids[some] = surface.object_ids[near[better, 0]]


def plane_depth(plane: Plane, cameras: Cameras) -> DepthMaps:
    """Return the depth of a plane (a, b, c, d) in meters; infinite where a ray misses it."""
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    normal, offset = plane[:3], plane[3]
    depths = []
    for pose in cameras.world_from_camera:
        height = pose[:3, 3] @ normal + offset
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -height / (rays @ pose[:3, :3].T @ normal)
        depths.append(np.where(along > 0, along, np.inf))
    return np.array(depths, np.float32)
