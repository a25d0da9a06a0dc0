"""`egosim experiment update`: accuracy of the scene state after an object was carried."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice

import numpy as np

from egosim_jax.evaluation.metrics.report import print_table
from egosim_jax.evaluation.metrics.state_update import (
    ON_SURFACE_M,
    object_accuracy,
    symmetric_distance,
)
from egosim_jax.experiments.config import Ids, Update
from egosim_jax.experiments.report import summaries, write_report
from egosim_jax.generation.generator import Generator
from egosim_jax.geometry import invert, pixel_rays, pixels_of, transform
from egosim_jax.perception import registry
from egosim_jax.rendering.reference import render
from egosim_jax.runtime.progress import track
from egosim_jax.state.fuse import fuse
from egosim_jax.state.new_objects import is_among, without_ids
from egosim_jax.types import Clip, SceneState, VideoSpec
from egosim_jax.worlds.tabletop import TabletopClip, make_sequence, observation_of, to_action

LARGE = VideoSpec(frames=17, height=480, width=832, fps=8)
"""Clips at EgoSim's size."""
CARRIED = ("carry", "stack")
"""Actions that carry an object."""
MEASURES = {
    "accuracy": ("accuracy %", "{:.1f}"),
    "completeness": ("completeness %", "{:.1f}"),
    "ghost": ("ghost points %", "{:.2f}"),
    "background_mm": ("background mm", "{:.2f}"),
}
DEFINITIONS = {
    "accuracy": "share of the carried object's points within 1 cm of its final ground-truth "
    "surface",
    "completeness": "share of that surface, where any frame shows it, with a point of the object "
    "within 1 cm",
    "ghost": "share of the object's earlier points off that surface that are still present",
    "background_mm": "95th percentile of the distances between nearest points of the background "
    "before and after, the larger of both directions, where it was seen before",
    "gray frames": "one gray: what the action alone says",
    "spread": "standard deviation over scenes (n - 1)",
}


def run(settings: Update) -> None:
    """Carry an object in every scene, update the state and compare it with the true scene."""
    registry.parse(settings.perception)  # raises for an unknown one before any work
    generator = settings.open()
    table: dict[str, list[dict[str, float]]] = {}
    for seed in track(_seeds(settings, generator.config.video), "scenes", total=settings.scenes):
        for row, scores in _rows(seed, generator, settings.perception, settings.ids):
            table.setdefault(row, []).append(scores)
    summary = summaries(table, MEASURES)
    write_report(settings.out, definitions=DEFINITIONS, table=summary)
    print_table("state after", summary, MEASURES)


def _seeds(settings: Update, spec: VideoSpec) -> Iterator[int]:
    """Yield the seeds of the first scenes with a carried object."""
    small = replace(spec, frames=1, height=16, width=16)  # the events are the same at any size
    clips = (next(make_sequence(seed, spec=small)) for seed in count(settings.first_scene))
    yield from islice((clip.seed for clip in clips if clip.verb in CARRIED), settings.scenes)


def _rows(
    seed: int, generator: Generator, perception: str, ids: Ids
) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield the name and the scores of each table row for one scene."""
    large, spec = next(make_sequence(seed, spec=LARGE)), generator.config.video
    yield f"oracle, {LARGE.width} x {LARGE.height}", evaluate(large, large.frames, "oracle")
    clip = next(make_sequence(seed, spec=spec))
    view = render(clip.state, clip.cameras, point_px=generator.point_px)
    generated = generator(view, to_action(clip), clip.first.colors, seed)
    yield f"oracle, {spec.width} x {spec.height}", evaluate(clip, clip.frames, "oracle")
    frames = {
        "ground-truth": clip.frames,
        "generated": generated,
        "gray": np.full_like(clip.frames, 127),
    }
    for kind, video in frames.items():
        yield f"{perception}, {kind} frames", evaluate(clip, video, perception, ids)


def evaluate(
    clip: TabletopClip, frames: np.ndarray, perception: str, ids: Ids = "given"
) -> dict[str, float]:
    """Return the scores of the state after perceiving and fusing the frames of a clip."""
    perceive = registry.parse(perception).build({clip.number: observation_of(clip)})
    before = clip.state
    given = before if ids == "given" else without_ids(before)
    perceived = perceive(Clip(frames=frames, fps=LARGE.fps), to_action(clip), given)
    after = fuse(given, perceived)
    number, path = clip.body_ids[clip.target], clip.world_from_body[clip.target]
    body = clip.parts[clip.target]
    points_m = before.points_m[before.object_ids == number]
    numbers = [number]
    if ids == "none":
        new = perceived.new_objects
        numbers = [n for n, points in new.items() if is_among(points, points_m).any()]
    still = (after.object_ids == 0) & is_among(after.points_m, points_m)
    background = before.points_m[before.object_ids == 0]
    rest = symmetric_distance(background, _background_seen_before(clip, after))
    carried = object_accuracy(
        points_m,
        after.points_m[still | np.isin(after.object_ids, numbers)],
        surface=(transform(path[-1], body.vertices_m), body.triangles),
        seen_m=_visible_surface(clip, number, path),
    )
    return {**carried, "background_mm": 1000 * rest}


def _visible_surface(clip: TabletopClip, number: int, path: np.ndarray) -> np.ndarray:
    """Return the surface points of a body visible in any frame, at its final pose."""
    cameras = clip.cameras
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    seen = []
    for frame, pose in enumerate(cameras.world_from_camera):
        here = clip.ids[frame] == number
        local = rays[here] * clip.depth_m[frame][here][:, None]
        seen.append(transform(path[-1] @ invert(path[frame]) @ pose, local))
    return np.concatenate(seen)


def _background_seen_before(clip: TabletopClip, after: SceneState) -> np.ndarray:
    """Return the background points of a state that the clip's first camera sees.

    A point still counts as seen if other background is nearer by less than 1 cm.
    """
    cameras, first = clip.cameras, clip.first
    points = after.points_m[after.object_ids == 0]
    local = transform(invert(cameras.world_from_camera[0]), points.astype(float))
    row, column, inside = pixels_of(cameras, local)
    bare = np.where(np.isin(first.ids, list(clip.state.names)), np.inf, first.depth_m)
    return points[inside & (np.abs(bare[row, column] - local[:, 2]) <= ON_SURFACE_M)]
