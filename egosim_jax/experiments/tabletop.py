"""`egosim experiment tabletop`: ablation of the conditions on held-out scenes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from egosim_jax.configs.model import ModelConfig
from egosim_jax.data.sheet import draw_sheet
from egosim_jax.evaluation.metrics.report import paired_differences, print_table, summarize
from egosim_jax.experiments.config import Tabletop
from egosim_jax.experiments.scenes import (
    DEFINITIONS,
    MEASURES,
    SHEET_MOMENTS,
    SHEET_SCENES,
    DroppedCondition,
    HeldOutClip,
    baselines,
    conditions_of,
    evaluate,
    generate,
    reconstruct,
)
from egosim_jax.generation.generator import Generator
from egosim_jax.io.run import write_json
from egosim_jax.runtime.progress import track
from egosim_jax.types import Kind, check_counts

Table = dict[str, dict[str, dict[str, float]]]
Scores = list[dict[str, float]]
CEILING = "ground truth through the autoencoder"
"""Row of the encoded and decoded clips: an upper bound for the denoiser."""
METHODS: tuple[tuple[str, DroppedCondition | None], ...] = (
    ("full", None),
    ("without prior", "prior"),
    ("without mask", "mask"),
    ("without hands", "hands"),
)
"""Generated rows, and the condition that each drops."""
SPREAD = {
    "spread": "standard deviation over scenes (n - 1), each a mean over seeds",
    "spread_over_seeds": "standard deviation over seeds (n - 1), each a mean over scenes",
}
DIFFERENCES = {
    "differences": "of the means over seeds of each scene, without a condition minus with all; "
    "mean over scenes and Student's 95 % interval of paired differences"
}


GOALS: Mapping[str, tuple[float, str]] = {
    "object_lost": (1.0, "object lost in {:.0f} % ({:.0f} %)"),
    "object_error": (5.0, "object {:.0f} % off ({:.0f} %)"),
    "hand_iou": (-0.70, "hand IoU {:.2f} ({:.2f})"),
    "region_psnr": (-21.5, "region {:.1f} dB ({:.1f})"),
    "lpips_alex": (0.17, "LPIPS {:.2f} ({:.2f})"),
}
"""Maximum of each measure, or the negated minimum, and the text if a clip misses it.

