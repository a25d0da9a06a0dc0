"""Settings of the experiments, which are also the options of `egosim experiment`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal


@dataclass(frozen=True, kw_only=True)
class ModelExperiment:
    """Settings of every experiment with a trained model."""

    out: Path
    """Folder of the report and the images of the experiment."""
    first_scene: int
    """Seed of the first scene."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights, by default those that ship with the package."""
    steps: int | None = None
    """Denoising steps, instead of the model's."""


@dataclass(frozen=True, kw_only=True)
class Tabletop(ModelExperiment):
    """Generate held-out tabletop scenes with all conditions and without each, and compare.

    Prints a table for human hands and one for the robot, along with the prior copied, the first
    frame repeated and the ground truth through the autoencoder. Writes report.json and a contact
    sheet of each.
    """

    scenes: int = 24
    """Scenes of each kind of hands."""
    first_scene: int = 100
    """Seed of the first scene; the shipped model was trained on those from 1000 on."""
    seeds: int = 2
    """Repetitions of each clip with different noise."""
    batch_size: int = 8
    """Number of clips that are generated together."""
    black_cloths: int = 0
    """Maximum number of black cloths on a table, which in a prior look like unobserved places."""
    worst: int | None = None
    """Scenes of each kind on a sheet of the worst ones, with what each lacks; None: no sheet."""


@dataclass(frozen=True, kw_only=True)
class Continuous(ModelExperiment):
    """Simulate held-out sequences with and without state updates, and compare clip by clip.

    Prints a table for each method and the differences from no update, writes report.json and
    curves.png. Each sequence is a simulation in a separate folder; the same command resumes an
    interrupted experiment.
    """

    sequences: int = 12
    """Number of sequences, of consecutive seeds."""
    clips: int = 10
    """Clips of each sequence."""
    first_scene: int = 600
    """Seed of the first sequence; the shipped model was trained on those from 1000 on."""


@dataclass(frozen=True, kw_only=True)
class Update(ModelExperiment):
    """Carry an object in held-out scenes, update the state, and compare it with the ground truth.

    A row each for the oracle at 832 x 480 and at the model's size, and for classical perception of
    ground-truth, of generated and of gray frames. Prints a table and writes report.json.
    """

    scenes: int = 24
    """Number of scenes in which an object is carried."""
    first_scene: int = 600
    """Seed of the first scene; the shipped model was trained on those from 1000 on."""


@dataclass(frozen=True, kw_only=True)
class LookAway(ModelExperiment):
    """Move an object, look elsewhere, look back: is it where it was left?

    In view, or by a hand out of view; with the state updated by the oracle, by classical
    perception, and not at all. Prints a table and the differences from no update, writes
    report.json and contact_sheet.png. The same command resumes an interrupted experiment.
    """

    scenes: int = 12
    """Number of scenes in which an object is carried."""
    first_scene: int = 300
    """Seed of the first scene; the shipped model was trained on those from 1000 on."""


@dataclass(frozen=True, kw_only=True)
class Policies(ModelExperiment):
    """Rank policies with faults by success in the generated world, and compare with the true one.

    Each policy carries an object to a goal in the same scenes. Prints success and agreement
    (Pearson, Spearman, MMRV) with intervals, writes report.json, ranking.png and contact_sheet.png.
    The same command resumes an interrupted experiment.
    """

    scenes: int = 24
    """Number of scenes in which an object is carried."""
    first_scene: int = 400
    """Seed of the first scene; the shipped model was trained on those from 1000 on."""
    perception: str = "classical"
    """Perception pipeline that reads success from the generated clips, by name with its options."""
    batch_size: int = 5
    """Number of clips that are generated together."""


@dataclass(frozen=True, kw_only=True)
class Hyperparameters:
    """Hyper-parameters of one training; the learning rate has a warm-up and a cosine decay."""

    steps: int
    """Number of training updates in the experiment."""
    learning_rate: float
    """Peak learning rate of the training."""
    warmup: int
    """Updates of linear warm-up."""
    optimizer: Literal["adamw", "muon"] = "muon"
    """Name of the optimizer."""
    batch_size: int = 4
    """Clips per training update in the experiment."""
    seed: int = 0
    """Seed of the initial weights, the order of the clips and the noise."""


