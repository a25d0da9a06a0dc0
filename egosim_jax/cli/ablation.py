"""`egosim experiment tabletop`: what each condition is worth, on scenes that were held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from egosim_jax.cli.spread import mean_and_spread
from egosim_jax.command import DONE
from egosim_jax.data.sheet import Block, draw_sheet
from egosim_jax.progress import track
from egosim_jax.types import check_counts

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.generator import Generator
    from egosim_jax.types import Kind, Triplet, VideoSpec
    from egosim_jax.worlds.tabletop import TabletopClip

Hidden = Literal["prior", "mask", "hands"]
Summary = dict[str, float]
Table = dict[str, dict[str, Summary]]
METHODS: tuple[tuple[str, Hidden | None], ...] = (
    ("full", None),
    ("without prior", "prior"),
    ("without mask", "mask"),
    ("without hands", "hands"),
)
MEASURES = {
    "psnr": ("PSNR dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "region_psnr": ("region PSNR dB", "{:.2f}"),
    "hand_iou": ("hand IoU", "{:.3f}"),
    "object_error": ("object error %", "{:.2f}"),
}
DEFINITIONS = {
    "psnr, ssim": "as in evaluate, frames 1 to the last",
    "region_psnr": "dB over the pixels where the truth shows a hand or the thing acted on, all "
    "frames of a clip together",
    "hand_iou": "silhouette of hands and arms, read off by colour and opened by 3 x 3, against the "
    "true ids; mean over frames",
    "object_error": "distance between the centroids of the thing acted on, read off by colour, and "
    "its true one, in percent of the width; mean over the frames in which it is seen",
    "spread": "standard deviation over scenes, each a mean over seeds; and over seeds, each a mean "
    "over scenes (n - 1)",
}
SHEET_SCENES, SHEET_MOMENTS = 4, (0, 3, 6, 9, 12, 16)


@dataclass(frozen=True, kw_only=True)
class Tabletop:
    """Generate held-out tabletop scenes with all conditions and without each, and compare.

    Prints a table for people's hands and one for robots', beside the prior copied, the first frame
    repeated and the truth through the autoencoder. Writes report.json and a contact sheet of each.
    """

    out: Path
    """Folder to write to."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights, if not those that come with the package."""
    scenes: int = 24
    """Scenes of each kind."""
    first_scene: int = 100
    """Seed of the first scene; the shipped model was trained on those from 1000 on."""
    seeds: int = 2
    """Times that each clip is generated, from different noise."""
    batch_size: int = 8
    """Clips generated together."""

    def run(self) -> int:
        """Make the scenes, generate, compare, draw."""
        from egosim_jax import configs
        from egosim_jax.generator import Generator, Networks
        from egosim_jax.io.run import open_folder, write_json
        from egosim_jax.io.weights import hashes

        check_counts(
            {"--scenes": self.scenes, "--seeds": self.seeds, "--batch-size": self.batch_size}
        )
        config = configs.get(self.config)
        weights = configs.weights_of(self.config, self.weights)
        open_folder(self.out, {"experiment": self, "weights": hashes(weights)})
        generator = Generator(config.at(weights), Networks.load(config, weights))
        kinds: tuple[Kind, ...] = ("human", "robot")
        tables = {kind: self._compare(kind, generator) for kind in kinds}
        write_json(self.out / "report.json", {"definitions": DEFINITIONS, "tables": tables})
        for kind, table in tables.items():
            _print(kind, table)
        return DONE

    def _compare(self, kind: Kind, generator: Generator) -> Table:
        """Scores of every method on the scenes of one kind of hands, and their sheet."""
        spec = generator.config.video
        seeds = range(self.first_scene, self.first_scene + self.scenes)
        scenes = [
            _Scene.make(seed, spec, kind)
            for seed in track(seeds, f"making {kind} scenes", total=self.scenes)
        ]
        table: Table = {}
        shown: list[Block] = []
        for name, hidden in METHODS:
            runs = []
            for seed in track(range(self.seeds), f"{kind}, {name}", total=self.seeds):
                videos = self._generate(generator, scenes, hidden, seed)
                runs.append([s.judge(v) for s, v in zip(scenes, videos, strict=True)])
                if hidden is None and seed == 0:
                    shown = [s.block(v) for s, v in zip(scenes, videos, strict=True)]
            table[name] = summarise(runs)
        for name, videos in _baselines(generator, scenes, self.batch_size).items():
            table[name] = summarise([[s.judge(v) for s, v in zip(scenes, videos, strict=True)]])
        draw_sheet(
            shown[:SHEET_SCENES], self.out / f"contact_sheet_{kind}.png", moments=SHEET_MOMENTS
        )
        return table

    def _generate(
        self, generator: Generator, scenes: Sequence[_Scene], hidden: Hidden | None, seed: int
    ) -> list[np.ndarray]:
        """One video of every scene, from noise that differs by scene and seed."""
        from egosim_jax.generator import batches

        videos = []
        for some in batches(scenes, self.batch_size):
            noise = [1000 * seed + scene.clip.seed for scene in some]
            clips = generator.generate([scene.triplet for scene in some], noise, without=hidden)
            videos += [clip.frames for clip in clips]
        return videos


