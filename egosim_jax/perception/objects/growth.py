"""Objects without an id: what a hand touches, grown over the connected surface of the state.

The points between the fingertips, or nearest to them, are the seeds. They grow over neighbors that
are not on the supporting plane. One object may touch another, so there are several growths, from
the whole connected surface to less: up to concave edges, up to other colors, up to any edge. The
clip decides between them (`object_motion`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from egosim_jax.geometry import upward
from egosim_jax.perception.objects.film import ObjectModel
from egosim_jax.state.planes import support_planes
from egosim_jax.types import SceneState
from egosim_jax.types.arrays import Points, Pose

NOTHING = "closed on nothing"
"""Note of a hand that closes and has no points in its grip."""
NEW = 0
"""Number of an object that has no id yet."""
SEAM_COLORS = 8
"""Number of nearest points whose colors a point at a border between objects is compared with."""
NEIGHBORS = 16
"""Number of nearest points that determine a point's normal."""
HOLLOW = 0.15
"""Minimum fraction of concave pairs of a point at a concave edge."""
MAX_SEEDS = 20
"""Maximum number of points between the fingertips that give an object's color."""
MIN_HEIGHT_M = 0.002
"""Minimum height above the supporting plane at which a point is not on it, in meters."""
MAX_NOISE_M = 0.006
"""Distance from the plane within which the median distance is its noise, in meters."""


