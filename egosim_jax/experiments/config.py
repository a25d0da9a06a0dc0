"""Settings of the experiments, which are also the options of `egosim experiment`."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from egosim_jax.types import check_counts, check_seed

if TYPE_CHECKING:
    from egosim_jax.generation.generator import Generator

Ids = Literal["given", "none"]
"""Object ids of a state: given, or none, so that perception must find what a hand moves."""
Count = int
"""Number from 1."""
Seed = int
"""Number from 0."""


class Checked:
    """Settings whose numbers are checked by their types, `Count` and `Seed`."""

    def check(self) -> None:
        """Raise `InputError` for the first number out of range."""
        for field in fields(self):  # pyright: ignore[reportArgumentType]
            option, value = f"--{field.name.replace('_', '-')}", getattr(self, field.name)
            if "Count" in str(field.type):
                for number in value if isinstance(value, tuple) else (value,):
                    check_counts({option: number})
            elif field.type == "Seed":
                check_seed(value, name=option)


@dataclass(frozen=True, kw_only=True)
class ModelExperiment(Checked):
    """Settings of every experiment that uses a trained model."""

    out: Path
    """Folder of the report and images."""
    first_scene: Seed
    """Seed of the first scene."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights; by default the shipped ones."""
    steps: Count | None = None
    """Denoising steps, instead of the model's."""

    def open(self) -> Generator:
        """Open the folder, which must be new or have equal settings, and load the generator."""
        from egosim_jax import configs
        from egosim_jax.generation.generator import Generator
        from egosim_jax.io.run import open_folder
        from egosim_jax.io.weights import hashes

        self.check()
        config = configs.get(self.config)
        config = replace(config, steps=self.steps or config.steps)
        weights = configs.weights_of(self.config, self.weights)
        digests = hashes(weights, student=config.chunks is not None)
        record = {"experiment": self, "model": config, "weights": digests}
        open_folder(self.out, record, mutable=["experiment.weights"])
        return Generator.load(config, weights)


@dataclass(frozen=True, kw_only=True)
class Tabletop(ModelExperiment):
    """Generate held-out tabletop scenes with all conditions and without each one, and compare.

    Prints a table for human hands and one for the robot. Further rows are the copied prior, the
    repeated first frame, and the ground truth through the autoencoder. Writes report.json and two
    contact sheets.
    """

    scenes: Count = 24
    """Number of scenes with human hands, and with the robot."""
    first_scene: Seed = 100
    """Seed of the first scene; the shipped model was trained on seeds from 1000 on."""
    seeds: Count = 2
    """Number of repetitions of each clip with different noise."""
    batch_size: Count = 8
    """Number of clips generated together."""
    black_cloths: int = 0
    """Maximum number of black cloths on a table, which look like holes in the prior."""


@dataclass(frozen=True, kw_only=True)
class Continuous(ModelExperiment):
    """Simulate held-out sequences with and without state updates, and compare clip by clip.

    Prints a table for each method, and the differences from no update. Writes report.json and
    curves.png. Each sequence is a simulation in its own folder. The same command resumes an
    interrupted experiment.
    """

    sequences: Count = 12
    """Number of sequences; their seeds are consecutive."""
    clips: Count = 10
    """Number of clips per sequence."""
    first_scene: Seed = 600
    """Seed of the first sequence; the shipped model was trained on seeds from 1000 on."""
    ids: Ids = "given"
    """Object ids in the first state of classical perception."""


@dataclass(frozen=True, kw_only=True)
class Students(ModelExperiment):
    """Compare a causal student with its teacher on held-out scenes, and over consecutive clips.

    The rows: the teacher with several numbers of denoising steps, its weights used chunk by chunk,
    the given stages of training, the student with other numbers of steps, and as it is. Prints
    means, the student's differences from each row, and the clips of the loop with `classical`
    updates. Writes report.json, curves.png and contact_sheet.png. The same command resumes the
    loop.
    """

    config: str = "tabletop_student"
    """Name of the student."""
    teacher: str = "tabletop"
    """Name of the teacher, whose weights are in the student's folder."""
    teacher_steps: tuple[Count, ...] = (2, 4, 10)
    """Denoising steps of the teacher, a row for each."""
    student_steps: tuple[Count, ...] = (1,)
    """Other denoising steps of the student, a row for each."""
    stages: tuple[str, ...] = ()
    """Stages of the student's training, each as NAME=FILE; the file is a run's lora.safetensors."""
    scenes: Count = 24
    """Number of scenes."""
    first_scene: Seed = 100
    """Seed of the first scene; the shipped model was trained on seeds from 1000 on."""
    batch_size: Count = 8
    """Number of clips generated together."""
    sequences: int = 12
    """Number of sequences in the loop; 0: no loop."""
    first_sequence: Seed = 600
    """Seed of the first sequence."""
    clips: Count = 10
    """Number of clips per sequence."""


