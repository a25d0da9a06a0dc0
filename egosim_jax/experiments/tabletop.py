"""`egosim experiment tabletop`: what each condition is worth, on scenes that were held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.command import DONE
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.experiments.scenes import (
    DEFINITIONS,
    MEASURES,
    SHEET_MOMENTS,
    SHEET_SCENES,
    Hidden,
    Scene,
    copies,
    generate,
    judge,
    reconstruct,
)
from egosim_jax.experiments.tables import mean_and_spread
from egosim_jax.progress import track
from egosim_jax.types import check_counts

if TYPE_CHECKING:
    from egosim_jax.generator import Generator
    from egosim_jax.types import Kind

Summary = dict[str, float]
Table = dict[str, dict[str, Summary]]
METHODS: tuple[tuple[str, Hidden | None], ...] = (
    ("full", None),
    ("without prior", "prior"),
    ("without mask", "mask"),
    ("without hands", "hands"),
)
SPREAD = (
    "standard deviation over scenes, each a mean over seeds; and over seeds, each a mean over "
    "scenes (n - 1)"
)


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
        from egosim_jax.generator import Generator
        from egosim_jax.io.run import open_folder, write_json
        from egosim_jax.io.weights import hashes

        check_counts(
            {"--scenes": self.scenes, "--seeds": self.seeds, "--batch-size": self.batch_size}
        )
        config = configs.get(self.config)
        weights = configs.weights_of(self.config, self.weights)
        made_of = {"experiment": self, "weights": hashes(weights)}
        open_folder(self.out, made_of, mutable=["experiment.weights"])
        generator = Generator.load(config, weights)
        kinds: tuple[Kind, ...] = ("human", "robot")
        tables = {kind: self._compare(kind, generator) for kind in kinds}
        definitions = {**DEFINITIONS, "spread": SPREAD}
        write_json(self.out / "report.json", {"definitions": definitions, "tables": tables})
        for kind, table in tables.items():
            _print(kind, table)
        return DONE

    def _compare(self, kind: Kind, generator: Generator) -> Table:
        """Scores of every method on the scenes of one kind of hands, and their sheet."""
        spec = generator.config.video
        seeds = range(self.first_scene, self.first_scene + self.scenes)
        scenes = [
            Scene.make(seed, spec, kind)
            for seed in track(seeds, f"making {kind} scenes", total=self.scenes)
        ]
        table: Table = {}
        shown: list[SheetClip] = []
        size = self.batch_size
        for name, hidden in METHODS:
            runs = []
            for seed in track(range(self.seeds), f"{kind}, {name}", total=self.seeds):
                videos = list(
                    generate(generator, scenes, batch_size=size, seed=seed, without=hidden)
                )
                runs.append(judge(scenes, videos))
                if hidden is None and seed == 0:
                    shown = [
                        scene.block({"generated": video})
                        for scene, video in zip(scenes, videos, strict=True)
                    ]
            table[name] = summarize(runs)
        others = {
            **copies(scenes),
            "truth through the autoencoder": list(reconstruct(generator, scenes, batch_size=size)),
            "truth": [scene.clip.frames for scene in scenes],
        }
        for name, videos in others.items():
            table[name] = summarize([judge(scenes, videos)])
        draw_sheet(
            shown[:SHEET_SCENES], self.out / f"contact_sheet_{kind}.png", moments=SHEET_MOMENTS
        )
        return table


def summarize(runs: Sequence[Sequence[Mapping[str, float]]]) -> dict[str, Summary]:
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
