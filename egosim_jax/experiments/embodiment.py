"""`egosim experiment embodiment`: from people's hands to a robot's, by a few clips of the robot."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from egosim_jax.command import DONE
from egosim_jax.data.sheet import draw_sheet
from egosim_jax.experiments.scenes import (
    DEFINITIONS,
    MEASURES,
    SHEET_MOMENTS,
    SHEET_SCENES,
    Scene,
    copies,
    generate,
    judge,
    reconstruct,
)
from egosim_jax.experiments.tables import Line, print_table, summarize
from egosim_jax.io.atomic import atomic_write
from egosim_jax.io.untrusted import read_lines
from egosim_jax.progress import track
from egosim_jax.types import check_counts

if TYPE_CHECKING:
    import numpy as np

    from egosim_jax.generator import Generator
    from egosim_jax.networks import ModelConfig
    from egosim_jax.train.config import TrainConfig
    from egosim_jax.types import Kind

Videos = Mapping[str, Sequence["np.ndarray"]]
"""By method, one of each scene."""
Validation = Mapping[int, float]
"""Validation loss by step."""
METHODS = {
    "people": "people alone",
    "full": "people, then all weights",
    "lora": "people, then a LoRA",
    "scratch": "robots alone",
}
"""The models by the name of their field and folder, and what tables call them."""
LOSSES = {
    "before": ("loss before", "{:.3f}"),
    "after": ("loss after", "{:.3f}"),
}
DEFINED = {
    "before, after": "flow-matching loss of the held-out robot clips at fixed noise levels and "
    "with fixed noise, before the first update of a training and after the last",
    **DEFINITIONS,
    "spread": "standard deviation over scenes (n - 1)",
}


@dataclass(frozen=True, kw_only=True)
class Stage:
    """One training: how long and how fast; after the warm-up the rate falls as a cosine does."""

    steps: int
    """Updates."""
    learning_rate: float
    """Peak learning rate."""
    warmup: int
    """Updates in which the rate rises."""
    rule: Literal["adamw", "muon"] = "muon"
    """Update rule."""
    batch_size: int = 4
    """Clips per update."""
    seed: int = 0
    """Seed of the initial weights, the order of the clips and the noise."""

    def training(self) -> TrainConfig:
        """The same for the training script, with eight validations and checkpoints."""
        from egosim_jax.train.config import OptimizerConfig, TrainConfig

        every = max(1, self.steps // 8)
        return TrainConfig(
            steps=self.steps,
            batch_size=self.batch_size,
            optimizer=OptimizerConfig(
                name=self.rule,
                learning_rate=self.learning_rate,
                warmup_steps=self.warmup,
                schedule="cosine",
            ),
            seed=self.seed,
            save_every=every,
            validate_every=every,
        )


@dataclass(frozen=True, kw_only=True)
class Embodiment:
    """Train on people's hands, then on a few clips of robots: all weights, and a LoRA.

    Beside them a model of the robots' clips alone. Prints what each makes of robot clips that none
    has seen; writes report.json, contact_sheet.png and curves.png. An interrupted experiment goes
    on where it was.
    """

    out: Path
    """Folder of the run; each training has a folder of its own in it."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights whose autoencoder is used, if not those that come with the package."""
    human_scenes: int = 400
    """Scenes of people's hands to train on, one clip of each."""
    robot_scenes: int = 24
    """Scenes of robots to train further on, one clip of each."""
    held_out: int = 24
    """Scenes of robots to validate on and to generate, one clip of each."""
    first_scene: int = 5000
    """Seed of the first scene; the shipped autoencoder was trained on those from 1000 to 1999."""
    people: Stage = Stage(steps=1200, learning_rate=2e-3, warmup=50)
    """Training on people's clips, from random weights."""
    full: Stage = Stage(steps=200, learning_rate=5e-4, warmup=10)
    """Training of all of the people's weights on robots' clips."""
    lora: Stage = Stage(steps=200, learning_rate=2e-3, warmup=10, rule="adamw")
    """Training of a LoRA on the people's weights, on robots' clips."""
    scratch: Stage = Stage(steps=200, learning_rate=2e-3, warmup=50)
    """Training on robots' clips from random weights."""
    rank: int = 16
    """Of the LoRA."""
    hidden: float = 0.15
    """Share of clips from which a condition is hidden in training, each by itself."""
    batch_size: int = 8
    """Clips encoded, and generated, together."""

    def run(self) -> int:
        """Make clips, train, generate, compare, draw."""
        from egosim_jax.io.run import open_folder, write_json
        from egosim_jax.io.weights import hashes

        check_counts(
            {
                "--human-scenes": self.human_scenes,
                "--robot-scenes": self.robot_scenes,
                "--held-out": self.held_out,
                "--rank": self.rank,
                "--batch-size": self.batch_size,
            }
        )
        for stage in (self.people, self.full, self.lora, self.scratch):
            stage.training()  # refuses what cannot be, before there is work to lose
        settings = {"experiment": self, "weights": hashes(self._origin)}
        open_folder(self.out, settings, mutable=["experiment.out", "experiment.weights"])
        made = self._train_all()
        scenes = [
            Scene.make(seed, self._model.video, "robot")
            for seed in track(self._unseen, "making scenes to judge by", total=self.held_out)
        ]
        videos = self._generate_all(made, scenes)
        validations = {name: _validation(self.out / name) for name in METHODS}
        table = _compare(scenes, videos, validations)
        report = {"definitions": DEFINED, "table": table, "validation": validations}
        write_json(self.out / "report.json", report)
        print_table(
            "",
            _titled(table),
            {**LOSSES, **MEASURES},
            title="robots, held out: mean ± spread over scenes",
        )
        for name in ("full", "lora"):
            print(_verdict(METHODS[name], validations[name]))
        self._draw(scenes, videos, validations)
        return DONE

    @property
    def _origin(self) -> Path:
        from egosim_jax import configs

        return configs.weights_of(self.config, self.weights)

    @property
    def _model(self) -> ModelConfig:
        from egosim_jax import configs

        return configs.get(self.config).at(self._origin)

    @property
    def _robots(self) -> range:
        first = self.first_scene + self.human_scenes
        return range(first, first + self.robot_scenes)

    @property
    def _unseen(self) -> range:
        return range(self._robots.stop, self._robots.stop + self.held_out)

    def _train_all(self) -> dict[str, Path]:
        """The weights folder of each model; of the LoRA, its file."""
        human = self._encode("human", range(self.first_scene, self._robots.start), "human")
        robot = self._encode("robot", self._robots, "robot")
        self._encode("held_out", self._unseen, "robot")
        people = self._train("people", self.people, human)
        return {
            "people": people,
            "full": self._train("full", self.full, robot, start=people),
            "lora": self._train("lora", self.lora, robot, start=people, rank=self.rank),
            "scratch": self._train("scratch", self.scratch, robot),
        }

    def _encode(self, split: str, seeds: range, kind: Kind) -> Path:
        """Make the clips of a split, and cache their latents."""
        from egosim_jax.data.shards import ShardReader
        from egosim_jax.train.encode import encode_shards
        from egosim_jax.worlds.tabletop.dataset import DatasetConfig, make_shards

        model = self._model
        plan = DatasetConfig(seeds=tuple(seeds), clips=1, spec=model.video, kind=kind)
        frames, latents = self.out / "frames" / split, self.out / "latents" / split
        scenes = make_shards(plan, out=frames, workers=os.cpu_count() or 1)
        for _ in track(scenes, f"making {split}", total=len(seeds)):
            pass
        encode_shards(
            model,
            self._origin,
            source=ShardReader(frames),
            out=latents,
            stride=model.video.frames,
            batch_size=self.batch_size,
            verb=f"encoding {split}",
        )
        return latents

    def _train(
        self,
        name: str,
        stage: Stage,
        data: Path,
        *,
        start: Path | None = None,
        rank: int | None = None,
    ) -> Path:
        """Train one model, from a weights folder or from random weights, unless that was done."""
        from egosim_jax.conditioning.dropout import ConditionDropout
        from egosim_jax.train.fine_tuning import write_trained
        from egosim_jax.train.loop import train
        from egosim_jax.train.tasks.denoising import Denoising

        out, model, share = self.out / name, self._model, self.hidden
        done = out / ("weights" if rank is None else "lora.safetensors")
        # What was not trained, as the autoencoder, is linked last.
        if done.is_file() or (done / "vae.safetensors").exists():
            return done
        trained = train(
            Denoising(
                model=model,
                dropout=ConditionDropout(prior=share, mask=share, hands=share, text=share),
                rank=rank,
            ),
            stage.training(),
            data=data,
            validation=self.out / "latents" / "held_out",
            out=out,
            weights=start,
        )
        return write_trained(trained, out, model=model, start=start or self._origin)

    def _generate_all(self, made: Mapping[str, Path], scenes: Sequence[Scene]) -> Videos:
        """The held-out clips by each model, and by what needs none."""
        size = self.batch_size
        videos = {
            name: self._keep(
                name,
                lambda name=name: generate(self._generator(made, name), scenes, batch_size=size),
            )
            for name in METHODS
        }
        through = self._keep(
            "autoencoder",
            lambda: reconstruct(self._generator(made, "people"), scenes, batch_size=size),
        )
        return {**videos, **copies(scenes), "truth through the autoencoder": through}

    def _generator(self, made: Mapping[str, Path], name: str) -> Generator:
        from egosim_jax.generator import Generator

        model = self._model
        if name == "lora":
            return Generator.load(model, made["people"], lora=made[name])
        return Generator.load(model, made[name])

    def _keep(self, name: str, make: Callable[[], Iterable[np.ndarray]]) -> list[np.ndarray]:
        """The videos of a method, made unless they were."""
        import numpy as np

        path = self.out / "generated" / f"{name}.npy"
        if not path.exists():
            videos = list(track(make(), f"generating, {name}", total=self.held_out))
            with atomic_write(path) as temporary:
                np.save(temporary, np.stack(videos))
        return list(np.load(path))

    def _draw(
        self, scenes: Sequence[Scene], videos: Videos, validations: Mapping[str, Validation]
    ) -> None:
        """The contact sheet and the curves."""
        sheet = self.out / "contact_sheet.png"
        blocks = [
            scene.block({name: videos[name][number] for name in METHODS})
            for number, scene in enumerate(scenes[:SHEET_SCENES])
        ]
        draw_sheet(blocks, sheet, moments=SHEET_MOMENTS)
        curves = self.out / "curves.png"
        draw_curves(validations, curves)
        print(f"{sheet}\n{curves}")


