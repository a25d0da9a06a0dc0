"""`egosim experiment embodiment`: transfer from human hands to a robot with few robot clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from egosim_jax import configs, rendering
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.configs.model import ModelConfig
from egosim_jax.data.manifest import MANIFEST
from egosim_jax.data.pack import triplet_record
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.data.sheet import draw_sheet
from egosim_jax.evaluation.metrics.report import Summary, paired_differences, print_table, summarize
from egosim_jax.experiments.config import Embodiment, Hyperparameters
from egosim_jax.experiments.scenes import (
    DEFINITIONS,
    MEASURES,
    SHEET_MOMENTS,
    SHEET_SCENES,
    HeldOutClip,
    baselines,
    conditions_of,
    evaluate,
    generate,
    reconstruct,
)
from egosim_jax.experiments.training import (
    cached_videos,
    make_frames,
    train_config,
    train_denoiser,
)
from egosim_jax.generation.generator import Generator
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.bounded import read_lines
from egosim_jax.io.run import open_folder, write_json
from egosim_jax.io.weights import hashes
from egosim_jax.robots.arms import arm_of
from egosim_jax.robots.conversion import convert, triplets_of
from egosim_jax.robots.models import RobotModel, load_model
from egosim_jax.robots.sources import of_episode
from egosim_jax.runtime.progress import track
from egosim_jax.train.encode import encode_shards
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.types import InputError, Kind, check_counts, check_seed
from egosim_jax.worlds.tabletop import make_sequence, to_episode
from egosim_jax.worlds.tabletop.dataset import DatasetConfig

Videos = Mapping[str, Sequence[np.ndarray]]
"""Videos of all scenes by method."""
Validation = Mapping[int, float]
"""Validation loss by step."""
CONVERTED = "converted"
METHODS = {
    "human": "human alone",
    "full": "human, then all weights",
    "lora": "human, then a LoRA",
    "scratch": "robot alone",
    CONVERTED: "human, then converted clips",
}
"""Titles of the trained models, by field of the settings, which is also their folder."""
LOSSES = {
    "before": ("loss before", "{:.3f}"),
    "after": ("loss after", "{:.3f}"),
}
REPORT_DEFINITIONS = {
    "before, after": "flow-matching loss of the held-out robot clips at fixed noise levels and "
    "with fixed noise, before the first update of a training and after the last",
    **DEFINITIONS,
    "spread": "standard deviation over scenes (n - 1)",
}


def run(settings: Embodiment) -> None:
    """Make clips, train, generate, compare and draw."""
    check_counts(
        {
            "--human-scenes": settings.human_scenes,
            "--robot-scenes": settings.robot_scenes,
            "--held-out": settings.held_out,
            "--rank": settings.rank,
            "--batch-size": settings.batch_size,
            "--steps": settings.steps,
        }
    )
    check_seed(settings.first_scene, name="--first-scene")
    stages = (settings.human, settings.full, settings.lora, settings.scratch, settings.converted)
    for stage in stages:
        train_config(stage)  # raises for invalid values before any work
    experiment = _Experiment(settings)
    if conditions_of(experiment.model)[1] == "mesh":
        raise InputError(
            f"{settings.config} is conditioned on hand meshes, which robots do not have: choose a "
            "model conditioned on keypoints. (--config)"
        )
    record = {"experiment": settings, "weights": hashes(experiment.origin)}
    open_folder(settings.out, record, mutable=["experiment.out", "experiment.weights"])
    trained = experiment.train_all()
    scenes = [
        HeldOutClip.make(seed, experiment.model.video, "robot", point_px=experiment.model.point_px)
        for seed in track(experiment.unseen, "making held-out scenes", total=settings.held_out)
    ]
    videos = experiment.generate_all(trained, scenes)
    validations = {name: _validation(settings.out / name) for name in trained}
    scores = _scores(scenes, videos)
    table = _summaries(scores, validations)
    report = {"definitions": REPORT_DEFINITIONS, "table": table, "validation": validations}
    if CONVERTED in trained:
        report["differences"] = {
            name: paired_differences(scores[CONVERTED], scores[name], MEASURES)
            for name in ("full", "human")
        }
    write_json(settings.out / "report.json", report)
    print_table(
        "",
        {METHODS.get(name, name): row for name, row in table.items()},
        {**LOSSES, **MEASURES},
        title="robot, held out: mean ± spread over scenes",
    )
    if CONVERTED in trained:
        differences = {METHODS[name]: row for name, row in report["differences"].items()}
        title = "with converted clips, less: mean difference and its 95 % interval"
        print_table("", differences, MEASURES, title=title)
    for name in trained.keys() - {"human", "scratch"}:
        print(_verdict(METHODS[name], validations[name]))
    _draw(settings.out, scenes, videos, validations)


class _Experiment:
    """Data, models and videos of the experiment; existing ones are loaded."""

    def __init__(self, settings: Embodiment):
        self.settings, self.out = settings, settings.out
        self.origin = configs.weights_of(settings.config, settings.weights)
        model: ModelConfig = configs.get(settings.config).at(self.origin)
        self.model = replace(model, steps=settings.steps)
        first = settings.first_scene + settings.human_scenes
        self.human = range(settings.first_scene, first)
        self.robot = range(first, first + settings.robot_scenes)
        self.unseen = range(self.robot.stop, self.robot.stop + settings.held_out)
        self.arm = None if settings.robot is None else load_model(arm_of(settings.robot))

    def train_all(self) -> dict[str, Path]:
        """Train all models; return the folder of their weights, or the file of the LoRA."""
        settings = self.settings
        human_data = self._encode("human", self.human, "human")
        robot_data = self._encode("robot", self.robot, "robot")
        self._encode("held_out", self.unseen, "robot")
        human = self._train("human", settings.human, human_data)
        trained = {
            "human": human,
            "full": self._train("full", settings.full, robot_data, start=human),
            "lora": self._train("lora", settings.lora, robot_data, start=human, rank=settings.rank),
            "scratch": self._train("scratch", settings.scratch, robot_data),
        }
        if self.arm is not None:
            data = self._encode_frames(CONVERTED, self._convert(self.arm))
            trained[CONVERTED] = self._train(CONVERTED, settings.converted, data, start=human)
        return trained

    def generate_all(self, trained: Mapping[str, Path], scenes: Sequence[HeldOutClip]) -> Videos:
        """Generate the held-out clips by each model; add the baselines."""
        size, folder = self.settings.batch_size, self.out / "generated"
        videos = {
            name: cached_videos(
                folder / f"{name}.npy",
                lambda name=name: generate(self._generator(trained, name), scenes, batch_size=size),
                total=len(scenes),
            )
            for name in trained
        }
        reconstructed = cached_videos(
            folder / "autoencoder.npy",
            lambda: reconstruct(self._generator(trained, "human"), scenes, batch_size=size),
            total=len(scenes),
        )
        return {
            **videos,
            **baselines(scenes),
            "ground truth through the autoencoder": reconstructed,
        }

    def _encode(self, split: str, seeds: range, kind: Kind) -> Path:
        """Make the clips of a split and cache their latents."""
        config = DatasetConfig(seeds=tuple(seeds), clips=1, spec=self.model.video, kind=kind)
        frames = make_frames(config, self.out / "frames" / split, grid=self.model.grid)
        return self._encode_frames(split, frames)

    def _convert(self, robot: RobotModel) -> Path:
        """Make human clips of the robot scenes, converted to clips of a robot."""
        frames, spec, name = self.out / "frames" / CONVERTED, self.model.video, robot.arm.name
        if (frames / MANIFEST).exists():
            return frames
        renderer = rendering.get("jax")
        with ShardWriter(frames, kind="frames", spec=spec, grid=self.model.grid) as writer:
            for seed in track(self.robot, f"converting to {name}", total=len(self.robot)):
                episode = to_episode([next(make_sequence(seed, spec=spec))], fps=spec.fps)
                found = convert(of_episode(episode), robot)
                px = self.model.point_px
                for triplet in triplets_of(found, f"{name}_{seed}", renderer, point_px=px):
                    record = triplet_record(triplet)
                    writer.add(record.arrays, record.metadata)
        return frames

    def _encode_frames(self, split: str, frames: Path) -> Path:
        """Cache the latents of the clips of a split."""
        latents = self.out / "latents" / split
        encode_shards(
            self.model,
            self.origin,
            source=ShardReader(frames),
            out=latents,
            stride=self.model.video.frames,
            batch_size=self.settings.batch_size,
            verb=f"encoding {split}",
        )
        return latents

    def _train(
        self,
        name: str,
        stage: Hyperparameters,
        data: Path,
        *,
        start: Path | None = None,
        rank: int | None = None,
    ) -> Path:
        """Train one model, from a weights folder or from random weights."""
        share = self.settings.dropout
        dropout = ConditionDropout(prior=share, mask=share, hands=share, text=share)
        return train_denoiser(
            Denoising(model=self.model, dropout=dropout, rank=rank),
            stage,
            data=data,
            validation=self.out / "latents" / "held_out",
            out=self.out / name,
            start=start,
            others=lambda: self.origin,
        )

    def _generator(self, trained: Mapping[str, Path], name: str) -> Generator:
        if name == "lora":
            return Generator.load(self.model, trained["human"], lora=trained[name])
        return Generator.load(self.model, trained[name])


def _draw(
    out: Path,
    scenes: Sequence[HeldOutClip],
    videos: Videos,
    validations: Mapping[str, Validation],
) -> None:
    """Draw the contact sheet and the validation curves."""
    sheet = out / "contact_sheet.png"
    clips = [
        scene.on_sheet({name: videos[name][number] for name in validations})
        for number, scene in enumerate(scenes[:SHEET_SCENES])
    ]
    draw_sheet(clips, sheet, moments=SHEET_MOMENTS)
    curves = out / "curves.png"
    draw_curves(validations, curves)
    print(f"{sheet}\n{curves}")


def _validation(folder: Path) -> dict[int, float]:
    """Return the validation losses of a training by step."""
    lines = read_lines(folder / "metrics.jsonl")
    return {x["step"]: x["validation_loss"] for _, x in lines if "validation_loss" in x}


def _scores(scenes: Sequence[HeldOutClip], videos: Videos) -> dict[str, list[dict[str, float]]]:
    """Return the scores of each method on each scene."""
    names = track(videos, "comparing", total=len(videos))
    return {name: evaluate(scenes, videos[name]) for name in names}


def _summaries(
    scores: Mapping[str, list[dict[str, float]]], validations: Mapping[str, Validation]
) -> dict[str, Summary]:
    """Summarize each method over the scenes; trained models also have losses."""
    table = {}
    for name, found in scores.items():
        losses = {}
        if name in validations:
            first, *_, last = validations[name].values()
            losses = {"before": {"mean": first}, "after": {"mean": last}}
        table[name] = {**losses, **summarize(found, MEASURES)}
    return table


def _verdict(title: str, validation: Validation) -> str:
    """Return a sentence on the change of the validation loss in a training."""
    first, *_, last = validation.values()
    verb = "lowers" if last < first else "does not lower"
    change = f"from {first:.3f} to {last:.3f}"
    return f"{title}: training on the robot {verb} the validation loss, {change}"


def draw_curves(validations: Mapping[str, Validation], path: Path) -> None:
    """Plot validation loss over steps: training on human clips (left) and robot clips (right)."""
    matplotlib.use("agg")
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for name, losses in validations.items():
        axes = left if name == "human" else right
        axes.plot(list(losses), list(losses.values()), marker="o", label=METHODS[name])
    for axes, title in ((left, "on human clips"), (right, "on robot clips")):
        axes.set_title(f"training {title}")
        axes.set_xlabel("step")
        axes.grid(visible=True, alpha=0.3)
        axes.legend()
    left.set_ylabel("validation loss, held-out robot clips")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)
