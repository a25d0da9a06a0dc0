"""Regions of an RGB-D image that are one object each.

Pixels are cut where the depth jumps, and then by color (Felzenszwalb and Huttenlocher, 2004).
Neighboring regions are joined by the sum of the evidence of their borders. A concave border between
two colors is evidence of two objects; any other border is of one: a label continues the surface of
its bottle. Separate pieces of one color are joined if they are close: a cup and its handle.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from egosim_jax.types.arrays import DepthMap, Mask

WEAK = 0.25
"""Evidence of a border that is smooth or has one color, but not both, relative to a sure one."""
LIGHTNESS = 0.5
"""Weight of a difference in lightness, which shading changes, relative to hue."""


@dataclass(frozen=True, kw_only=True)
class RegionConfig:
    """Thresholds of the division into regions."""

    color_scale: float = 60.0
    """Preference for large regions (k of the algorithm), in CIELAB times pixels of 160 a row."""
    steepness: float = 4.0
    """Step of the depth that is a jump, in widths of a pixel's footprint."""
    min_jump_m: float = 0.006
    """Minimum step of the depth that is a jump, in meters."""
    min_pixels: float = 12.0
    """Size below which a region joins its most similar neighbor, in pixels of 160 a row."""
    concavity: float = 0.25
    """Minimum sine of the bend of a concave border."""
    color_difference: float = 8.0
    """Minimum difference between the colors of two objects, in units of CIELAB."""
    gap_m: float = 0.012
    """Maximum distance of a small piece from its object, in meters; 3/4 of it for a large one."""
    piece: float = 0.25
    """Maximum size of a small piece, as a fraction of its object's."""
    sliver_m: float = 0.06
    """Maximum distance of a sliver from the object next to it in the image, in meters."""


class _Sets:
    """Disjoint sets of integers (union-find)."""

    def __init__(self, count: int) -> None:
        self.parent = list(range(count))

    def find(self, item: int) -> int:
        """Return the representative of an item's set."""
        parent = self.parent
        while parent[item] != item:
            parent[item] = parent[parent[item]]
            item = parent[item]
        return item

    def labels(self) -> Int[np.ndarray, " n"]:
        """Return the representative of every item."""
        return np.array([self.find(item) for item in range(len(self.parent))], int)


def find_regions(
    points: Float[np.ndarray, "h w 3"],
    lab: Float32[np.ndarray, "h w 3"],
    candidates: Mask,
    footprint_m: Float[np.ndarray, "h w"],
    config: RegionConfig,
) -> Int32[np.ndarray, "h w"]:
    """Return the region of each candidate pixel, from 1; 0 elsewhere."""
    color = lab * np.array([LIGHTNESS, 1, 1], np.float32)
    finer = (max(candidates.shape) / 160) ** 2
    config = replace(
        config,
        color_scale=config.color_scale * finer,
        min_pixels=config.min_pixels * finer,
    )
    pairs = _neighbors(points[..., 2], candidates, footprint_m, config)
    parts = _by_color(color.reshape(-1, 3), candidates.ravel(), pairs, config)
    parts = _join_surfaces(parts, points, color, pairs, config)
    parts = _join_pieces(parts, points, color, config)
    return _compact(parts).reshape(candidates.shape)


def _compact(parts: Int[np.ndarray, " n"]) -> Int32[np.ndarray, " n"]:
    """Renumber parts from 1; -1, no candidate, becomes 0."""
    numbers, compact = np.unique(parts, return_inverse=True)
    return (compact + (1 if numbers[0] >= 0 else 0)).astype(np.int32)


def _neighbors(
    depth_m: DepthMap, candidates: Mask, footprint_m: Float[np.ndarray, "h w"], config: RegionConfig
) -> Int[np.ndarray, "e 2"]:
    """Return the pairs of adjacent candidates without a jump of depth, as flat indices."""
    index = np.arange(depth_m.size).reshape(depth_m.shape)
    limit = np.maximum(config.min_jump_m, config.steepness * footprint_m)
    pairs = []
    for axis in (0, 1):
        one, other = (
            tuple(slice(*cut) if a == axis else slice(None) for a in (0, 1))
            for cut in ((0, -1), (1, None))
        )
        near = np.abs(depth_m[one] - depth_m[other]) <= np.minimum(limit[one], limit[other])
        near &= candidates[one] & candidates[other]
        pairs.append(np.stack([index[one][near], index[other][near]], axis=1))
    return np.concatenate(pairs)