def _validation(folder: Path) -> dict[int, float]:
    """The validation losses of a training, by step."""
    lines = read_lines(folder / "metrics.jsonl")
    return {x["step"]: x["validation_loss"] for _, x in lines if "validation_loss" in x}


def _compare(
    scenes: Sequence[Scene], videos: Videos, validations: Mapping[str, Validation]
) -> dict[str, Line]:
    """A line for each method; those that were trained have losses, too."""
    table = {}
    for name in track(videos, "comparing", total=len(videos)):
        losses = {}
        if name in validations:
            first, *_, last = validations[name].values()
            losses = {"before": {"mean": first}, "after": {"mean": last}}
        table[name] = {**losses, **summarize(judge(scenes, videos[name]), MEASURES)}
    return table


def _titled(table: Mapping[str, Line]) -> dict[str, Line]:
    return {METHODS.get(name, name): line for name, line in table.items()}


def _verdict(title: str, validation: Validation) -> str:
    """Whether a training lowered the validation loss."""
    first, *_, last = validation.values()
    verb = "lowers" if last < first else "does not lower"
    change = f"from {first:.3f} to {last:.3f}"
    return f"{title}: training on robots {verb} the validation loss, {change}"


def draw_curves(validations: Mapping[str, Validation], path: Path) -> None:
    """The validation loss by step: of the training on people, and of those on robots."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for name, losses in validations.items():
        axes = left if name == "people" else right
        axes.plot(list(losses), list(losses.values()), marker="o", label=METHODS[name])
    for axes, title in ((left, "on people"), (right, "on robots")):
        axes.set_title(f"training {title}")
        axes.set_xlabel("step")
        axes.grid(visible=True, alpha=0.3)
        axes.legend()
    left.set_ylabel("validation loss, held-out robots")
    with atomic_write(path) as temporary:
        figure.savefig(temporary, dpi=100)
