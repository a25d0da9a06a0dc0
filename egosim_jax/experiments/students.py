"""`egosim experiment students`: a causal student and its teacher, compared."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.evaluation.metrics.loop import DEFINITIONS as LOOP_DEFINITIONS
from egosim_jax.evaluation.metrics.loop import MEASURES as LOOP_MEASURES
from egosim_jax.experiments.config import Students
from egosim_jax.experiments.continuous import by_clip, draw_curves, simulate
from egosim_jax.experiments.report import (
    Scores,
    differences,
    show,
    show_by_clip,
    summaries,
    write_report,
)
from egosim_jax.experiments.scenes import (
    DEFINITIONS,
    MEASURES,
    HeldOutClip,
    draw_scenes,
    evaluate,
    generate,
    make_scenes,
)
from egosim_jax.generation.causal import chunks_of
from egosim_jax.generation.generator import Generator
from egosim_jax.io.weights import hashes
from egosim_jax.models import lora
from egosim_jax.runtime.progress import track
from egosim_jax.types import InputError

STUDENT = "student"
UNTRAINED = "teacher's weights, chunk by chunk"
ROW_MEASURES = {**MEASURES, "color": ("mean color, levels", "{:.2f}")}
ROW_DEFINITIONS = {
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
    stages = [_stage(text) for text in settings.stages]
    student = settings.open()
    chunks_of(student.config)  # raises for a config without chunks
    teacher = configs.get(settings.teacher)
    folder = configs.weights_of(settings.config, settings.weights)
    report = _compare_clips(settings, student, _others(settings, student, teacher, folder, stages))
    if settings.sequences:
        whole = Generator(teacher, Networks.load(teacher, folder))
        report |= _compare_loops(settings, {"teacher": whole, STUDENT: student})
    write_report(settings.out, **report)


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
    seeds = range(settings.first_scene, settings.first_scene + settings.scenes)
    scenes = make_scenes(seeds, student.config, title="scenes")
    scores: dict[str, Scores] = {}
    shown: dict[str, list[np.ndarray]] = {}
    for name, generator in [*others, (STUDENT, student)]:
        generated = generate(generator, scenes, batch_size=settings.batch_size)
        videos = list(track(generated, name, total=len(scenes)))
        scores[name] = [
            {**values, "color": _color_error(video, scene)}
            for values, video, scene in zip(evaluate(scenes, videos), videos, scenes, strict=True)
        ]
        if not shown or name == STUDENT:
            shown[name] = videos
    table = summaries(scores, ROW_MEASURES)
    gaps = differences(scores, STUDENT, ROW_MEASURES, minus="row")
    draw_scenes(settings.out / "contact_sheet.png", scenes, shown)
    show("mean ± spread over scenes", table, ROW_MEASURES)
    title = "the student's differences from each row, with their 95 % interval"
    show(title, gaps, ROW_MEASURES)
    return {"definitions": ROW_DEFINITIONS, "table": table, "differences": gaps}


def _color_error(video: np.ndarray, scene: HeldOutClip) -> float:
    """Return the distance of the mean colors of video and ground truth, of the worst channel."""
    means = (frames[1:].mean(axis=(0, 1, 2)) for frames in (video, scene.clip.frames))
    return float(np.abs(np.subtract(*means)).max())


def _compare_loops(settings: Students, generators: Mapping[str, Generator]) -> dict:
    """Score the sequences, clip by clip, of teacher and student."""
    seeds = range(settings.first_sequence, settings.first_sequence + settings.sequences)
    jobs = [(name, seed) for seed in seeds for name in generators]
    runs: dict[str, list[Scores]] = {name: [] for name in generators}
    for name, seed in track(jobs, "sequences", total=len(jobs)):
        folder, clips = settings.out / "loop" / name / str(seed), settings.clips
        runs[name].append(
            simulate(generators[name], folder, seed=seed, clips=clips, perception="classical")
        )
    tables, gaps = by_clip(runs, "teacher")
    for name, rows in tables.items():
        show_by_clip(f"{name} in the loop: mean ± spread", rows, LOOP_MEASURES)
    title = "student in the loop: difference from the teacher, with its 95 % interval"
    show_by_clip(title, gaps[STUDENT], LOOP_MEASURES)
    draw_curves(tables, settings.out / "curves.png")
    loop = {"definitions": LOOP_DEFINITIONS, "tables": tables, "differences": gaps[STUDENT]}
    return {"loop": loop}
