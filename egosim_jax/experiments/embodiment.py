"""`egosim experiment embodiment`: transfer from human hands to a robot with few robot clips."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from egosim_jax import configs, rendering
from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.configs.model import ModelConfig
from egosim_jax.data.manifest import MANIFEST
from egosim_jax.data.pack import triplet_record
from egosim_jax.data.shards import ShardReader, ShardWriter
from egosim_jax.evaluation.metrics.report import summarize
from egosim_jax.experiments.config import Embodiment, Hyperparameters
from egosim_jax.experiments.report import (
    Table,
    cached_videos,
    differences,
    plot,
    show,
    write_report,
)
from egosim_jax.experiments.scenes import (
    DEFINITIONS,
    MEASURES,
    HeldOutClip,
    baselines,
    draw_scenes,
    evaluate,
    generate,
    make_scenes,
    reconstruct,
)
from egosim_jax.experiments.training import make_frames, train_config, train_denoiser
from egosim_jax.generation.generator import Generator
from egosim_jax.io.bounded import read_lines
from egosim_jax.io.run import open_folder
from egosim_jax.io.weights import hashes
from egosim_jax.robots.arms import arm_of
from egosim_jax.robots.conversion import convert, triplets_of
from egosim_jax.robots.models import RobotModel, load_model
from egosim_jax.robots.sources import of_episode
from egosim_jax.runtime.progress import track
from egosim_jax.runtime.terminal import print_line
from egosim_jax.train.encode import encode_shards
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.types import InputError, Kind
from egosim_jax.worlds.tabletop import make_sequence, to_episode
from egosim_jax.worlds.tabletop.dataset import DatasetConfig, conditions_of

Videos = Mapping[str, Sequence[np.ndarray]]
"""Videos of all scenes by method."""
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
    settings.check()
    out, stages = settings.out, [getattr(settings, name) for name in METHODS]
    for stage in stages:
        train_config(stage)  # raises for invalid values before any work
    experiment = _Experiment(settings)
    if conditions_of(experiment.model)[1] == "mesh":
        raise InputError(
            f"{settings.config} is conditioned on hand meshes, which robots do not have: choose a "
            "model conditioned on keypoints. (--config)"
        )
    record = {"experiment": settings, "weights": hashes(experiment.origin)}
    open_folder(out, record, mutable=["experiment.out", "experiment.weights"])
    trained = experiment.train_all()
    scenes = make_scenes(
        experiment.unseen,
        experiment.model,
        "robot",
        title="held-out scenes",
        conditions=("state", "skeleton"),
    )
    videos = experiment.generate_all(trained, scenes)
    losses = {name: _validation(out / name) for name in trained}
    named = track(videos.items(), "comparing", total=len(videos))
    scores = {name: evaluate(scenes, of) for name, of in named}
    table: Table = {}
    for name, of in scores.items():
        table[name] = summarize(of, MEASURES)
        if name in losses:
            first, *_, last = losses[name].values()
            table[name] = {"before": {"mean": first}, "after": {"mean": last}, **table[name]}
    report = {"definitions": REPORT_DEFINITIONS, "table": table, "validation": losses}
    compared = {name: scores[name] for name in (CONVERTED, "full", "human") if name in scores}
    if CONVERTED in trained:
        report["differences"] = differences(compared, CONVERTED, MEASURES, minus="row")
    write_report(out, **report)
    rows = {METHODS.get(name, name): row for name, row in table.items()}
    show("robot, held out: mean ± spread over scenes", rows, {**LOSSES, **MEASURES})
    if CONVERTED in trained:
        title = "with converted clips, less: mean difference and its 95 % interval"
        show(title, {METHODS[name]: row for name, row in report["differences"].items()}, MEASURES)
    for name in trained.keys() - {"human", "scratch"}:
        first, *_, last = losses[name].values()
        verb = "lowers" if last < first else "does not lower"
        change = f"from {first:.3f} to {last:.3f}"
        print(f"{METHODS[name]}: training on the robot {verb} the validation loss, {change}")
    sheet, curves = out / "contact_sheet.png", out / "curves.png"
    draw_scenes(sheet, scenes, {name: videos[name] for name in trained})
    _draw_curves(losses, curves)
    print_line(f"{sheet}\n{curves}")


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

        def load(name: str) -> Generator:
            if name == "lora":
                return Generator.load(self.model, trained["human"], lora=trained[name])
            return Generator.load(self.model, trained[name])

        makers: dict[str, Callable[[], Iterable[np.ndarray]]] = {
            name: lambda name=name: generate(load(name), scenes, batch_size=size)
            for name in trained
        }
        makers["autoencoder"] = lambda: reconstruct(load("human"), scenes, batch_size=size)
        videos = {
            name: cached_videos(folder / f"{name}.npy", make, total=len(scenes))
            for name, make in makers.items()
        }
        coded = videos.pop("autoencoder")
        return {**videos, **baselines(scenes), "ground truth through the autoencoder": coded}

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
                triplets = triplets_of(
                    convert(of_episode(episode), robot),
                    f"{name}_{seed}",
                    renderer,
                    point_px=self.model.point_px,
                    prior=self.model.prior,
                )
                for triplet in triplets:
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


def _validation(folder: Path) -> dict[int, float]:
    """Return the validation losses of a training by step."""
    lines = read_lines(folder / "metrics.jsonl")
    return {x["step"]: x["validation_loss"] for _, x in lines if "validation_loss" in x}


def _draw_curves(losses: Mapping[str, Mapping[int, float]], path: Path) -> None:
    """Plot validation loss over steps: training on human clips (left) and robot clips (right)."""
    with plot(path, 11, 4) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for name, by_step in losses.items():
            axes = left if name == "human" else right
            axes.plot(list(by_step), list(by_step.values()), marker="o", label=METHODS[name])
        for axes, title in ((left, "on human clips"), (right, "on robot clips")):
            axes.set_title(f"training {title}")
            axes.set_xlabel("step")
            axes.grid(visible=True, alpha=0.3)
            axes.legend()
        left.set_ylabel("validation loss, held-out robot clips")
