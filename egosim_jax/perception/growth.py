"""Objects without an id: what a hand touches, grown over the connected surface of the state.

The points between the fingertips, or nearest to them, are the seeds. They grow over neighbors that
are not on the supporting plane. One object may touch another, so there are several growths, from
the whole connected surface to less: up to concave edges, up to other colors, up to any edge. The
clip decides between them (`object_motion`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from egosim_jax.geometry import UP_AXES, up_of
from egosim_jax.perception.grasps import Grip
from egosim_jax.perception.pose_refinement import ObjectModel
from egosim_jax.state.planes import support_planes
from egosim_jax.types import Cameras, SceneState

NEW = 0
"""Number of an object that has no id yet."""
NEIGHBORS = 16
"""Number of nearest points that determine a point's normal and its edges."""
MIN_PLANE_M = 0.002
"""Minimum height above the supporting plane at which a point is not on it, in meters."""


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
    """Height of neighbors above a point's tangent plane at a concave edge, per distance."""
    edge_deg: float = 25.0
    """Angle between the normals of neighbors at an edge, in degrees."""
    color_levels: float = 45.0
    """Difference in color, whatever the light, of points of different objects, in 8-bit levels."""
    min_points: int = 30
    """Minimum number of points of an object."""


@dataclass(frozen=True, kw_only=True)
class Surroundings:
    """Points without an id around a hand, and the plane that supports them."""

    points_m: Float32[np.ndarray, "n 3"]
    colors: Float32[np.ndarray, "n 3"]
    plane: Float[np.ndarray, " 4"]
    """Plane a x + b y + c z + d = 0, whose normal points to the side of the objects."""
    eye_m: Float[np.ndarray, " 3"]
    """Place of the camera, which sees the outside of the surfaces."""
    config: Growth

    @cached_property
    def heights_m(self) -> Float[np.ndarray, " n"]:
        """Heights above the plane in meters; infinite without a plane."""
        if np.isnan(self.plane[3]):
            return np.full(len(self.points_m), np.inf)
        return self.points_m @ self.plane[:3] + self.plane[3]

    @cached_property
    def raised(self) -> Bool[np.ndarray, " n"]:
        """Points above the plane by more than its points are apart from it."""
        near = np.abs(self.heights_m)
        inliers = near[near < 3 * MIN_PLANE_M]
        noise = 1.4826 * float(np.median(inliers)) if len(inliers) else 0.0
        return self.heights_m > max(MIN_PLANE_M, 3 * noise)

    @cached_property
    def neighbors(self) -> Int[np.ndarray, "n k"]:
        """Indices of the nearest points of each point, itself first."""
        from scipy.spatial import KDTree

        count = min(NEIGHBORS, len(self.points_m))
        return KDTree(self.points_m).query(self.points_m, count)[1].reshape(-1, count)

    @cached_property
    def radius_m(self) -> float:
        """Maximum distance of connected points in meters."""
        gaps = self.points_m[self.neighbors[:, 1]] - self.points_m
        return self.config.spacings * float(np.median(np.linalg.norm(gaps, axis=1)))

    @cached_property
    def normals(self) -> Float[np.ndarray, "n 3"]:
        """Outward unit normals of the surfaces."""
        around = self.points_m[self.neighbors].astype(float)
        around -= around.mean(axis=1, keepdims=True)
        normals = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))[1][:, :, 0]
        inward = ((self.eye_m - self.points_m) * normals).sum(axis=1) < 0
        return np.where(inward[:, None], -normals, normals)

    @cached_property
    def hollow(self) -> Bool[np.ndarray, " n"]:
        """Points at a concave edge: the points around them are above their tangent planes."""
        steps = self.points_m[self.neighbors[:, 1:]] - self.points_m[:, None]
        rise = np.einsum("nki,ni->nk", steps, self.normals).mean(axis=1)
        return rise > self.config.concave * np.linalg.norm(steps, axis=2).mean(axis=1)

    @cached_property
    def pairs(self) -> Int[np.ndarray, "p 2"]:
        """Pairs of connected points above the plane."""
        from scipy.spatial import KDTree

        (own,) = np.nonzero(self.raised)
        if not len(own):
            return np.zeros((0, 2), int)
        tree = KDTree(self.points_m[own])
        return own[tree.query_pairs(self.radius_m, output_type="ndarray")]

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

    def touched(
        self, grips: Sequence[Float[np.ndarray, "j 3"]]
    ) -> tuple[list[list[Bool[np.ndarray, " n"]]], str]:
        """Return the growths of each thing that one of the grips touches, and a note.

        A grip is the places of the fingertips. The note says why there is no growth.
        """
        parts = self.parts(self.raised)
        things: dict[int, list[Bool[np.ndarray, " n"]]] = {}
        notes = ["closed on nothing"]
        for tips in grips:
            seeds = seeds_between(self.points_m, self.raised, tips, self.config.reach_m)
            if not len(seeds):
                flat = seeds_between(self.points_m, ~self.raised, tips, self.config.reach_m / 2)
                if len(flat):
                    notes.append("closed on something that cannot be told from its support")
                continue
            part = int(np.bincount(parts[seeds]).argmax())
            if part in things:
                continue
            growths = list(self.grow(seeds))
            things[part] = [
                self.skirt(members)
                for members in growths
                if self.extent_m(members) <= self.config.max_extent_m
            ]
            if not growths:
                notes.append("closed on too few points to be an object")
            elif not things[part]:
                notes.append(
                    f"closed on something without an id that is larger than "
                    f"{self.config.max_extent_m} m: it was not moved"
                )
        found = [growths for growths in things.values() if growths]
        return found, "" if found else notes[-1]

    def grow(self, seeds: Int[np.ndarray, " s"]) -> Iterator[Bool[np.ndarray, " n"]]:
        """Yield the points of the possible objects around the seeds, the largest first."""
        whole = self._around(seeds, self.parts(self.raised))
        convex = self._fill(self._around(seeds, self.parts(whole & ~self.hollow)), whole)
        alike = self._alike(seeds)
        one, other = self.pairs.T
        bent = (self.normals[one] * self.normals[other]).sum(axis=1)
        sharp = bent < np.cos(np.radians(self.config.edge_deg))
        face = self._around(seeds, self.parts(whole & ~self.hollow, sharp))
        same = self._around(seeds, self.parts(whole & alike))
        found: list[Bool[np.ndarray, " n"]] = []
        for members in (whole, convex, same, self._around(seeds, self.parts(convex & alike)), face):
            if members.sum() < self.config.min_points:
                continue
            if any((members & old).sum() > 0.95 * (members | old).sum() for old in found):
                continue
            found.append(members)
            yield members

    def extent_m(self, members: Bool[np.ndarray, " n"]) -> float:
        """Return the longest side of the box around some points in meters."""
        return float(np.ptp(self.points_m[members], axis=0).max())

    def skirt(self, members: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
        """Return an object's points with its lowest ones, which are near the plane.

        They are next to the object, and look like it or stand upright as the plane does not.
        """
        from scipy.spatial import KDTree

        low = ~self.raised & (self.heights_m > -MIN_PLANE_M)
        (candidates,) = np.nonzero(low)
        if not len(candidates):
            return members
        gaps, nearest = KDTree(self.points_m[members]).query(
            self.points_m[candidates], distance_upper_bound=2 * self.radius_m
        )
        candidates, nearest = candidates[np.isfinite(gaps)], nearest[np.isfinite(gaps)]
        ground = np.median(self.colors[low], axis=0)
        like_object = np.linalg.norm(
            self.colors[candidates] - self.colors[members][nearest], axis=1
        )
        like_ground = np.linalg.norm(self.colors[candidates] - ground, axis=1)
        grown = members.copy()
        grown[candidates[like_object < like_ground]] = True
        return grown

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

    def _alike(self, seeds: Int[np.ndarray, " s"]) -> Bool[np.ndarray, " n"]:
        """Return the points in the color of the seeds under any light."""
        own = np.median(self.colors[seeds], axis=0)
        light = (self.colors @ own) / max(float(own @ own), 1.0)
        return np.linalg.norm(self.colors - light[:, None] * own, axis=1) < self.config.color_levels


def things_without_id(
    grip: Grip, cameras: Cameras, state: SceneState, config: Growth
) -> tuple[list[list[ObjectModel]], str]:
    """Return the growths of each thing without an id that a hand touches, and a note.

    The note says why a hand that surely held something has no growth.
    """
    pinches = grip.tips_m[grip.grasps].mean(axis=1)
    free = np.flatnonzero(state.object_ids == 0)
    gaps = [np.linalg.norm(state.points_m[free] - pinch, axis=1) for pinch in pinches]
    free = free[np.min(gaps, axis=0) <= config.max_extent_m]
    if len(free) < config.min_points:
        return [], "closed on nothing" if grip.sure else ""
    points, eye = state.points_m[free], cameras.world_from_camera[0, :3, 3]
    surfaces = support_planes(points, np.array(UP_AXES[up_of(state)]))
    around = Surroundings(
        points_m=points,
        colors=state.colors[free].astype(np.float32),
        plane=surfaces[0].plane if surfaces else np.array([*UP_AXES[up_of(state)], np.nan]),
        eye_m=eye,
        config=config,
    )
    found, note = around.touched([grip.tips_m[frame] for frame in grip.grasps])
    things = [
        [
            ObjectModel(
                number=NEW,
                points_m=points[members].astype(float),
                colors=around.colors[members],
                plane=around.plane,
            )
            for members in growths
        ]
        for growths in found
    ]
    return things, note if grip.sure else ""


def seeds_between(
    points_m: Float[np.ndarray, "n 3"],
    chosen: Bool[np.ndarray, " n"],
    tips_m: Float[np.ndarray, "j 3"],
    reach_m: float,
) -> Int[np.ndarray, " s"]:
    """Return the chosen points nearest to the line from the thumb to the fingers.

    Points within 5 mm more than the nearest one's distance count; none beyond `reach_m`.
    """
    thumb, fingers = tips_m[0], tips_m[1:].mean(axis=0)
    across = fingers - thumb
    share = np.clip((points_m - thumb) @ across / max(across @ across, 1e-12), 0, 1)
    away = np.linalg.norm(points_m - thumb - share[:, None] * across, axis=1)
    away = np.where(chosen, away, np.inf)
    nearest = float(away.min(initial=np.inf))
    if nearest > reach_m:
        return np.zeros(0, int)
    return np.flatnonzero(away <= nearest + 0.005)
