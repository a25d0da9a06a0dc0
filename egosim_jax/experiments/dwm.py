"""`egosim experiment dwm`: DWM, its baselines and its ablations in miniature.

Static versions of tabletop clips replace DWM's rendered scenes (moving head) and recordings (fixed
camera). The model is adapted from an inpainting base, as DWM is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np

from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.data.sheet import draw_sheet
from egosim_jax.evaluation.metrics.report import paired_differences, print_table
from egosim_jax.experiments.config import DWM
from egosim_jax.experiments.dwm_training import Training, changed
from egosim_jax.experiments.dwm_variants import PAPER, VARIANTS, Camera, Hands
from egosim_jax.experiments.scenes import (
    DEFINITIONS,
    MEASURES,
    SHEET_MOMENTS,
    SHEET_SCENES,
    DroppedCondition,
    HeldOutClip,
    baselines,
    evaluate,
    generate,
    reconstruct,
)
from egosim_jax.experiments.tabletop import over_seeds, summarize_runs
from egosim_jax.experiments.training import cached_videos, train_config
from egosim_jax.generation.generator import Generator
from egosim_jax.io.run import open_folder, write_json
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError, check_counts, check_seed

CAMERAS: tuple[Camera, ...] = ("moving", "fixed")
REFERENCE = "full"
"""Model with which all others are compared."""
OTHERS = {
    "hands_dropped": "DWM, its hands dropped",
    "sdedit": "SDEdit of the base",
    "prior copied": "static video copied",
    "first frame repeated": "first frame repeated",
    "autoencoder": "ground truth through the autoencoder",
}
"""Titles of the rows without an own training."""
SHOWN = ("full", "no_hands", "sdedit")
"""Models on the contact sheets."""
REPORT_DEFINITIONS = {
    **DEFINITIONS,
    "spread": "standard deviation over scenes (n - 1), each a mean over seeds",
    "differences": "DWM minus the row, of the means over seeds of each scene; mean over scenes and "
    "Student's 95 % interval of paired differences",
    "paper": "figures of Kim et al. 2026, on other data: only their order can be compared",
}

Videos = list[np.ndarray]
Table = dict[str, dict[str, dict[str, float]]]


def run(settings: DWM) -> None:
    """Make clips, train, generate, compare and draw."""
    chosen = _check(settings)
    training = Training(settings)
    sdedit = replace(training.base_model("inpaint"), strength=settings.strength)
    _ = sdedit.visited  # raises for an invalid strength before any work
    open_folder(settings.out, {"experiment": settings}, mutable=["experiment.only"])
    trained = {name: training.variant(name, VARIANTS[name]) for name in chosen}
    generators: dict[str, Callable[[], Generator]] = {
        name: lambda name=name, at=at: Generator.load(
            VARIANTS[name].model(training.config, name), at[0], lora=at[1]
        )
        for name, at in trained.items()
    }
    generators["sdedit"] = lambda: Generator.load(sdedit, training.base("inpaint"))
    titles = {**{name: VARIANTS[name].title for name in chosen}, **OTHERS}
    found = {camera: _compare(training, generators, camera) for camera in CAMERAS}
    report = {
        "definitions": REPORT_DEFINITIONS,
        "titles": titles,
        "tables": {camera: table for camera, (table, _) in found.items()},
        "differences": {camera: differences for camera, (_, differences) in found.items()},
        "paper": PAPER,
    }
    write_json(settings.out / "report.json", report)
    for camera, (table, differences) in found.items():
        rows = {titles[name]: row for name, row in table.items()}
        title = f"{camera} camera: mean ± spread over scenes (± over seeds)"
        print_table("", rows, MEASURES, title=title)
        rows = {titles[name]: row for name, row in differences.items()}
        title = f"{camera} camera: DWM minus the row, with its 95 % interval"
        print_table("", rows, MEASURES, title=title)
    _print_paper(titles)


def _check(settings: DWM) -> tuple[str, ...]:
    """Return the models to compare. Raises `InputError` for invalid settings before any work."""
    counts = ("moving_scenes", "fixed_scenes", "held_out", "seeds", "steps", "batch_size", "rank")
    check_counts({f"--{name.replace('_', '-')}": getattr(settings, name) for name in counts})
    check_seed(settings.first_scene, name="--first-scene")
    for stage in (settings.autoencoder, settings.base, settings.adaptation):
        train_config(stage)  # raises for invalid values
    ConditionDropout(text=settings.text_dropout)  # raises, too
    if unknown := sorted({*settings.only} - {*VARIANTS}):
        raise InputError(
            f"There is no model {', '.join(unknown)} to compare: choose from "
            f"{', '.join(VARIANTS)}. (--only)"
        )
    return tuple(n for n in VARIANTS if not settings.only or n in (REFERENCE, *settings.only))


def _compare(
    training: Training, generators: Mapping[str, Callable[[], Generator]], camera: Camera
) -> tuple[Table, Table]:
    """Score every method on held-out scenes with one camera, and draw their contact sheet."""
    settings, size = training.settings, training.settings.batch_size
    scenes = [
        HeldOutClip.make(
            seed,
            training.config.video,
            "human",
            fixed_camera=camera == "fixed",
            prior="static",
            hands="mesh",
        )
        for seed in track(training.seeds["held_out"], f"making {camera}", total=settings.held_out)
    ]
    seen: dict[Hands, list[HeldOutClip]] = {
        kind: [
            replace(s, triplet=changed(s.triplet, kind, s.clip if kind == "poses" else None))
            for s in scenes
        ]
        for kind in get_args(Hands)
    }
    videos: dict[str, list[Videos]] = {}
    for name, load in generators.items():
        hands = VARIANTS[name].hands if name in VARIANTS else "mesh"
        given = seen[hands]
        videos[name] = _generated(training, camera, name, load, given)
        if name == REFERENCE:
            videos["hands_dropped"] = _generated(
                training, camera, "hands_dropped", load, given, without="hands"
            )
    load = generators[REFERENCE]
    path = _videos_file(training, f"{camera}_autoencoder")
    videos["autoencoder"] = [
        cached_videos(path, lambda: reconstruct(load(), scenes, batch_size=size), total=len(scenes))
    ]
    videos |= {name: [frames] for name, frames in baselines(scenes).items()}
    scores = {
        name: [evaluate(scenes, frames) for frames in runs]
        for name, runs in track(videos.items(), f"comparing, {camera}", total=len(videos))
    }
    sheet = settings.out / f"contact_sheet_{camera}.png"
    clips = [
        scene.on_sheet({name: videos[name][0][n] for name in SHOWN if name in videos})
        for n, scene in enumerate(scenes[:SHEET_SCENES])
    ]
    draw_sheet(clips, sheet, moments=SHEET_MOMENTS)
    by_scene = {name: over_seeds(runs) for name, runs in scores.items()}
    return {name: summarize_runs(runs) for name, runs in scores.items()}, _differences(by_scene)


def _differences(by_scene: Mapping[str, Sequence[Mapping[str, float]]]) -> Table:
    """Return the paired differences of DWM from each other method, by measure."""
    ours = by_scene[REFERENCE]
    return {
        name: paired_differences(ours, scenes, [m for m in MEASURES if m in ours[0]])
        for name, scenes in by_scene.items()
        if name != REFERENCE
    }


def _generated(
    training: Training,
    camera: Camera,
    name: str,
    load: Callable[[], Generator],
    scenes: Sequence[HeldOutClip],
    *,
    without: DroppedCondition | None = None,
) -> list[Videos]:
    """Return the generated videos of a model for each seed."""
    settings = training.settings
    return [
        cached_videos(
            _videos_file(training, f"{camera}_{name}_{seed}"),
            lambda seed=seed: generate(
                load(), scenes, batch_size=settings.batch_size, seed=seed, without=without
            ),
            total=len(scenes),
        )
        for seed in range(settings.seeds)
    ]


def _videos_file(training: Training, name: str) -> Path:
    return training.out / "generated" / f"{name}.npy"


def _print_paper(titles: Mapping[str, str]) -> None:
    """Print the figures of the paper's tables."""
    names = {"psnr": ("PSNR dB", "{:.2f}"), "ssim": ("SSIM", "{:.3f}")}
    names |= {"lpips": ("LPIPS-VGG", "{:.3f}"), "dreamsim": ("DreamSim", "{:.3f}")}
    for table, rows in PAPER.items():
        found = {
            titles.get(name, name): {key: {"mean": value} for key, value in figures.items()}
            for name, figures in rows.items()
        }
        print_table("", found, names, title=f"the paper's figures: {table}")