@dataclass(frozen=True, kw_only=True)
class Embodiment:
    """Train on human hands, then on a few clips of a robot: all weights, and a LoRA.

    A further model is trained on the robot clips alone. Prints the scores of each on held-out robot
    clips; writes report.json, contact_sheet.png and curves.png. The same command resumes an
    interrupted experiment.
    """

    out: Path
    """Folder of the run; each training has a subfolder."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights whose autoencoder is used, by default those that ship with the package."""
    human_scenes: int = 400
    """Scenes of human hands to train on, one clip of each."""
    robot_scenes: int = 24
    """Scenes of the robot to train on, one clip of each."""
    held_out: int = 24
    """Scenes of the robot to validate on and to generate, one clip of each."""
    first_scene: int = 5000
    """Seed of the first scene; the shipped autoencoder was trained on those from 1000 to 1999."""
    human: Hyperparameters = Hyperparameters(steps=1200, learning_rate=2e-3, warmup=50)
    """Training on human clips, from random weights."""
    full: Hyperparameters = Hyperparameters(steps=200, learning_rate=5e-4, warmup=10)
    """Training of all weights of the human model on robot clips."""
    lora: Hyperparameters = Hyperparameters(
        steps=200, learning_rate=2e-3, warmup=10, optimizer="adamw"
    )
    """Training of a LoRA of the human model on robot clips."""
    scratch: Hyperparameters = Hyperparameters(steps=200, learning_rate=2e-3, warmup=50)
    """Training on robot clips from random weights."""
    rank: int = 16
    """Rank of the LoRA."""
    dropout: float = 0.15
    """Probability with which each condition is dropped in training."""
    steps: int = 10
    """Denoising steps of the generated clips."""
    batch_size: int = 8
    """Clips encoded, and generated, together."""


@dataclass(frozen=True, kw_only=True)
class Rank(ModelExperiment):
    """Rank candidate actions by an image of the goal, and compare with what they truly reach.

    Each goal is the last frame of one of several actions in a held-out scene. Prints how often the
    ranking by generated videos finds that action, and the rank correlation with the ranking by true
    videos; also for the ground truth through the autoencoder. Writes report.json.
    """

    goals: int = 24
    """Number of goals, each in another scene."""
    candidates: int = 4
    """Actions for each goal."""
    first_scene: int = 400
    """Seed of the first scene."""
    seeds: int = 2
    """Repetitions of each clip with different noise."""


@dataclass(frozen=True, kw_only=True)
class DWM:
    """Train DWM and its ablations in miniature on static twins of tabletop clips, and compare.

    Trains an autoencoder, a base that paints masked places, a base that continues a first frame,
    and from these DWM, a model without hands and the ablations. Prints a table for moving cameras
    and one for fixed ones, with the paper's figures; writes report.json and contact sheets. The
    same command resumes an interrupted experiment.
    """

    out: Path
    """Folder of the run; each training has a subfolder."""
    config: str = "dwm_tabletop"
    """Name of the model."""
    only: tuple[str, ...] = ()
    """Train and compare only these models, along with the bases; by default all."""
    moving_scenes: int = 240
    """Scenes with a moving camera to train on, one clip of each."""
    fixed_scenes: int = 96
    """Scenes with a fixed camera to train on, one clip of each."""
    held_out: int = 24
    """Scenes with a moving camera to generate, and as many with a fixed one."""
    first_scene: int = 20000
    """Seed of the first scene."""
    autoencoder: Hyperparameters = Hyperparameters(
        steps=1500, learning_rate=1e-3, warmup=200, batch_size=2
    )
    """Training of the autoencoder, on crops."""
    base: Hyperparameters = Hyperparameters(
        steps=1000, learning_rate=2e-3, warmup=100, batch_size=8
    )
    """Training of each base model, from random weights."""
    adaptation: Hyperparameters = Hyperparameters(
        steps=700, learning_rate=2e-3, warmup=50, batch_size=4
    )
    """Training of each model from its base."""
    rank: int | None = 48
    """Rank of the LoRA by which a base is adapted; None: all weights are trained."""
    products: Literal["bfloat16"] | None = "bfloat16"
    """Dtype to which the denoisers round the factors of products; None: the model's."""
    text_dropout: float = 0.1
    """Probability with which a prompt is dropped in training."""
    seeds: int = 2
    """Repetitions of each clip with different noise."""
    steps: int = 4
    """Denoising steps of the generated clips."""
    strength: float = 0.75
    """Strength of SDEdit: share of the steps that it takes, from the noised static video."""
    batch_size: int = 8
    """Clips encoded, and generated, together."""


@dataclass(frozen=True, kw_only=True)
class RealTiny:
    """Train `real_tiny` on the train split, generate both splits, compare, and draw a sheet."""

    metadata: Path
    """CSV or JSONL in EgoSim's columns, with video and split; clips of 61 frames."""
    out: Path
    """Folder of the run."""
    start: tuple[int, ...] = (0, 22, 44)
    """First frames of the windows that are generated."""
    seed: int = 0
    """Seed of the generated clips."""
    batch_size: int = 5
    """Number of clips that are generated together."""


@dataclass(frozen=True, kw_only=True)
class Debug:
    """Do the same with `debug` on sample clips, in a few minutes, to see that everything runs."""

    out: Path
    """Folder of the run."""
    steps: int = 20
    """Updates of the autoencoder, and as many of the denoiser."""
    seed: int = 0
    """Seed of the generated clips."""
