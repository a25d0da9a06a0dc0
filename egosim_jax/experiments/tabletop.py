"""`egosim experiment tabletop`: ablation of the conditions on held-out scenes."""

from __future__ import annotations

import numpy as np

from egosim_jax.experiments.config import Tabletop
from egosim_jax.experiments.report import (
    Scores,
    Table,
    differences,
    over_seeds,
    show,
    summarize_runs,
    write_report,
)
from egosim_jax.experiments.scenes import (
    DEFINITIONS,
    MEASURES,
    DroppedCondition,
    baselines,
    draw_scenes,
    evaluate,
    generate,
    make_scenes,
    reconstruct,
)
from egosim_jax.generation.generator import Generator
from egosim_jax.runtime.progress import track
from egosim_jax.types import Kind
from egosim_jax.worlds.tabletop.dataset import conditions_of

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


def run(settings: Tabletop) -> None:
    """Make the scenes, generate, compare and draw."""
    generator = settings.open()
    hands = conditions_of(generator.config)[1]
    kinds: tuple[Kind, ...] = ("human", "robot") if hands == "skeleton" else ("human",)
    compared = {kind: _compare(settings, kind, generator) for kind in kinds}
    write_report(
        settings.out,
        definitions={**DEFINITIONS, **SPREAD, **DIFFERENCES},
        tables={kind: table for kind, (table, _) in compared.items()},
        differences={kind: gaps for kind, (_, gaps) in compared.items()},
    )
    for kind, (table, gaps) in compared.items():
        show(f"{kind}: mean ± spread over scenes (± over seeds)", table, MEASURES)
        title = f"{kind}: what dropping a condition changes, with its 95 % interval"
        show(title, gaps, MEASURES)


def _compare(settings: Tabletop, kind: Kind, generator: Generator) -> tuple[Table, Table]:
    """Score every method on the scenes of one kind of hands, and draw their contact sheet."""
    size = settings.batch_size
    seeds = range(settings.first_scene, settings.first_scene + settings.scenes)
    scenes = make_scenes(
        seeds, generator.config, kind, title=f"{kind} scenes", black_cloths=settings.black_cloths
    )
    runs: dict[str, list[Scores]] = {}
    generated: list[np.ndarray] = []
    for name, dropped in METHODS:
        runs[name] = []
        for seed in track(range(settings.seeds), f"{kind}, {name}", total=settings.seeds):
            videos = list(generate(generator, scenes, batch_size=size, seed=seed, without=dropped))
            runs[name].append(evaluate(scenes, videos))
            generated = generated or videos
    by_scene = {name: over_seeds(scores, MEASURES) for name, scores in runs.items()}
    others = {
        **baselines(scenes),
        CEILING: list(reconstruct(generator, scenes, batch_size=size)),
        "ground truth": [scene.clip.frames for scene in scenes],
    }
    runs |= {name: [evaluate(scenes, videos)] for name, videos in others.items()}
    table = {name: summarize_runs(scores, MEASURES) for name, scores in runs.items()}
    draw_scenes(settings.out / f"contact_sheet_{kind}.png", scenes, {"generated": generated})
    return table, differences(by_scene, "full", MEASURES)