@dataclass(frozen=True)
class _Scene:
    """A held-out clip, its truth and its conditions."""

    clip: TabletopClip
    triplet: Triplet
    background: np.ndarray
    """The true frames without hands and without what they act on."""

    @classmethod
    def make(cls, seed: int, spec: VideoSpec, kind: Kind) -> _Scene:
        """The first clip of a seed."""
        from egosim_jax.worlds.tabletop import make_sequence, to_triplet

        clip = next(make_sequence(seed, spec=spec, kind=kind))
        bare = next(make_sequence(seed, spec=spec, kind=kind, bare=True))
        return cls(clip, to_triplet(clip), bare.frames)

    def judge(self, video: np.ndarray) -> dict[str, float]:
        """Every measure of a video of this scene."""
        import numpy as np

        from egosim_jax.metrics import region
        from egosim_jax.metrics.report import score
        from egosim_jax.worlds.tabletop.scene import FIRST_HAND

        truth, ids = self.clip.frames[1:], self.clip.ids[1:]
        target = self.clip.body_ids[self.clip.target]
        hands, thing = ids >= FIRST_HAND, ids == target
        movers = {n: c for n, c in self.clip.paints.items() if n == target or n >= FIRST_HAND}
        seen = region.label(video[1:], self.background[1:], movers)
        whole = score(video[1:], truth)
        errors = region.centroid_errors(seen == target, thing)
        return {
            "psnr": whole.psnr,
            "ssim": whole.ssim,
            "region_psnr": region.region_psnr(video[1:], truth, hands | thing),
            "hand_iou": region.silhouette_iou(region.opened(seen >= FIRST_HAND), hands),
            "object_error": 100 * float(np.mean(errors)) / ids.shape[2] if len(errors) else np.nan,
        }

    def block(self, video: np.ndarray) -> Block:
        """This scene on the contact sheet."""
        title = f"{self.triplet.video_id}: {self.clip.caption}   (prior, hands, generated, truth)"
        return Block(title, [self.triplet.prior, self.triplet.hands, video, self.clip.frames])


def _baselines(
    generator: Generator, scenes: Sequence[_Scene], batch_size: int
) -> dict[str, list[np.ndarray]]:
    """What can be had without a denoiser, and the best that any could give."""
    import numpy as np

    from egosim_jax.generator import batches

    triplets = [scene.triplet for scene in scenes]
    ceiling = [
        clip.frames
        for some in batches(triplets, batch_size)
        for clip in generator.reconstruct(some)
    ]
    truths = [scene.clip.frames for scene in scenes]
    return {
        "prior copied": [triplet.prior for triplet in triplets],
        "first frame repeated": [np.broadcast_to(truth[:1], truth.shape) for truth in truths],
        "truth through the autoencoder": ceiling,
        "truth": truths,
    }


def summarise(runs: Sequence[Sequence[Mapping[str, float]]]) -> dict[str, Summary]:
    """Mean and spreads of each measure; `runs` has a list of scenes for each seed.

    Where a measure is NaN, because there was nothing to measure, it does not count.
    """
    summaries = {}
    for name in MEASURES:
        by_seed = [[scene[name] for scene in run] for run in runs]
        scenes = [mean_and_spread(values)[0] for values in zip(*by_seed, strict=True)]
        mean, over_scenes = mean_and_spread(scenes)
        _, over_seeds = mean_and_spread([mean_and_spread(values)[0] for values in by_seed])
        summaries[name] = {"mean": mean, "over_scenes": over_scenes, "over_seeds": over_seeds}
    return summaries


def _print(kind: str, table: Table) -> None:
    from rich.console import Console
    from rich.table import Table as RichTable

    title = f"{kind}: mean ± spread over scenes (± over seeds)"
    shown = RichTable("", *(name for name, _ in MEASURES.values()), title=title)
    for method, summaries in table.items():
        cells = []
        for measure, (_, form) in MEASURES.items():
            value = summaries[measure]
            mean, scenes, seeds = (form.format(value[k]) for k in value)
            cells.append(f"{mean} ± {scenes} (± {seeds})")
        shown.add_row(method, *cells)
    Console(width=160).print(shown)
