"""Held-out clips of the tabletop world, and the scores of videos of them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np

from egosim_jax.configs.model import ModelConfig
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.evaluation.metrics import lpips, region
from egosim_jax.evaluation.metrics.report import score
from egosim_jax.generation.encoding import batches
from egosim_jax.generation.generator import Generator
from egosim_jax.runtime.progress import track
from egosim_jax.types import Kind, Triplet, VideoSpec
from egosim_jax.worlds.tabletop import Script, TabletopClip, make_scripts, make_sequence, to_triplet
from egosim_jax.worlds.tabletop.clips import HandsName, PriorName
from egosim_jax.worlds.tabletop.dataset import conditions_of
from egosim_jax.worlds.tabletop.scene import FIRST_HAND

DroppedCondition = Literal["prior", "mask", "hands"]
Conditions = tuple[PriorName, HandsName]
"""Renderings of the scene and of the hands."""
MEASURES = {
    "psnr": ("PSNR dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    **lpips.MEASURE,
    "region_psnr": ("region PSNR dB", "{:.2f}"),
    "hand_iou": ("hand IoU", "{:.3f}"),
    "object_error": ("object error %", "{:.2f}"),
    "object_lost": ("object lost %", "{:.1f}"),
    "held_error": ("held: error", "{:.0f}"),
    "held_right": ("held: right %", "{:.0f}"),
    "released_error": ("released: error", "{:.0f}"),
    "released_right": ("released: right %", "{:.0f}"),
}
DEFINITIONS = {
    "psnr, ssim": "as in evaluate, frames 1 to the last",
    "lpips_alex": f"{lpips.DEFINITION}; frames 1 to the last",
    "region_psnr": "dB over the hand+object region of the ground truth, all frames of a clip "
    "together",
    "hand_iou": "silhouette of hands and arms, segmented by color and opened by 3 x 3, against the "
    "ground-truth ids; mean over frames",
    "object_error": "distance of the centroid of the manipulated object, segmented by color, from "
    "its ground truth, in percent of the width; mean over the frames in which it is visible",
    "object_lost": "frames without a pixel of its color, in percent of those that show it",
    "held_error, released_error": "mean squared error in 8-bit levels of the manipulated object's "
    "visible pixels, by the ground-truth ids, in the frames in which it moves, and after its last "
    "motion; the autoencoder's row is the limit",
    "held_right, released_right": "percent of these pixels within 30 levels of the ground truth",
}
SHEET_SCENES = 4
"""Number of scenes on a contact sheet."""
SHEET_MOMENTS = (0, 3, 6, 9, 12, 16)
"""Frames on a contact sheet."""


@dataclass(frozen=True)
class HeldOutClip:
    """A held-out clip with its ground truth and its conditions."""

    clip: TabletopClip
    """Clip of the world."""
    triplet: Triplet
    """Conditions and target in EgoSim's format."""
    background: np.ndarray
    """Ground-truth frames without hands and manipulated object, uint8 `f h w 3`."""

    @classmethod
    def make(
        cls,
        seed: int,
        config: ModelConfig,
        kind: Kind = "human",
        *,
        conditions: Conditions | None = None,
        **scene: Any,
    ) -> HeldOutClip:
        """Make the first clip of a scene, with the conditions of a model, or given ones.

        `scene` has other options of `make_sequence`.
        """
        first = partial(make_sequence, seed, spec=config.video, kind=kind, **scene)
        clip, bare = next(first()), next(first(bare=True))
        return cls(clip, triplet_of(clip, config, conditions), bare.frames)

    def evaluate(self, video: np.ndarray) -> dict[str, float]:
        """Return all measures of a video of this clip."""
        target, ids = self.clip.frames[1:], self.clip.ids[1:]
        number = self.clip.body_ids[self.clip.target]
        hands, body = ids >= FIRST_HAND, ids == number
        movers = {n: c for n, c in self.clip.paints.items() if n == number or n >= FIRST_HAND}
        seen = region.label(video[1:], self.background[1:], movers)
        errors = region.centroid_errors(seen == number, body)
        moving, after = region.held_and_released(self.clip.world_from_body[self.clip.target])
        held, released = (body & frames[1:, None, None] for frames in (moving, after))
        return {
            **score(video[1:], target),
            **lpips.score(video[1:], target),
            "region_psnr": region.region_psnr(video[1:], target, hands | body),
            "hand_iou": region.silhouette_iou(region.open_mask(seen >= FIRST_HAND), hands),
            "object_error": 100 * float(np.mean(errors)) / ids.shape[2] if len(errors) else np.nan,
            "object_lost": 100 * region.lost_share(seen == number, body),
            "held_error": region.squared_error(video[1:], target, held),
            "held_right": 100 * region.right_share(video[1:], target, held),
            "released_error": region.squared_error(video[1:], target, released),
            "released_right": 100 * region.right_share(video[1:], target, released),
        }

    def on_sheet(self, videos: Mapping[str, np.ndarray]) -> SheetClip:
        """Return the rows of a contact sheet: conditions, videos by name, and ground truth."""
        names = ", ".join(("prior", "hands", *videos, "ground truth"))
        return SheetClip(
            f"{self.triplet.video_id}: {self.clip.caption}   ({names})",
            [self.triplet.prior, self.triplet.hands, *videos.values(), self.clip.frames],
        )