def _by_color(
    color: Float32[np.ndarray, "n 3"],
    candidates: Bool[np.ndarray, " n"],
    pairs: Int[np.ndarray, "e 2"],
    config: RegionConfig,
) -> Int[np.ndarray, " n"]:
    """Return the part of every pixel by color, -1 where there is no candidate."""
    weights = np.linalg.norm(color[pairs[:, 0]] - color[pairs[:, 1]], axis=1)
    order = np.argsort(weights, kind="stable")
    alike_first = pairs[order].tolist()
    sets, size = _Sets(len(color)), [1] * len(color)
    limit = [config.color_scale] * len(color)
    for (one, other), weight in zip(alike_first, weights[order].tolist(), strict=True):
        a, b = sets.find(one), sets.find(other)
        if a != b and weight <= min(limit[a], limit[b]):
            sets.parent[b] = a
            size[a] += size[b]
            limit[a] = weight + config.color_scale / size[a]
    _absorb_small(sets, size, alike_first, config.min_pixels)
    return np.where(candidates, sets.labels(), -1)


def _absorb_small(
    sets: _Sets, size: list[int], alike_first: list[list[int]], min_pixels: float
) -> None:
    """Join each small set with its neighbor of the most similar pixels.

    `alike_first` are the pairs of neighboring pixels, by the difference of their colors. Pixels at
    a border of two colors mix both, and would connect two objects.
    """
    for one, other in alike_first:
        a, b = sets.find(one), sets.find(other)
        if a != b and min(size[a], size[b]) < min_pixels:
            sets.parent[b] = a
            size[a] += size[b]


def _join_surfaces(
    parts: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "h w 3"],
    color: Float32[np.ndarray, "h w 3"],
    pairs: Int[np.ndarray, "e 2"],
    config: RegionConfig,
) -> Int[np.ndarray, " n"]:
    """Join neighboring parts by the bend of their borders and the contrast of their colors."""
    height, width = points.shape[:2]
    reach = max(1, round(max(height, width) / 160))
    normals = _normals(points, parts.reshape(height, width), reach).reshape(-1, 3)
    flat, colors = points.reshape(-1, 3), color.reshape(-1, 3)
    border = pairs[parts[pairs[:, 0]] != parts[pairs[:, 1]]]
    if not len(border):
        return parts
    one, other = _inward(border, parts, width, reach)
    apart = flat[one] - flat[other]
    apart /= np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-9)
    convex = np.nan_to_num(((normals[one] - normals[other]) * apart).sum(axis=1))
    differ = np.linalg.norm(colors[one] - colors[other], axis=1)
    keys = np.sort(np.stack([parts[border[:, 0]], parts[border[:, 1]]], axis=1), axis=1)
    names, inverse = np.unique(keys, axis=0, return_inverse=True)
    weights = {}
    for number, (a, b) in enumerate(names.tolist()):
        here = inverse.ravel() == number
        bend, contrast = float(np.median(convex[here])), float(np.median(differ[here]))
        weights[a, b] = int(here.sum()) * _score(bend, contrast, config)
    joined = _contract(weights)
    return np.array([joined.get(part, part) for part in parts.tolist()], int)


def _score(bend: float, contrast: float, config: RegionConfig) -> float:
    """Return the evidence of a border, per pixel, that both sides are one object."""
    same = contrast <= config.color_difference
    if bend < -config.concavity:
        return WEAK if same else -1.0
    return 1.0 if same or bend > config.concavity else WEAK


def _contract(weights: dict[tuple[int, int], float]) -> dict[int, int]:
    """Return the group of each part, by greedy additive edge contraction (Keuper et al., 2015).

    The pair with the largest weight is joined, and the weights of its neighbors are added, until no
    positive weight is left.
    """
    near: dict[int, dict[int, float]] = {}
    for (one, other), weight in weights.items():
        near.setdefault(one, {})[other] = weight
        near.setdefault(other, {})[one] = weight
    group = {number: number for number in near}
    while near:
        weight, one, other = max(
            ((w, a, b) for a, row in near.items() for b, w in row.items() if a < b),
            default=(0.0, 0, 0),
        )
        if weight <= 0:
            break
        for number, now in group.items():
            group[number] = one if now == other else now
        for third, more in near.pop(other).items():
            near[third].pop(other)
            if third != one:
                near[one][third] = near[third][one] = near[one].get(third, 0.0) + more
    return group


