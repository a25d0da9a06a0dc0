"""`egosim experiment rank`: rank candidate actions by a goal image, using generated videos."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from itertools import islice

import numpy as np

from egosim_jax.evaluation.metrics.rank_correlation import spearman
from egosim_jax.evaluation.metrics.rates import rate
from egosim_jax.evaluation.metrics.report import paired_difference, print_table
from egosim_jax.experiments.config import Rank
from egosim_jax.experiments.report import cached, write_report
from egosim_jax.experiments.scenes import triplet_of
from egosim_jax.generation.generator import Generator
from egosim_jax.generation.rank import by_image
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError, VideoSpec
from egosim_jax.worlds.tabletop import TabletopClip, make_sequence

MEASURES = {"top1": ("top-1 %", "{:.1f}"), "spearman": ("Spearman", "{:.3f}")}
DEFINITIONS = {
    "score": "-LPIPS (AlexNet) between the last frames of a video and of the goal's action; mean "
    "over seeds",
    "top1": "share of goals whose action has the highest score, in percent; 95 % interval of "
    "Clopper and Pearson",
    "spearman": "rank correlation between the scores of a goal's candidates and the scores of "
    "their true videos; mean over goals, Student's 95 % interval over goals",
}
MAX_TRIES = 200
"""Maximum number of actions of a scene to try for different ones."""
METHODS = {"generated": "generated videos", "autoencoder": "ground truth through the autoencoder"}


def run(settings: Rank) -> None:
    """Generate the candidates of every goal, rank them, and compare with the true ranking."""
    settings.check()
    if settings.candidates < 2:
        raise InputError(
            f"A goal with {settings.candidates} candidate cannot be ranked: it needs at least 2. "
            "(--candidates)"
        )
    generator = settings.open()
    seeds = range(settings.first_scene, settings.first_scene + settings.goals)
    goals = [
        cached(settings.out / "goals" / f"{seed}.json", partial(_goal, settings, generator, seed))
        for seed in track(seeds, "goals", total=settings.goals)
    ]
    table = {name: _summary(goals, name) for name in METHODS}
    chance = 100 / settings.candidates
    write_report(settings.out, definitions=DEFINITIONS, chance=chance, table=table, goals=goals)
    rows = {METHODS[name]: row for name, row in table.items()}
    title = f"{settings.goals} goals, chance {chance:.0f} %"
    print_table("ranking by", rows, MEASURES, title=title)


def _goal(settings: Rank, generator: Generator, seed: int) -> dict:
    """Return the scores of a goal's candidates by method."""
    clips = candidates(seed, generator.config.video, settings.candidates)
    best = seed % len(clips)
    triplets = [triplet_of(clip, generator.config) for clip in clips]
    goal = clips[best].frames[-1]
    score = by_image(goal, goal.shape[:2])
    generated = []
    for repeat in range(settings.seeds):
        noise = [number + 1000 * seed + 100 * repeat for number in range(len(clips))]
        generated.append([score(clip.frames) for clip in generator.generate(triplets, noise)])
    return {
        "seed": seed,
        "best": best,
        "captions": [clip.caption for clip in clips],
        "target": [score(clip.frames) for clip in clips],
        "generated": np.mean(generated, axis=0).tolist(),
        "autoencoder": [score(clip.frames) for clip in generator.reconstruct(triplets)],
    }


def candidates(seed: int, spec: VideoSpec, number: int) -> list[TabletopClip]:
    """Return clips of different actions in one scene, with the same cameras.

    Raises `InputError` if the scene has too few different actions.
    """
    small = VideoSpec(frames=spec.frames, height=16, width=16, fps=spec.fps)  # for captions only

    def different() -> Iterator[int]:
        seen: set[str] = set()
        for variant in range(MAX_TRIES):
            caption = next(make_sequence(seed, spec=small, variant=variant)).caption
            if caption not in seen:
                seen.add(caption)
                yield variant

    variants = list(islice(different(), number))
    if len(variants) < number:
        raise InputError(
            f"Scene {seed} has {len(variants)} different actions, not {number}: ask for fewer. "
            "(--candidates)"
        )
    return [next(make_sequence(seed, spec=spec, variant=variant)) for variant in variants]


def _summary(goals: Sequence[dict], method: str) -> dict[str, dict[str, float]]:
    """Return top-1 accuracy and Spearman correlation of a method, with intervals."""
    hits = sum(int(np.argmax(goal[method])) == goal["best"] for goal in goals)
    correlations = [spearman(*map(np.asarray, (goal[method], goal["target"]))) for goal in goals]
    return {
        "top1": rate(hits, len(goals)),
        "spearman": paired_difference(correlations, np.zeros(len(goals)).tolist()),
    }
