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
from egosim_jax.evaluation.tables import TABLES
from egosim_jax.experiments.config import DWM
from egosim_jax.experiments.dwm_training import VARIANTS, Camera, Hands, Training, changed
from egosim_jax.experiments.report import (
    Table,
    cached_videos,
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
    HeldOutClip,
    baselines,
    draw_scenes,
    evaluate,
    generate,
    make_scenes,
    reconstruct,
)
from egosim_jax.experiments.training import train_config
from egosim_jax.generation.generator import Generator
from egosim_jax.io.run import open_folder
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError

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

PAPER = {
    f"{table.title}, {table.groups[group]}": rows
    for name, table in TABLES.items()
    if name.startswith("dwm_")
    for group, rows in table.published.items()
}
"""Figures of the paper by table and data set, then by row (Kim et al. 2026)."""
PAPER_MEASURES = {
    "psnr_clip": ("PSNR dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "lpips_vgg": ("LPIPS-VGG", "{:.3f}"),
    "dreamsim": ("DreamSim", "{:.3f}"),
}
Load = Callable[[], Generator]


def run(settings: DWM) -> None:
    """Make clips, train, generate, compare and draw."""
    chosen = _check(settings)
    training = Training(settings)
    sdedit = replace(training.base_model("inpaint"), strength=settings.strength)
    _ = sdedit.visited  # raises for an invalid strength before any work
    open_folder(settings.out, {"experiment": settings}, mutable=["experiment.only"])
    trained = {name: training.variant(name, VARIANTS[name]) for name in chosen}
    generators: dict[str, Load] = {
        name: lambda name=name, at=at: Generator.load(
            VARIANTS[name].model(training.config, name), at[0], lora=at[1]
        )
        for name, at in trained.items()
    }
    generators["sdedit"] = lambda: Generator.load(sdedit, training.base("inpaint"))
    titles = {**{name: VARIANTS[name].title for name in chosen}, **OTHERS}
    compared = {camera: _compare(training, generators, camera) for camera in CAMERAS}
    write_report(
        settings.out,
        definitions=REPORT_DEFINITIONS,
        titles=titles,
        tables={camera: table for camera, (table, _) in compared.items()},
        differences={camera: gaps for camera, (_, gaps) in compared.items()},
        paper=PAPER,
    )
    for camera, (table, gaps) in compared.items():
        for title, rows in (
            ("mean ± spread over scenes (± over seeds)", table),
            ("DWM minus the row, with its 95 % interval", gaps),
        ):
            titled = {titles[name]: row for name, row in rows.items()}
            show(f"{camera} camera: {title}", titled, MEASURES)
    for title, rows in PAPER.items():
        means = {
            name: {key: {"mean": value} for key, value in figures.items()}
            for name, figures in rows.items()
        }
        show(f"the paper's figures: {title}", means, PAPER_MEASURES)


def _check(settings: DWM) -> tuple[str, ...]:
    """Return the models to compare. Raises `InputError` for invalid settings before any work."""
    settings.check()
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
    training: Training, generators: Mapping[str, Load], camera: Camera
) -> tuple[Table, Table]:
    """Score every method on held-out scenes with one camera, and draw their contact sheet."""
    settings, size = training.settings, training.settings.batch_size
    scenes = make_scenes(
        training.seeds["held_out"],
        training.config,
        title=camera,
        conditions=("static", "mesh"),
        fixed_camera=camera == "fixed",
    )
    by_hands: dict[Hands, list[HeldOutClip]] = {
        kind: [
            replace(s, triplet=changed(s.triplet, kind, s.clip if kind == "poses" else None))
            for s in scenes
        ]
        for kind in get_args(Hands)
    }

    def generated(
        name: str, load: Load, hands: Hands, without: DroppedCondition | None = None
    ) -> list[Sequence[np.ndarray]]:
        """Return the videos of each seed."""
        return [
            cached_videos(
                _videos_file(settings.out, f"{camera}_{name}_{seed}"),
                lambda seed=seed: generate(
                    load(), by_hands[hands], batch_size=size, seed=seed, without=without
                ),
                total=len(scenes),
            )
            for seed in range(settings.seeds)
        ]

    videos: dict[str, list[Sequence[np.ndarray]]] = {}
    reference = generators[REFERENCE]
    for name, load in generators.items():
        videos[name] = generated(name, load, VARIANTS[name].hands if name in VARIANTS else "mesh")
        if name == REFERENCE:
            videos["hands_dropped"] = generated("hands_dropped", load, "mesh", "hands")
    coded = cached_videos(
        _videos_file(settings.out, f"{camera}_autoencoder"),
        lambda: reconstruct(reference(), scenes, batch_size=size),
        total=len(scenes),
    )
    others = {"autoencoder": coded, **baselines(scenes)}
    videos |= {name: [frames] for name, frames in others.items()}
    scores = {
        name: [evaluate(scenes, frames) for frames in runs]
        for name, runs in track(videos.items(), f"comparing, {camera}", total=len(videos))
    }
    shown = {name: videos[name][0] for name in SHOWN if name in videos}
    draw_scenes(settings.out / f"contact_sheet_{camera}.png", scenes, shown)
    by_scene = {name: over_seeds(runs, MEASURES) for name, runs in scores.items()}
    table = {name: summarize_runs(runs, MEASURES) for name, runs in scores.items()}
    return table, differences(by_scene, REFERENCE, MEASURES, minus="row")


def _videos_file(out: Path, name: str) -> Path:
    return out / "generated" / f"{name}.npy"
