"""`egosim experiment continuous`: what a world that remembers is worth, clip after clip."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.cli.simulate import DEFINITIONS, MEASURES, backend, score
from egosim_jax.command import DONE
from egosim_jax.experiments.tables import Line, print_table, summarize
from egosim_jax.io.atomic import atomic_write
from egosim_jax.progress import track
from egosim_jax.types import check_counts

if TYPE_CHECKING:
    from egosim_jax.generator import Generator

Scores = Sequence[Mapping[str, float]]
"""Of one sequence, clip by clip."""
METHODS: dict[str, str | None] = {
    "update, oracle": "oracle",
    "update, classical": "classical",
    "no update": None,
}


@dataclass(frozen=True, kw_only=True)
class Continuous:
    """Simulate held-out sequences with and without updates of the state, and compare by clip.

    Prints a table for each method, clip by clip, and writes report.json and curves.png. Each
    sequence is a simulation in a folder of its own; an interrupted experiment goes on.
    """

    out: Path
    """Folder to write to."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights, if not those that come with the package."""
    sequences: int = 6
    """How many, of consecutive seeds."""
    clips: int = 10
    """Of each."""
    first_scene: int = 200
    """Seed of the first; the shipped model was trained on those from 1000 on."""

    def run(self) -> int:
        """Simulate, compare, draw."""
        from egosim_jax import configs
        from egosim_jax.generator import Generator
        from egosim_jax.io.run import open_folder, write_json
        from egosim_jax.io.weights import hashes

        check_counts({"--sequences": self.sequences, "--clips": self.clips})
        config = configs.get(self.config)
        weights = configs.weights_of(self.config, self.weights)
        made_of = {"experiment": self, "weights": hashes(weights)}
        open_folder(self.out, made_of, mutable=["experiment.weights"])
        generator = Generator.load(config, weights)
        seeds = range(self.first_scene, self.first_scene + self.sequences)
        jobs = [(method, seed) for seed in seeds for method in METHODS]
        scores: dict[str, list[Scores]] = {method: [] for method in METHODS}
        for method, seed in track(jobs, "sequences", total=len(jobs)):
            scores[method].append(self._simulate(generator, method, seed))
        tables = {
            method: [summarize(clips, MEASURES) for clips in zip(*runs, strict=True)]
            for method, runs in scores.items()
        }
        write_json(self.out / "report.json", {"definitions": DEFINITIONS, "tables": tables})
        for method, table in tables.items():
            rows = {str(number): line for number, line in enumerate(table, start=1)}
            title = f"{method}: mean ± spread over sequences"
            print_table("clip", rows, MEASURES, title=title)
        draw(tables, self.out / "curves.png")
        print(self.out / "curves.png")
        return DONE

    def _simulate(self, generator: Generator, method: str, seed: int) -> Scores:
        """The scores of one sequence, which are kept beside it."""
        from egosim_jax.io.run import write_json
        from egosim_jax.io.untrusted import read_json
        from egosim_jax.rollout import Rollout
        from egosim_jax.simulator import Simulator
        from egosim_jax.worlds.tabletop import make_sequence, to_action

        folder = self.out / method.replace(", ", "_").replace(" ", "_") / str(seed)
        path = folder / "scores.json"
        if path.exists():
            return read_json(path)
        truth = list(make_sequence(seed, spec=generator.config.video, clips=self.clips))
        name = METHODS[method]
        simulator = Simulator(
            generator=generator,
            perception=None if name is None else backend(name, truth),
            fps=generator.config.video.fps,
        )
        actions = [to_action(clip) for clip in truth]
        steps = Rollout(simulator, folder).run(
            truth[0].state, actions, seed=seed, first_frame=truth[0].first.colors
        )
        scores = [score(step, clip) for step, clip in zip(steps, truth, strict=True)]
        write_json(path, scores)
        return scores


def draw(tables: Mapping[str, Sequence[Line]], path: Path) -> None:
    """Each measure against the number of the clip, a line a method."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 6.4), layout="constrained")
    for axes, (measure, (title, _)) in zip(
        figure.subplots(2, 3).flat, MEASURES.items(), strict=True
    ):
        for method, table in tables.items():
            numbers = range(1, len(table) + 1)
            means = [line[measure]["mean"] for line in table]
            errors = [line[measure]["spread"] for line in table]
            axes.errorbar(numbers, means, yerr=errors, marker="o", capsize=3, label=method)
        axes.set_title(title)
        axes.set_xlabel("clip")
        axes.grid(visible=True, alpha=0.3)
    figure.axes[0].legend()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)