@dataclass(frozen=True, kw_only=True)
class Update(ModelExperiment):
    """Carry an object in held-out scenes, update the state, and compare it with the ground truth.

    The rows: the oracle at 832 x 480 and at the model's size, and perception of ground-truth,
    generated and gray frames. Prints a table and writes report.json.
    """

    scenes: Count = 24
    """Number of scenes in which an object is carried."""
    first_scene: Seed = 600
    """Seed of the first scene; the shipped model was trained on seeds from 1000 on."""
    perception: str = "classical"
    """Perception pipeline with its options: a name, or MODULE:NAME of your own."""
    ids: Ids = "given"
    """Object ids in the state of this perception."""


@dataclass(frozen=True, kw_only=True)
class LookAway(ModelExperiment):
    """Move an object, look elsewhere, look back: is it where it was left?

    A hand moves the object in view, or out of view. The state is updated by the oracle, by
    classical perception, or not at all. Prints a table and the differences from no update. Writes
    report.json and contact_sheet.png, and in wrbench the videos as WRBench's evaluation reads them.
    The same command resumes an interrupted experiment.
    """

    scenes: Count = 12
    """Number of scenes in which an object is carried."""
    first_scene: Seed = 300
    """Seed of the first scene; the shipped model was trained on seeds from 1000 on."""


@dataclass(frozen=True, kw_only=True)
class Policies(ModelExperiment):
    """Rank imperfect policies by success in the generated world and in the true world; compare.

    Each policy carries an object to a goal in the same scenes. Prints success and agreement
    (Pearson, Spearman, MMRV) with intervals. Writes report.json, ranking.png and contact_sheet.png.
    The same command resumes an interrupted experiment.
    """

    scenes: Count = 24
    """Number of scenes in which an object is carried."""
    first_scene: Seed = 400
    """Seed of the first scene; the shipped model was trained on seeds from 1000 on."""
    perception: str = "classical"
    """Perception pipeline that measures success in generated clips, with its options."""
    batch_size: Count = 5
    """Number of clips generated together."""


@dataclass(frozen=True, kw_only=True)
class TrainPolicy(Checked):
    """Train a small policy in a generated world, and judge it in the true world.

    A linear policy that lifts an object is fitted to poor demonstrations, improved by PPO of
    Stable-Baselines3 or TorchRL, and judged before and after in other scenes. Prints success with
    intervals. Writes report.json. The same command resumes after the training. Needs the extra rl.
    """

    out: Path
    """Folder of the report."""
    library: Literal["stable_baselines3", "torchrl"] = "stable_baselines3"
    """Library whose PPO trains the policy, through its adapter of our environment."""
    config: str = "preview"
    """Name of the model whose world the policy is trained in; `preview` needs no weights."""
    rounds: Count = 10
    """Number of updates of PPO."""
    steps: Count = 4
    """Number of clips of each episode of the batch in an update."""
    batch_size: Count = 8
    """Number of episodes that are simulated together."""
    demonstrations: Count = 10
    """Number of demonstrations that the first policy is fitted to."""
    scenes: Count = 32
    """Number of scenes of the training."""
    first_scene: Seed = 300
    """Seed of the first scene of the training; the shipped model was trained on seeds from 1000."""
    tests: Count = 24
    """Number of scenes in which the policies are judged."""
    first_test: Seed = 500
    """Seed of the first of these scenes."""
    seed: Seed = 0
    """Seed of demonstrations and training."""


@dataclass(frozen=True, kw_only=True)
class Hyperparameters:
    """Hyperparameters of one training; the learning rate has a warm-up and a cosine decay."""

    steps: int
    """Number of training updates."""
    learning_rate: float
    """Peak learning rate."""
    warmup: int
    """Number of updates of linear warm-up."""
    optimizer: Literal["adamw", "muon"] = "muon"
    """Name of the optimizer."""
    batch_size: int = 4
    """Number of clips per update."""
    seed: int = 0
    """Seed of the initial weights, the order of the clips and the noise."""