def _inward(
    border: Int[np.ndarray, "e 2"], parts: Int[np.ndarray, " n"], width: int, reach: int
) -> tuple[Int[np.ndarray, " e"], Int[np.ndarray, " e"]]:
    """Return pixels of both sides of a border, `reach` pixels into their parts where they can."""
    groups = []
    for side, away in ((0, 1), (1, 0)):
        start = border[:, side]
        step = start - border[:, away]
        best = start
        for distance in range(1, reach + 1):
            moved = start + distance * step
            ok = (moved >= 0) & (moved < len(parts))
            # A horizontal step must stay in its row.
            ok &= (np.abs(step) != 1) | (moved // width == start // width)
            ok[ok] &= parts[moved[ok]] == parts[start[ok]]
            best = np.where(ok, moved, best)
        groups.append(best)
    return groups[0], groups[1]


def _normals(
    points: Float[np.ndarray, "h w 3"], parts: Int[np.ndarray, "h w"], reach: int
) -> Float[np.ndarray, "h w 3"]:
    """Return unit normals towards the camera, from pixels of the same part; NaN if unknown."""
    axes = []
    for axis in (1, 0):
        slope = np.full(points.shape, np.nan)
        for distance in range(1, reach + 1):
            ahead, behind = (np.roll(points, shift * distance, axis) for shift in (-1, 1))
            same_ahead, same_behind = (
                np.roll(parts, shift * distance, axis) == parts for shift in (-1, 1)
            )
            edge = np.arange(parts.shape[axis])
            shape = (1, -1) if axis == 1 else (-1, 1)
            same_ahead &= (edge < len(edge) - distance).reshape(shape)
            same_behind &= (edge >= distance).reshape(shape)
            slope = np.where(same_ahead[..., None], (ahead - points) / distance, slope)
            slope = np.where(same_behind[..., None], (points - behind) / distance, slope)
            both = same_ahead & same_behind
            slope = np.where(both[..., None], (ahead - behind) / (2 * distance), slope)
        axes.append(slope)
    normal = np.cross(axes[1], axes[0])
    normal /= np.maximum(np.linalg.norm(normal, axis=2, keepdims=True), 1e-12)
    away = (normal * points).sum(axis=2, keepdims=True) > 0
    return np.where(away, -normal, normal)


def _join_pieces(
    parts: Int[np.ndarray, " n"],
    points: Float[np.ndarray, "h w 3"],
    color: Float32[np.ndarray, "h w 3"],
    config: RegionConfig,
) -> Int[np.ndarray, " n"]:
    """Join each separate part with the closest larger part of the same hue.

    A sliver, such as the side of a box that is seen at a grazing angle, has no reliable color.
    """
    import cv2
    from scipy.spatial import KDTree

    height, width = points.shape[:2]
    kernel = np.ones((3, 3), np.uint8)
    flat, hues = points.reshape(-1, 3), (color * np.array([0.4, 1, 1])).reshape(-1, 3)
    numbers, counts = np.unique(parts[parts >= 0], return_counts=True)
    order = numbers[np.argsort(-counts, kind="stable")].tolist()
    sizes = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
    parts, kept = parts.copy(), []
    for number in order:
        members = np.flatnonzero(parts == number)
        hue = np.median(hues[members], axis=0)
        mask = (parts == number).reshape(height, width).astype(np.uint8)
        sliver = not cv2.erode(mask, kernel, borderValue=0).any()
        nearby = set(np.unique(parts[cv2.dilate(mask, kernel, iterations=2).ravel() > 0]).tolist())
        best = (np.inf, -1)
        for other, tree, other_hue in kept:
            small = sizes[number] <= config.piece * sizes[other]
            limit = config.gap_m * (1.0 if small else 0.75)
            if sliver and other in nearby:
                limit = config.sliver_m
            elif np.linalg.norm(hue - other_hue) > config.color_difference:
                continue
            gap = float(tree.query(flat[members])[0].min())
            if gap <= limit:
                best = min(best, (gap, other))
        if best[1] >= 0:
            parts[members] = best[1]
        else:
            kept.append((number, KDTree(flat[members]), hue))
    return parts
