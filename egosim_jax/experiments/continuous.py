"""`egosim experiment continuous`: ablation of the state updates over consecutive clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from egosim_jax.evaluation.metrics.loop import DEFINITIONS, MEASURES, score_step
from egosim_jax.evaluation.metrics.report import Summary, paired_differences, print_table, summarize
from egosim_jax.experiments.config import Continuous, Ids
from egosim_jax.generation.generator import Generator
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import read_json
from egosim_jax.io.run import write_json
from egosim_jax.perception import registry
from egosim_jax.runtime.progress import track
from egosim_jax.simulation.rollout import Rollout
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.state.new_objects import without_ids
from egosim_jax.types import check_counts
from egosim_jax.worlds.tabletop import make_sequence, to_episode

Scores = Sequence[Mapping[str, float]]
"""Scores of the clips of one sequence."""
NOT_UPDATED = "no update"
METHODS: dict[str, str | None] = {
    "update, oracle": "oracle",
    "update, classical": "classical",
    NOT_UPDATED: None,
}
"""Method -> perception pipeline."""
DIFFERENCES = {
    "differences": "from no update, clip by clip of the same sequences; mean and Student's 95 % "
    "interval of paired differences"
}


def run(settings: Continuous) -> None:
    """Simulate the sequences by each method and compare them."""
    check_counts({"--sequences": settings.sequences, "--clips": settings.clips})
    generator = settings.open()
    seeds = range(settings.first_scene, settings.first_scene + settings.sequences)
    jobs = [(method, seed) for seed in seeds for method in METHODS]
    scores: dict[str, list[Scores]] = {method: [] for method in METHODS}
    for method, seed in track(jobs, "sequences", total=len(jobs)):
        scores[method].append(
            simulate(
                generator,
                settings.out / folder_name(method) / str(seed),
                seed=seed,
                clips=settings.clips,
                perception=METHODS[method],
                ids=settings.ids,
            )
        )
    tables = {
        method: [summarize(clips, MEASURES) for clips in zip(*runs, strict=True)]
        for method, runs in scores.items()
    }
    differences = {
        method: [
            paired_differences(*clips, MEASURES)
            for clips in zip(
                zip(*runs, strict=True), zip(*scores[NOT_UPDATED], strict=True), strict=True
            )
        ]
        for method, runs in scores.items()
        if method != NOT_UPDATED
    }
    report = {"definitions": DEFINITIONS | DIFFERENCES, "tables": tables}
    write_json(settings.out / "report.json", {**report, "differences": differences})
    for title, found in (
        ("{}: mean ± spread over sequences", tables),
        ("{}: difference from no update, with its 95 % interval", differences),
    ):
        for method, table in found.items():
            rows = {str(number): row for number, row in enumerate(table, start=1)}
            print_table("clip", rows, MEASURES, title=title.format(method))
    draw_curves(tables, settings.out / "curves.png")
    print(settings.out / "curves.png")


def folder_name(method: str) -> str:
    """Return the name of a method's folder."""
    return method.replace(", ", "_").replace(" ", "_")


def simulate(
    generator: Generator,
    folder: Path,
    *,
    seed: int,
    clips: int,
    perception: str | None,
    ids: Ids = "given",
) -> Scores:
    """Return the scores of one held-out sequence of clips, cached in its folder.

    Without `perception`, the state is not updated. `ids` are those that `classical` starts with.
    """
    path = folder / "scores.json"
    if path.exists():
        return read_json(path)
    video = generator.config.video
    sequence = list(make_sequence(seed, spec=video, clips=clips))
    episode = to_episode(sequence, fps=video.fps)
    start = episode.state
    if ids == "none" and perception == "classical":
        start = without_ids(start)
    found = None
    if perception is not None:
        found = registry.parse(perception).build(episode.observations())
    simulator = Simulator(generator=generator, perception=found, fps=video.fps)
    steps = Rollout(simulator, folder).run(
        start, episode.actions, seed=seed, first_frame=episode.first_frame
    )
    scores = [
        score_step(
            step.clip.frames,
            ground_truth,
            cameras=action.cameras,
            before=step.view,
            after=simulator.render(step.state, action),
        )
        for step, action, ground_truth in zip(
            steps, episode.actions, episode.ground_truth, strict=True
        )
    ]
    write_json(path, scores)
    return scores


def draw_curves(tables: Mapping[str, Sequence[Summary]], path: Path) -> None:
    """Plot each measure over the clips of a sequence, a line for each method."""
    matplotlib.use("agg")
    figure = Figure(figsize=(13, 6.4), layout="constrained")
    for axes, (measure, (title, _)) in zip(
        figure.subplots(2, 3).flat, MEASURES.items(), strict=True
    ):
        for method, table in tables.items():
            numbers = range(1, len(table) + 1)
            means = [row[measure]["mean"] for row in table]
            errors = [row[measure].get("spread", 0.0) for row in table]
            axes.errorbar(numbers, means, yerr=errors, marker="o", capsize=3, label=method)
        axes.set_title(title)
        axes.set_xlabel("clip")
        axes.grid(visible=True, alpha=0.3)
    figure.axes[0].legend()
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)
