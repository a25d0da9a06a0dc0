"""`egosim experiment students`: a causal student and its teacher, compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.data.sheet import draw_sheet
from egosim_jax.evaluation.metrics.loop import DEFINITIONS as LOOP_DEFINITIONS
from egosim_jax.evaluation.metrics.loop import MEASURES as LOOP_MEASURES
from egosim_jax.evaluation.metrics.report import paired_differences, print_table, summarize
from egosim_jax.experiments.config import Students
from egosim_jax.experiments.continuous import draw_curves, simulate
from egosim_jax.experiments.scenes import (
    DEFINITIONS,
    MEASURES,
    SHEET_MOMENTS,
    SHEET_SCENES,
    HeldOutClip,
    conditions_of,
    evaluate,
    generate,
)
from egosim_jax.generation.causal import chunks_of
from egosim_jax.generation.generator import Generator
from egosim_jax.io.run import write_json
from egosim_jax.io.weights import hashes
from egosim_jax.models import lora
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError, check_counts

STUDENT = "student"
UNTRAINED = "teacher's weights, chunk by chunk"
OWN_MEASURES = {**MEASURES, "color": ("mean color, levels", "{:.2f}")}
OWN_DEFINITIONS = {
    **DEFINITIONS,
    "color": "distance of the mean color from the ground truth, frames 1 to the last; the largest "
    "of the channels, 255 levels",
    "differences": "the student's from each other row on the same scenes; mean and Student's 95 % "
    "interval of paired differences",
    "kept": "of a finished chunk, later chunks see the keys and values of its last denoising step, "
    "or of one more pass (refreshed)",
}

Row = tuple[str, Generator]


def run(settings: Students) -> None:
    """Generate the scenes by each denoiser, simulate the sequences, and compare."""
    counts = {"--scenes": settings.scenes, "--batch-size": settings.batch_size}
    check_counts({**counts, "--clips": settings.clips})
    for option in ("--teacher-steps", "--student-steps"):
        for steps in getattr(settings, option[2:].replace("-", "_")):
            check_counts({option: steps})
    stages = [_stage(text) for text in settings.stages]
    student = settings.open()
    chunks_of(student.config)  # raises for a config without chunks
    teacher = configs.get(settings.teacher)
    folder = configs.weights_of(settings.config, settings.weights)
    report = _compare_clips(settings, student, _others(settings, student, teacher, folder, stages))
    if settings.sequences:
        whole = Generator(teacher, Networks.load(teacher, folder))
        report |= _compare_loops(settings, {"teacher": whole, STUDENT: student})
    write_json(settings.out / "report.json", report)


def _stage(text: str) -> tuple[str, Path]:
    """Return name and file of a stage."""
    name, _, file = text.partition("=")
    if not (name and file):
        raise InputError(f"A stage is NAME=FILE, not {text!r}. (--stages)")
    if not Path(file).is_file():
        raise InputError(f"{file} does not exist: give a run's lora.safetensors. (--stages)")
    return name, Path(file)


def _others(
    settings: Students,
    student: Generator,
    teacher: ModelConfig,
    folder: Path,
    stages: Sequence[tuple[str, Path]],
) -> Iterator[Row]:
    """Yield the denoisers besides the student, by name: a row each."""
    for steps in settings.teacher_steps:
        config = replace(teacher, steps=steps)
        yield f"teacher, {steps} steps", Generator(config, Networks.load(config, folder))
    base = hashes(folder, only=["dit"])["dit"]
    for name, file in [(UNTRAINED, None), *stages]:
        networks = Networks.load(teacher, folder)
        if file is not None:
            lora.merge(networks.dit, file, base=base)
        for refresh in (False, True):
            chunks = replace(chunks_of(student.config), refresh=refresh)
            config = replace(student.config, chunks=chunks)
            yield f"{name}, refreshed" if refresh else name, Generator(config, networks)
    networks = Networks.load(student.config, folder)
    for steps in settings.student_steps:
        chunks = replace(chunks_of(student.config), first_steps=steps)
        config = replace(student.config, steps=steps, chunks=chunks)
        yield f"{STUDENT}, steps: {steps}", Generator(config, networks)


def _compare_clips(settings: Students, student: Generator, others: Iterator[Row]) -> dict:
    """Score each row on the held-out scenes, and draw a sheet of the first ones."""
    config, seeds = student.config, range(settings.scenes)
    prior, hands = conditions_of(config)
    make = partial(HeldOutClip.make, prior=prior, hands=hands, point_px=config.point_px)
    scenes = [
        make(settings.first_scene + seed, config.video, "human")
        for seed in track(seeds, "making scenes", total=settings.scenes)
    ]
    scores: dict[str, list[dict[str, float]]] = {}
    shown: dict[str, list[np.ndarray]] = {}
    for name, generator in [*others, (STUDENT, student)]:
        made = generate(generator, scenes, batch_size=settings.batch_size)
        videos = list(track(made, name, total=len(scenes)))
        colors = [_color_error(video, scene) for video, scene in zip(videos, scenes, strict=True)]
        scores[name] = [
            {**found, "color": color}
            for found, color in zip(evaluate(scenes, videos), colors, strict=True)
        ]
        shown[name] = videos[:SHEET_SCENES]
    table = {name: summarize(found, OWN_MEASURES) for name, found in scores.items()}
    differences = {
        name: paired_differences(scores[STUDENT], found, OWN_MEASURES)
        for name, found in scores.items()
        if name != STUDENT
    }
    first = next(iter(shown))
    sheet = [
        scene.on_sheet({first: shown[first][n], STUDENT: shown[STUDENT][n]})
        for n, scene in enumerate(scenes[:SHEET_SCENES])
    ]
    draw_sheet(sheet, settings.out / "contact_sheet.png", moments=SHEET_MOMENTS)
    print_table("", table, OWN_MEASURES, title="mean ± spread over scenes")
    title = "the student's differences from each row, with their 95 % interval"
    print_table("", differences, OWN_MEASURES, title=title)
    return {"definitions": OWN_DEFINITIONS, "table": table, "differences": differences}


def _color_error(video: np.ndarray, scene: HeldOutClip) -> float:
    """Return the distance of the mean colors of video and ground truth, of the worst channel."""
    means = (frames[1:].mean(axis=(0, 1, 2)) for frames in (video, scene.clip.frames))
    return float(np.abs(np.subtract(*means)).max())


def _compare_loops(settings: Students, generators: Mapping[str, Generator]) -> dict:
    """Score the sequences, clip by clip, of teacher and student."""
    first = settings.first_sequence
    jobs = [
        (name, seed) for seed in range(first, first + settings.sequences) for name in generators
    ]
    runs: dict[str, list] = {name: [] for name in generators}
    for name, seed in track(jobs, "sequences", total=len(jobs)):
        folder = settings.out / "loop" / name / str(seed)
        found = simulate(
            generators[name], folder, seed=seed, clips=settings.clips, perception="classical"
        )
        runs[name].append(found)
    by_clip = {name: list(zip(*found, strict=True)) for name, found in runs.items()}
    tables = {
        name: [summarize(clips, LOOP_MEASURES) for clips in found]
        for name, found in by_clip.items()
    }
    differences = [
        paired_differences(*clips, LOOP_MEASURES)
        for clips in zip(by_clip[STUDENT], by_clip["teacher"], strict=True)
    ]
    for title, rows in (
        *((f"{name} in the loop: mean ± spread", table) for name, table in tables.items()),
        ("student in the loop: difference from the teacher, with its 95 % interval", differences),
    ):
        numbered = {str(number): row for number, row in enumerate(rows, start=1)}
        print_table("clip", numbered, LOOP_MEASURES, title=title)
    draw_curves(tables, settings.out / "curves.png")
    loop = {"definitions": LOOP_DEFINITIONS, "tables": tables, "differences": differences}
    return {"loop": loop}