@dataclass(frozen=True, kw_only=True)
class Embodiment(Checked):
    """Train on human hands, then on a few robot clips: all weights, or a LoRA.

    Another model is trained only on the robot clips. With --robot, one more is trained on as many
    human clips that were converted to clips of that robot (`egosim robot`). Prints the scores of
    each model on held-out robot clips. Writes report.json, contact_sheet.png and curves.png. The
    same command resumes an interrupted experiment.
    """

    out: Path
    """Folder of the run; each training has a subfolder."""
    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Folder of weights with the autoencoder; by default the shipped ones."""
    human_scenes: Count = 400
    """Number of scenes with human hands to train on, one clip each."""
    robot_scenes: Count = 24
    """Number of robot scenes to train on, one clip each."""
    held_out: Count = 24
    """Number of robot scenes to validate on and to generate, one clip each."""
    first_scene: Seed = 5000
    """Seed of the first scene; the shipped autoencoder was trained on seeds 1000 to 1999."""
    human: Hyperparameters = Hyperparameters(steps=1200, learning_rate=2e-3, warmup=50)
    """Training on human clips, from random weights."""
    full: Hyperparameters = Hyperparameters(steps=200, learning_rate=5e-4, warmup=10)
    """Training of all weights on robot clips, from the human model."""
    lora: Hyperparameters = Hyperparameters(
        steps=200, learning_rate=2e-3, warmup=10, optimizer="adamw"
    )
    """Training of a LoRA on robot clips, from the human model."""
    scratch: Hyperparameters = Hyperparameters(steps=200, learning_rate=2e-3, warmup=50)
    """Training on robot clips from random weights."""
    robot: str | None = None
    """Robot of the converted clips, a name in `egosim robot list`; None: no converted clips."""
    converted: Hyperparameters = Hyperparameters(steps=200, learning_rate=5e-4, warmup=10)
    """Training of all weights on converted clips, from the human model."""
    rank: Count = 16
    """Rank of the LoRA."""
    dropout: float = 0.15
    """Dropout probability of each condition in training."""
    steps: Count = 10
    """Denoising steps of the generated clips."""
    batch_size: Count = 8
    """Number of clips encoded, and generated, together."""


@dataclass(frozen=True, kw_only=True)
class Rank(ModelExperiment):
    """Rank candidate actions by a goal image, and compare with the ranking by true videos.

    Each goal is the last frame of one of several actions in a held-out scene. Prints how often the
    ranking by generated videos finds this action, and the rank correlation with the ranking by true
    videos. The ground truth through the autoencoder is another row. Writes report.json.
    """

    goals: Count = 24
    """Number of goals, each in a different scene."""
    candidates: int = 4
    """Number of actions per goal."""
    first_scene: Seed = 400
    """Seed of the first scene."""
    seeds: Count = 2
    """Number of repetitions of each clip with different noise."""


@dataclass(frozen=True, kw_only=True)
class DWM(Checked):
    """Train DWM and its ablations in miniature on static versions of tabletop clips, and compare.

    Trains an autoencoder, an inpainting base, an image-to-video base, and from the bases DWM, a
    model without hands and the ablations. Prints a table for moving cameras and one for fixed
    cameras, with the paper's figures. Writes report.json and contact sheets. The same command
    resumes an interrupted experiment.
    """

    out: Path
    """Folder of the run; each training has a subfolder."""
    config: str = "dwm_tabletop"
    """Name of the model."""
    only: tuple[str, ...] = ()
    """Models to train and compare, besides DWM; by default all."""
    moving_scenes: Count = 240
    """Number of scenes with a moving camera to train on, one clip each."""
    fixed_scenes: Count = 96
    """Number of scenes with a fixed camera to train on, one clip each."""
    held_out: Count = 24
    """Number of held-out scenes with a moving camera, and with a fixed one."""
    first_scene: Seed = 20000
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
    rank: Count | None = 48
    """Rank of the LoRA that adapts a base; None: all weights are trained."""
    products: Literal["bfloat16"] | None = "bfloat16"
    """Dtype of the factors of matrix products in the denoisers; None: the model's."""
    text_dropout: float = 0.1
    """Dropout probability of the prompt in training."""
    seeds: Count = 2
    """Number of repetitions of each clip with different noise."""
    steps: Count = 4
    """Denoising steps of the generated clips."""
    strength: float = 0.75
    """Strength of SDEdit: fraction of the steps, from the noised static video."""
    batch_size: Count = 8
    """Number of clips encoded, and generated, together."""


@dataclass(frozen=True, kw_only=True)
class RealTiny:
    """Train `real_tiny` on the train split, generate both splits, compare, and draw a sheet."""

    metadata: Path
    """CSV or JSONL with EgoSim's columns, including video and split; clips of 61 frames."""
    out: Path
    """Folder of the run."""
    start: tuple[int, ...] = (0, 22, 44)
    """First frames of the generated windows."""
    seed: int = 0
    """Seed of the generated clips."""
    batch_size: int = 5
    """Number of clips generated together."""


@dataclass(frozen=True, kw_only=True)
class Debug:
    """Do the same with the model `debug` on synthetic clips: a test run of a few minutes."""

    out: Path
    """Folder of the run."""
    steps: int = 20
    """Number of updates of the autoencoder, and of the denoiser."""
    seed: int = 0
    """Seed of the generated clips."""