def triplet_of(
    clip: TabletopClip, config: ModelConfig, conditions: Conditions | None = None
) -> Triplet:
    """Return a clip with the conditions of a model, or with given ones."""
    prior, hands = conditions or conditions_of(config)
    return to_triplet(clip, prior=prior, hands=hands, point_px=config.point_px)


def make_scenes(
    seeds: range, config: ModelConfig, kind: Kind = "human", *, title: str, **options: Any
) -> list[HeldOutClip]:
    """Make the first clips of scenes (`HeldOutClip.make`)."""
    tracked = track(seeds, f"making {title}", total=len(seeds))
    return [HeldOutClip.make(seed, config, kind, **options) for seed in tracked]


def carrying(first_scene: int, spec: VideoSpec) -> Iterator[tuple[int, Script]]:
    """Yield seed and first script of the scenes in which an object is carried."""
    for seed in count(first_scene):
        script = next(make_scripts(seed, spec=spec))
        if script.intent.verb == "carry":
            yield seed, script


def draw_scenes(
    path: Path, scenes: Sequence[HeldOutClip], videos: Mapping[str, Sequence[np.ndarray]]
) -> None:
    """Draw a contact sheet of the first scenes, with a row for each method."""
    clips = [
        scene.on_sheet({name: of[n] for name, of in videos.items()})
        for n, scene in enumerate(scenes[:SHEET_SCENES])
    ]
    draw_sheet(clips, path, moments=SHEET_MOMENTS)


def evaluate(scenes: Sequence[HeldOutClip], videos: Sequence[np.ndarray]) -> list[dict[str, float]]:
    """Return all measures of one video per scene."""
    return [scene.evaluate(video) for scene, video in zip(scenes, videos, strict=True)]


def generate(
    generator: Generator,
    scenes: Sequence[HeldOutClip],
    *,
    batch_size: int,
    seed: int = 0,
    without: DroppedCondition | None = None,
) -> Iterator[np.ndarray]:
    """Generate a video of every scene, with noise that depends on scene and seed."""
    for batch in batches(scenes, batch_size):
        noise = [1000 * seed + scene.clip.seed for scene in batch]
        clips = generator.generate([scene.triplet for scene in batch], noise, without=without)
        yield from (clip.frames for clip in clips)


def reconstruct(
    generator: Generator, scenes: Sequence[HeldOutClip], *, batch_size: int
) -> Iterator[np.ndarray]:
    """Reconstruct every scene by the autoencoder: an upper bound for any denoiser."""
    for batch in batches(scenes, batch_size):
        clips = generator.reconstruct([scene.triplet for scene in batch])
        yield from (clip.frames for clip in clips)


def baselines(scenes: Sequence[HeldOutClip]) -> dict[str, list[np.ndarray]]:
    """Return the videos of the baselines without a model."""
    targets = [scene.clip.frames for scene in scenes]
    return {
        "prior copied": [scene.triplet.prior for scene in scenes],
        "first frame repeated": [np.broadcast_to(x[:1], x.shape) for x in targets],
    }