@dataclass(frozen=True, kw_only=True)
class Growth:
    """Parameters of the segmentation of what a hand touches."""

    reach_m: float = 0.03
    """Maximum distance from the line between the fingertips to the first points, in meters."""
    max_extent_m: float = 0.35
    """Maximum extent of an object that one hand moves, in meters."""
    spacings: float = 2.5
    """Maximum distance of connected points, in median distances of nearest points."""
    concave: float = 0.2
    """Height of a point above a neighbor's tangent plane at a concave edge, per distance."""
    edge_deg: float = 25.0
    """Angle between the normals of neighbors at an edge, in degrees."""
    color_levels: tuple[float, ...] = (45.0, 18.0)
    """Differences in color at which growths end, whatever the light, in 8-bit levels."""
    min_points: int = 30
    """Minimum number of points of an object."""


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """Points without an id around a hand: those above the supporting plane, and those near it."""

    points_m: Float32[np.ndarray, "n 3"]
    """Points above the plane."""
    colors: Float32[np.ndarray, "n 3"]
    low_m: Float32[np.ndarray, "m 3"]
    """Points of the plane, and points as near to it as its noise."""
    low_colors: Float32[np.ndarray, "m 3"]
    plane: Float[np.ndarray, " 4"]
    """Plane a x + b y + c z + d = 0 with the normal up; d is NaN if there is no plane."""
    noise_m: float
    """Standard deviation of the plane's points from it, in meters."""
    eye_m: Float[np.ndarray, " 3"]
    """Place of the camera, which sees the outside of the surfaces."""
    config: Growth

    @classmethod
    def of(
        cls,
        state: SceneState,
        chosen: Int[np.ndarray, " k"],
        world_from_camera: Pose,
        config: Growth,
    ) -> Surroundings:
        """Return the surroundings of a hand from the chosen points of a state."""
        points, colors = state.points_m[chosen], state.colors[chosen].astype(np.float32)
        up, eye_m = upward(state, world_from_camera)
        surfaces = support_planes(points, up, eye_m=eye_m)
        plane = surfaces[0].plane if surfaces else np.array([*up, np.nan])
        heights = points @ plane[:3] + plane[3]
        near = np.abs(heights)
        near = near[near < MAX_NOISE_M]
        noise = 1.4826 * float(np.median(near)) if len(near) else 0.0
        raised = ~(heights <= max(MIN_HEIGHT_M, 3 * noise))
        low = ~raised & (np.abs(heights) <= max(MAX_NOISE_M, 3 * noise))
        return cls(
            points_m=points[raised],
            colors=colors[raised],
            low_m=points[low],
            noise_m=noise,
            low_colors=colors[low],
            plane=plane,
            eye_m=world_from_camera[:3, 3],
            config=config,
        )

    @cached_property
    def neighbors(self) -> Int[np.ndarray, "n k"]:
        """Indices of the nearest points of each point, itself first."""
        from scipy.spatial import KDTree

        count = min(NEIGHBORS, len(self.points_m))
        return KDTree(self.points_m).query(self.points_m, count)[1].reshape(-1, count)

    @cached_property
    def radius_m(self) -> float:
        """Maximum distance of connected points in meters."""
        gaps = self.points_m[self.neighbors[:, 1:2]] - self.points_m[:, None]
        return self.config.spacings * float(np.median(np.linalg.norm(gaps, axis=2)))

    @cached_property
    def normals(self) -> Points:
        """Outward unit normals of the surfaces."""
        around = self.points_m[self.neighbors].astype(float)
        around -= around.mean(axis=1, keepdims=True)
        normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
        inward = ((self.eye_m - self.points_m) * normals).sum(axis=1) < 0
        return np.where(inward[:, None], -normals, normals)

    @cached_property
    def pairs(self) -> Int[np.ndarray, "p 2"]:
        """Pairs of connected points."""
        from scipy.spatial import KDTree

        return KDTree(self.points_m).query_pairs(self.radius_m, output_type="ndarray")

    @cached_property
    def bends(self) -> Float[np.ndarray, "p 3"]:
        """Difference of the normals of each pair."""
        one, other = self.pairs.T
        return self.normals[one] - self.normals[other]

    @cached_property
    def concave(self) -> Bool[np.ndarray, " p"]:
        """Pairs across a concave edge: each point is above the other's tangent plane."""
        one, other = self.pairs.T
        steps = self.points_m[other] - self.points_m[one]
        rise = (self.bends * steps).sum(axis=1) / 2
        return rise > self.config.concave * np.linalg.norm(steps, axis=1)

    @cached_property
    def hollow(self) -> Bool[np.ndarray, " n"]:
        """Points at a concave edge."""
        count = len(self.points_m)
        every = np.bincount(self.pairs.ravel(), minlength=count)
        concave = np.bincount(self.pairs[self.concave].ravel(), minlength=count)
        return concave > HOLLOW * every

    def parts(
        self, members: Bool[np.ndarray, " n"], cut: Bool[np.ndarray, " p"] | None = None
    ) -> Int[np.ndarray, " n"]:
        """Return the number of each member's connected part, and -1 for other points.

        `cut` marks the pairs that do not connect.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        kept = members[self.pairs].all(axis=1)
        if cut is not None:
            kept &= ~cut
        rows, columns = self.pairs[kept].T
        size = len(self.points_m)
        graph = coo_array((np.ones(len(rows), bool), (rows, columns)), shape=(size, size))
        return np.where(members, connected_components(graph, directed=False)[1], -1)

    def touched(self, grips: Float[np.ndarray, "g 2 3"]) -> tuple[list[list[ObjectModel]], str]:
        """Return the growths of each cluster that one of the grips touches, and a note.

        A grip is the places of thumb and fingers. The note says why there is no growth.
        """
        clusters: dict[int, list[ObjectModel]] = {}
        notes = [NOTHING]
        everything = np.ones(len(self.points_m), bool)
        parts = self.parts(everything) if len(everything) > 1 else np.zeros(len(everything), int)
        for tips in grips:
            seeds = seeds_between(self.points_m, tips, self.config.reach_m)
            if not len(seeds):
                if len(seeds_between(self.low_m, tips, self.config.reach_m / 2)):
                    notes.append("closed on something that looks like its support")
                continue
            cluster = int(np.bincount(parts[seeds]).argmax())
            if cluster in clusters:
                continue
            if (parts == cluster).sum() < self.config.min_points:
                notes.append("closed on too few points to be an object")
                continue
            growths = list(self.grow(seeds[parts[seeds] == cluster], parts == cluster))
            small = [g for g in growths if self.extent_m(g) <= self.config.max_extent_m]
            clusters[cluster] = [self.model(members) for members in small]
            if not small:
                limit = self.config.max_extent_m
                notes.append(f"closed on something larger than {limit} m: it was not moved")
        choices = [growths for growths in clusters.values() if growths]
        return choices, "" if choices else notes[-1]

    def grow(
        self, seeds: Int[np.ndarray, " s"], whole: Bool[np.ndarray, " n"]
    ) -> Iterator[Bool[np.ndarray, " n"]]:
        """Yield the points of the possible objects around seeds in a part, the largest first."""
        flat = whole & ~self.hollow
        sharp = np.linalg.norm(self.bends, axis=1) > np.radians(self.config.edge_deg)
        convex = self._fill(self._around(seeds, self.parts(flat, self.concave)), whole)
        difference = self._difference(seeds)
        alike = [difference < levels for levels in self.config.color_levels]
        earlier: list[Bool[np.ndarray, " n"]] = []
        for core in (
            whole,
            convex,
            *(self._around(seeds, self.parts(whole & same)) for same in alike),
            *(self._around(seeds, self.parts(convex & same)) for same in alike),
            self._around(seeds, self.parts(flat, sharp)),
        ):
            if core.sum() < self.config.min_points:
                continue
            members = self.with_crumbs(self.with_seam(core, whole))
            if any((members & old).sum() > 0.95 * (members | old).sum() for old in earlier):
                continue
            earlier.append(members)
            yield members

    def extent_m(self, members: Bool[np.ndarray, " n"]) -> float:
        """Return the longest side of the box around some points in meters."""
        return float(np.ptp(self.points_m[members], axis=0).max())

    def with_crumbs(self, members: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return an object's points with the pieces next to it that are too small for an object.

        Such pieces are a seam along its edge, whose points mix two colors or, where the surface
        turns away from the camera, are far behind each other.
        """
        parts = self.parts(~members)
        (rest,) = np.nonzero(~members)
        if not len(rest):
            return members
        near = self._is_next_to(rest, members)
        count, close = (np.bincount(parts[rest], weights) for weights in (None, near))
        piece = (close > 0) & ((count < self.config.min_points) | (close >= 0.9 * count))
        grown = members.copy()
        grown[rest] = piece[parts[rest]]
        return grown

    def with_seam(
        self, members: Bool[np.ndarray, " n"], whole: Bool[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Return an object's points, with each point at its border on the side of its color.

        At a concave edge to another object, the shape does not say which points are on which side.
        """
        from scipy.spatial import KDTree

        outside = whole & ~members
        at_border = np.zeros_like(members)
        for side, beyond in ((outside, members), (members & self.hollow, outside)):
            if side.any() and beyond.any():
                at_border[side] = self._is_next_to(np.flatnonzero(side), beyond)
        seam, inner, rest = (
            np.flatnonzero(mask) for mask in (at_border, members & ~at_border, outside & ~at_border)
        )
        if not len(seam) or min(len(inner), len(rest)) < SEAM_COLORS:
            return members

        def difference(others: Int[np.ndarray, " m"]) -> Float[np.ndarray, " s"]:
            nearest = KDTree(self.points_m[others]).query(self.points_m[seam], SEAM_COLORS)[1]
            colors, shown = self.colors[others][nearest], self.colors[seam][:, None]
            light = (shown * colors).sum(axis=2) / np.maximum((colors**2).sum(axis=2), 1)
            return np.linalg.norm(shown - light[..., None] * colors, axis=2).min(axis=1)

        grown = members.copy()
        grown[seam] = difference(inner) < difference(rest)
        return grown

    def model(self, members: Bool[np.ndarray, " n"]) -> ObjectModel:
        """Return the model of an object with its feet: its points that are near the plane.

        They are next to the object, and look more like it than like the plane.
        """
        from scipy.spatial import KDTree

        points, colors = self.points_m[members], self.colors[members]
        feet = np.zeros(len(self.low_m), bool)
        if len(feet):
            gaps, nearest = KDTree(points).query(self.low_m, distance_upper_bound=2 * self.radius_m)
            heights = self.low_m @ self.plane[:3] + self.plane[3]
            above = heights > max(MIN_HEIGHT_M / 4, self.noise_m)  # a shadow is on the plane
            (close,) = np.nonzero(np.isfinite(gaps) & above)
            ground = np.median(self.low_colors, axis=0)
            to_object = np.linalg.norm(
                self.low_colors[close] - colors[np.asarray(nearest)[close]], axis=1
            )
            to_ground = np.linalg.norm(self.low_colors[close] - ground, axis=1)
            feet[close] = to_object < to_ground
        return ObjectModel(
            number=NEW,
            points_m=np.concatenate([points, self.low_m[feet]]).astype(float),
            colors=np.concatenate([colors, self.low_colors[feet]]),
            plane=self.plane,
        )

    def _is_next_to(
        self, others: Int[np.ndarray, " k"], members: Bool[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " k"]:
        """Return which other points are next to an object, as the camera sees them."""
        from scipy.spatial import KDTree

        gaps, nearest = KDTree(self.points_m[members]).query(self.points_m[others])
        ray = self.points_m[others] - self.eye_m
        step = self.points_m[members][nearest] - self.points_m[others]
        aside = np.linalg.norm(np.cross(step, ray), axis=1) / np.linalg.norm(ray, axis=1)
        return (gaps <= 3 * self.radius_m) & (aside <= 1.5 * self.radius_m)

    def _around(
        self, seeds: Int[np.ndarray, " s"], parts: Int[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Return the part that has most of the seeds."""
        numbers = parts[seeds]
        numbers = numbers[numbers >= 0]
        if not len(numbers):
            return np.zeros(len(parts), bool)
        return parts == np.bincount(numbers).argmax()

    def _fill(
        self, members: Bool[np.ndarray, " n"], whole: Bool[np.ndarray, " n"]
    ) -> Bool[np.ndarray, " n"]:
        """Return a part with the hollow points that are nearest to it among the flat ones."""
        from scipy.spatial import KDTree

        (edges,) = np.nonzero(whole & self.hollow)
        (flat,) = np.nonzero(whole & ~self.hollow)
        if not len(edges) or not len(flat):
            return members
        nearest = flat[KDTree(self.points_m[flat]).query(self.points_m[edges])[1]]
        filled = members.copy()
        filled[edges] = members[nearest]
        return filled

    def _difference(self, seeds: Int[np.ndarray, " s"]) -> Float[np.ndarray, " n"]:
        """Return the difference of each point's color from the seeds' under any light."""
        color = np.median(self.colors[seeds[:MAX_SEEDS]], axis=0)
        light = (self.colors @ color) / max(float(color @ color), 1.0)
        return np.linalg.norm(self.colors - light[:, None] * color, axis=1)


def clusters_without_id(
    grips: Float[np.ndarray, "g 2 3"], world_from_camera: Pose, state: SceneState, config: Growth
) -> tuple[list[list[ObjectModel]], str]:
    """Return the growths of each cluster without an id that a hand touches, and a note.

    `grips` are the places of thumb and fingers when the hand may begin to hold something. The
    growths of a cluster begin with the largest. The note says why there is no growth.
    """
    from scipy.spatial import KDTree

    if not len(grips):
        return [], NOTHING
    pinches = grips.mean(axis=1)
    low, high = pinches.min(axis=0) - config.max_extent_m, pinches.max(axis=0) + config.max_extent_m
    within = ((state.points_m >= low) & (state.points_m <= high)).all(axis=1)
    free = np.flatnonzero((state.object_ids == 0) & within)
    gaps, _ = KDTree(pinches).query(state.points_m[free])
    free = free[gaps <= config.max_extent_m]
    if len(free) < config.min_points:
        return [], NOTHING
    return Surroundings.of(state, free, world_from_camera, config).touched(grips)


def seeds_between(
    points_m: Points, tips_m: Float[np.ndarray, "2 3"], reach_m: float
) -> Int[np.ndarray, " s"]:
    """Return the points nearest to the line from the thumb to the fingers, from its middle.

    Points within 5 mm more than the nearest one's distance count; none beyond `reach_m`.
    """
    thumb, across = tips_m[0], tips_m[1] - tips_m[0]
    share = np.clip((points_m - thumb) @ across / max(across @ across, 1e-12), 0, 1)
    away = np.linalg.norm(points_m - thumb - share[:, None] * across, axis=1)
    nearest = float(away.min(initial=np.inf))
    if nearest > reach_m:
        return np.zeros(0, int)
    seeds = np.flatnonzero(away <= nearest + 0.005)
    return seeds[np.argsort(np.abs(share[seeds] - 0.5), kind="stable")]