The text has the clip's value and, in parentheses, the value of the ground truth through the
autoencoder: if that misses the goal, too, no denoiser can reach it."""


class Found(NamedTuple):
    """Findings on the scenes of one kind of hands."""

    table: Table
    """Measures of the methods."""
    differences: Table
    """Differences of the methods from the first method."""
    worst: list[dict[str, Any]]
    """Worst scenes, with the goals that they miss."""


def run(settings: Tabletop) -> None:
    """Make the scenes, generate, compare and draw."""
    check_counts(
        {
            "--scenes": settings.scenes,
            "--seeds": settings.seeds,
            "--batch-size": settings.batch_size,
            "--worst": settings.worst,
        }
    )
    generator = settings.open()
    hands = conditions_of(generator.config)[1]
    kinds: tuple[Kind, ...] = ("human", "robot") if hands == "skeleton" else ("human",)
    found = {kind: _compare(settings, kind, generator) for kind in kinds}
    report = {
        "definitions": {**DEFINITIONS, **SPREAD, **DIFFERENCES},
        "tables": {kind: one.table for kind, one in found.items()},
        "differences": {kind: one.differences for kind, one in found.items()},
        "worst": {kind: one.worst for kind, one in found.items()},
    }
    write_json(settings.out / "report.json", report)
    for kind, (table, differences, _) in found.items():
        title = f"{kind}: mean ± spread over scenes (± over seeds)"
        print_table("", table, MEASURES, title=title)
        title = f"{kind}: what dropping a condition changes, with its 95 % interval"
        print_table("", differences, MEASURES, title=title)


def _make_scenes(settings: Tabletop, kind: Kind, config: ModelConfig) -> list[HeldOutClip]:
    seeds = range(settings.first_scene, settings.first_scene + settings.scenes)
    prior, hands = conditions_of(config)
    make = partial(
        HeldOutClip.make,
        black_cloths=settings.black_cloths,
        prior=prior,
        hands=hands,
        point_px=config.point_px,
    )
    return [
        make(seed, config.video, kind)
        for seed in track(seeds, f"making {kind} scenes", total=settings.scenes)
    ]


def _compare(settings: Tabletop, kind: Kind, generator: Generator) -> Found:
    """Score every method on the scenes of one kind of hands, and draw their contact sheets."""
    size, scenes = settings.batch_size, _make_scenes(settings, kind, generator.config)
    table: Table = {}
    by_scene: dict[str, Scores] = {}
    generated: list[np.ndarray] = []
    first: Scores = []
    for name, dropped in METHODS:
        runs = []
        for seed in track(range(settings.seeds), f"{kind}, {name}", total=settings.seeds):
            videos = list(generate(generator, scenes, batch_size=size, seed=seed, without=dropped))
            runs.append(evaluate(scenes, videos))
            if dropped is None and seed == 0:
                generated, first = videos, runs[0]
        table[name], by_scene[name] = summarize_runs(runs), over_seeds(runs)
    coded = list(reconstruct(generator, scenes, batch_size=size))
    others = {
        **baselines(scenes),
        CEILING: coded,
        "ground truth": [scene.clip.frames for scene in scenes],
    }
    scores = {name: evaluate(scenes, videos) for name, videos in others.items()}
    table |= {name: summarize_runs([one]) for name, one in scores.items()}
    shown = [
        scene.on_sheet({"generated": video})
        for scene, video in zip(scenes[:SHEET_SCENES], generated, strict=False)
    ]
    sheet = settings.out / f"contact_sheet_{kind}.png"
    draw_sheet(shown, sheet, moments=SHEET_MOMENTS)
    notes: list[dict[str, Any]] = []
    if settings.worst is not None:
        videos = {"generated": generated, "through the autoencoder": coded}
        found = worst_clips(first, scores[CEILING], settings.worst)
        notes = [{"scene": scenes[n].clip.seed, "lacks": lacking} for n, lacking in found.items()]
        rows = [
            scenes[n].on_sheet(
                {name: of[n] for name, of in videos.items()}, note="; ".join(lacking)
            )
            for n, lacking in found.items()
        ]
        draw_sheet(rows, settings.out / f"worst_{kind}.png", moments=SHEET_MOMENTS)
    return Found(table, differences_from("full", by_scene), notes)


def missed_goals(scores: Mapping[str, float], ceiling: Mapping[str, float]) -> list[str]:
    """Return a text for each missed goal; NaN and absent measures miss no goal."""
    return [
        text.format(scores[name], ceiling[name])
        for name, (goal, text) in GOALS.items()
        if name in scores and scores[name] * np.sign(goal) > goal
    ]


def worst_clips(
    scores: Sequence[Mapping[str, float]], ceilings: Sequence[Mapping[str, float]], count: int
) -> dict[int, list[str]]:
    """Return the missed goals of the worst clips by index, starting with the most missed goals.

    Ties are ordered by the PSNR of the region of hands and object, lowest first.
    """
    missed = [missed_goals(*pair) for pair in zip(scores, ceilings, strict=True)]
    order = sorted(range(len(scores)), key=lambda n: (-len(missed[n]), scores[n]["region_psnr"]))
    return {n: missed[n] for n in order[:count]}


def differences_from(
    reference: str, by_scene: Mapping[str, Sequence[Mapping[str, float]]]
) -> Table:
    """Return the paired differences of each method from a reference, by measure."""
    start = by_scene[reference]
    return {
        name: paired_differences(scenes, start, [m for m in MEASURES if m in start[0]])
        for name, scenes in by_scene.items()
        if name != reference
    }


def over_seeds(runs: Sequence[Sequence[Mapping[str, float]]]) -> list[dict[str, float]]:
    """Return the scores of each scene, averaged over seeds."""
    return [_means(scores) for scores in zip(*runs, strict=True)]


def summarize_runs(
    runs: Sequence[Sequence[Mapping[str, float]]],
) -> dict[str, dict[str, float]]:
    """Return mean and spreads of each measure; `runs` has the scores of all scenes for each seed.

    NaN, the score of a scene with nothing to measure, is ignored.
    """
    scenes = over_seeds(runs)
    seeds = summarize([_means(scores) for scores in runs], MEASURES)
    return {
        name: {**summary, **_over_seeds(seeds[name])}
        for name, summary in summarize(scenes, MEASURES).items()
    }


def _means(scores: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {name: summary["mean"] for name, summary in summarize(scores, MEASURES).items()}


def _over_seeds(summary: Mapping[str, float]) -> dict[str, float]:
    """Return the spread of a summary as the spread over seeds; nothing for one seed."""
    return {"spread_over_seeds": summary["spread"]} if "spread" in summary else {}
