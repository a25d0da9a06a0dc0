"""`egosim experiment continuous`: ablation of the state updates over consecutive clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from egosim_jax.evaluation.metrics.loop import DEFINITIONS, MEASURES, score_step
from egosim_jax.evaluation.metrics.report import Summary, paired_differences, summarize
from egosim_jax.experiments.config import Continuous, Ids
from egosim_jax.experiments.report import Scores, cached, plot, show_by_clip, write_report
from egosim_jax.generation.generator import Generator
from egosim_jax.perception import registry
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import print_line
from egosim_jax.simulation.rollout import Rollout
from egosim_jax.simulation.simulator import Simulator
from egosim_jax.state.new_objects import without_ids
from egosim_jax.worlds.tabletop import make_sequence, to_episode

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
Tables = dict[str, list[dict[str, dict[str, float]]]]
"""Summaries of each clip of the sequences, by method."""


def run(settings: Continuous) -> None:
    """Simulate the sequences by each method and compare them."""
    generator = settings.open()
    seeds = range(settings.first_scene, settings.first_scene + settings.sequences)
    jobs = [(method, seed) for seed in seeds for method in METHODS]
    scores: dict[str, list[Scores]] = {method: [] for method in METHODS}
    for method, seed in track(jobs, "sequences", total=len(jobs)):
        folder = settings.out / folder_name(method) / str(seed)
        perception, clips = METHODS[method], settings.clips
        scores[method].append(
            simulate(
                generator, folder, seed=seed, clips=clips, perception=perception, ids=settings.ids
            )
        )
    tables, differences = by_clip(scores, NOT_UPDATED)
    definitions = DEFINITIONS | DIFFERENCES
    write_report(settings.out, definitions=definitions, tables=tables, differences=differences)
    for method, rows in tables.items():
        show_by_clip(f"{method}: mean ± spread over sequences", rows, MEASURES)
    for method, rows in differences.items():
        title = f"{method}: difference from no update, with its 95 % interval"
        show_by_clip(title, rows, MEASURES)
    draw_curves(tables, settings.out / "curves.png")
    print_line(settings.out / "curves.png")


def folder_name(method: str) -> str:
    """Return the name of a method's folder."""
    return method.replace(", ", "_").replace(" ", "_")


def by_clip(scores: Mapping[str, Sequence[Scores]], reference: str) -> tuple[Tables, Tables]:
    """Return the summaries of each clip over sequences, and the differences from a reference."""
    clips = {name: list(zip(*runs, strict=True)) for name, runs in scores.items()}
    tables = {name: [summarize(clip, MEASURES) for clip in of] for name, of in clips.items()}
    differences = {
        name: [
            paired_differences(*pair, MEASURES) for pair in zip(of, clips[reference], strict=True)
        ]
        for name, of in clips.items()
        if name != reference
    }
    return tables, differences


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

    def score() -> Scores:
        video = generator.config.video
        episode = to_episode(list(make_sequence(seed, spec=video, clips=clips)), fps=video.fps)
        start = episode.state
        if ids == "none" and perception == "classical":
            start = without_ids(start)
        perceive = None
        if perception is not None:
            perceive = registry.parse(perception).build(episode.observations())
        simulator = Simulator(generator=generator, perception=perceive, fps=video.fps)
        steps = Rollout(simulator, folder).run(
            start, episode.actions, seed=seed, first_frame=episode.first_frame
        )
        return [
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

    return cached(folder / "scores.json", score)


def draw_curves(tables: Mapping[str, Sequence[Summary]], path: Path) -> None:
    """Plot each measure over the clips of a sequence, a line for each method."""
    with plot(path, 13, 6.4) as figure:
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
