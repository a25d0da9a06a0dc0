"""`egosim experiment update`: what the state knows after a thing was carried, against the truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.cli.simulate import backend
from egosim_jax.command import DONE
from egosim_jax.experiments.tables import print_table, summarize
from egosim_jax.progress import track
from egosim_jax.types import VideoSpec, check_counts

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.generator import Generator
    from egosim_jax.types import SceneState
    from egosim_jax.worlds.tabletop import TabletopClip

LARGE = VideoSpec(frames=17, height=480, width=832, fps=8)
"""The official size."""
CARRIED = ("carry", "stack")
MEASURES = {
    "accurate": ("accurate %", "{:.1f}"),
    "complete": ("complete %", "{:.1f}"),
    "ghost": ("ghost points %", "{:.2f}"),
    "background_mm": ("background mm", "{:.2f}"),
}
DEFINITIONS = {
    "accurate": "share of the carried thing's points within 1 cm of its true surface at its end",
    "complete": "share of its true surface that any frame shows, which has one of its points "
    "within 1 cm",
    "ghost": "percentage of its points from before, off its new surface, that are still there",
    "background_mm": "95th percentile of the distances between nearest points of the background "
    "before and after, the larger of both ways, where it was seen before",
    "spread": "standard deviation over scenes (n - 1)",
}


@dataclass(frozen=True, kw_only=True)
class Update:
    """Carry a thing in held-out scenes, update the state, and compare it with the truth.

    A row each for the oracle at 832 x 480 and at the model's size, and for classical perception of
    the true and of the generated frames. Prints a table and writes report.json.
    """

    out: Path
    """Folder to write to."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights, if not those that come with the package."""
    scenes: int = 8
    """How many in which something is carried."""
    first_scene: int = 200
    """Seed of the first; the shipped model was trained on those from 1000 on."""

    def run(self) -> int:
        """Carry, update, compare."""
        from egosim_jax import configs
        from egosim_jax.generator import Generator
        from egosim_jax.io.run import open_folder, write_json
        from egosim_jax.io.weights import hashes

        check_counts({"--scenes": self.scenes})
        config = configs.get(self.config)
        weights = configs.weights_of(self.config, self.weights)
        made_of = {"experiment": self, "weights": hashes(weights)}
        open_folder(self.out, made_of, mutable=["experiment.weights"])
        generator = Generator.load(config, weights)
        table: dict[str, list[dict[str, float]]] = {}
        for seed in track(self._seeds(config.video), "scenes", total=self.scenes):
            for row, found in _rows(seed, config.video, generator):
                table.setdefault(row, []).append(found)
        summary = {row: summarize(found, MEASURES) for row, found in table.items()}
        write_json(self.out / "report.json", {"definitions": DEFINITIONS, "table": summary})
        print_table("state after", summary, MEASURES)
        return DONE

    def _seeds(self, spec: VideoSpec) -> Iterator[int]:
        """Of the first scenes in which something is carried."""
        from dataclasses import replace
        from itertools import count, islice

        from egosim_jax.worlds.tabletop import make_sequence

        small = replace(spec, frames=1, height=16, width=16)  # what happens is the same at any size
        clips = (next(make_sequence(seed, spec=small)) for seed in count(self.first_scene))
        yield from islice((clip.seed for clip in clips if clip.verb in CARRIED), self.scenes)


def _rows(
    seed: int, spec: VideoSpec, generator: Generator
) -> Iterator[tuple[str, dict[str, float]]]:
    """The name and the figures of each row for one scene."""
    from egosim_jax.rendering.reference import render
    from egosim_jax.worlds.tabletop import make_sequence, to_action

    large = next(make_sequence(seed, spec=LARGE))
    yield f"oracle, {LARGE.width} x {LARGE.height}", judge(large, large.frames, "oracle")
    clip = next(make_sequence(seed, spec=spec))
    view = render(clip.state, clip.cameras, point_px=2)
    generated = generator(view, to_action(clip), clip.first.colors, seed)
    yield f"oracle, {spec.width} x {spec.height}", judge(clip, clip.frames, "oracle")
    yield "classical, true frames", judge(clip, clip.frames, "classical")
    yield "classical, generated frames", judge(clip, generated, "classical")


def judge(clip: TabletopClip, frames: np.ndarray, perception: str) -> dict[str, float]:
    """How well the state is after these frames of a clip were perceived and fused."""
    from egosim_jax.geometry import transform
    from egosim_jax.metrics.update import object_accuracy, symmetric_distance
    from egosim_jax.state.fuse import fuse
    from egosim_jax.types import Clip
    from egosim_jax.worlds.tabletop import to_action

    perceive = backend(perception, [clip])
    before = clip.state
    perceived = perceive(Clip(frames=frames, fps=LARGE.fps), to_action(clip), before)
    after = fuse(before, perceived)
    number, path = clip.body_ids[clip.target], clip.world_from_body[clip.target]
    part = clip.parts[clip.target]
    found = object_accuracy(
        *(state.points_m[state.object_ids == number] for state in (before, after)),
        surface=(transform(path[-1], part.vertices_m), part.triangles),
        seen_m=_seen(clip, number, path),
    )
    known = before.points_m[before.object_ids == 0]
    background = _seen_before(clip, after)
    return {**asdict(found), "background_mm": 1000 * symmetric_distance(known, background)}


def _seen(clip: TabletopClip, number: int, path: np.ndarray) -> np.ndarray:
    """The points of a thing that any frame shows, where they are at the end."""
    import numpy as np

    from egosim_jax.geometry import invert, pixel_rays, transform

    cameras = clip.cameras
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    seen = []
    for frame, pose in enumerate(cameras.world_from_camera):
        here = clip.ids[frame] == number
        local = rays[here] * clip.depth_m[frame][here][:, None]
        seen.append(transform(path[-1] @ invert(path[frame]) @ pose, local))
    return np.concatenate(seen)


def _seen_before(clip: TabletopClip, after: SceneState) -> np.ndarray:
    """The background points of a state that the clip's first camera saw before it.

    A point may be hidden behind others of the background that are nearer by less than 1 cm.
    """
    import numpy as np

    from egosim_jax.geometry import invert, pixels_of, transform
    from egosim_jax.metrics.update import ON_SURFACE_M

    cameras, first = clip.cameras, clip.first
    points = after.points_m[after.object_ids == 0]
    local = transform(invert(cameras.world_from_camera[0]), points.astype(float))
    row, column, inside = pixels_of(cameras, local)
    bare = np.where(np.isin(first.ids, list(clip.state.names)), np.inf, first.depth_m)
    return points[inside & (np.abs(bare[row, column] - local[:, 2]) <= ON_SURFACE_M)]
