"""Variants of the trainings of `tabletop`, at equal processor seconds and from the same weights.

    python -m tests.benchmarks.compare_trainings vae \
        --frames runs/tabletop/frames --variants continued lpips decoder
    python -m tests.benchmarks.compare_trainings denoiser \
        --latents runs/tabletop/latents --variants float32 bfloat16

A variant makes as many updates as its share of processor seconds allows, by the seconds of its
first ones; its learning rate decays to the end of them. Compiling is not counted. Then it is judged
on held-out scenes: the VAE by what it reconstructs, the denoiser by its validation loss and, with
`--scenes`, by what it generates. A row is printed for each, and kept in OUT/rows.jsonl, whose
variants are not repeated.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from flax import nnx
from jaxtyping import Array, Float, Key

from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.data.shards import ShardReader
from egosim_jax.diffusion.objective import Objective, sample_keys
from egosim_jax.diffusion.process import Process
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.experiments import scenes
from egosim_jax.generation.generator import Generator
from egosim_jax.io.weights import place
from egosim_jax.sharding import batch_sharding, make_mesh
from egosim_jax.train.loop import make_batches, validation_batches
from egosim_jax.train.recipes import TABLETOP, TABLETOP_VAE
from egosim_jax.train.task import Stage
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.train.tasks.few_steps import FewSteps
from egosim_jax.train.update import Programs, TrainState, mean_validation
from egosim_jax.types import InputError
from tests.benchmarks.critic import Adversarial
from tests.benchmarks.routing import Routing

SHIPPED = Path(__file__).parents[2] / "egosim_jax" / "weights" / "tabletop"
PROBE = 6
"""Number of updates that are timed for a variant; the first two do not count."""
FIRST_SCENE = 100
"""Seed of the first held-out scene."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a comparison."""

    what: tyro.conf.Positional[Literal["vae", "denoiser"]]
    """Training to compare."""
    variants: tuple[str, ...]
    """Names of the variants (`VAES`, `DENOISERS`)."""
    out: Path = Path("runs/compare")
    """Folder of the rows and of the weights."""
    frames: Path | None = None
    """Folder of decoded clips, `train` and `test`, for the VAE."""
    latents: Path | None = None
    """Folder of latents, `train` and `test`, for the denoiser."""
    weights: Path = SHIPPED
    """Weights folder that every variant starts from, unless its sizes differ."""
    core_seconds: float = 300.0
    """Processor seconds of each variant."""
    learning_rate: float = 5e-4
    """Peak learning rate of every variant."""
    scenes: int = 12
    """Held-out scenes of human hands to judge by; 0: the denoiser's validation loss only."""
    sampling_steps: int = 4
    """Denoising steps of the scenes that are generated."""


VAES: Mapping[str, Mapping[str, Any]] = {
    "continued": {"perceptual_weight": 0.0},
    "lpips": {},
    "lpips 0.03": {"perceptual_weight": 0.03},
    "lpips 0.3": {"perceptual_weight": 0.3},
    "decoder": {"part": "decoder"},
    "decoder 0.3": {"part": "decoder", "perceptual_weight": 0.3},
    "decoder, motion 4": {"part": "decoder", "motion_weight": 4.0, "stream_probs": (1, 0, 0)},
    "all frames": {"perceptual_frames": 17},
    "large crops": {"crop": (96, 80)},
    "adversarial": {"part": "decoder", "critic": True},
}
"""Changes of the recipe `tabletop_vae`; `adversarial` has a critic, too (`critic.py`)."""
DENOISERS: Mapping[str, Mapping[str, Any]] = {
    "float32": {},
    "bfloat16": {"dit": {"products": "bfloat16"}},
    "ema 0.99": {"optimizer": {"ema_decay": 0.99}},
    "logit-normal": {"times": "logit-normal"},
    "shift 1": {"shift": 1.0},
    "shift 5": {"shift": 5.0},
    "change 4": {"change": 4.0},
    "bfloat16, change 4": {"dit": {"products": "bfloat16"}, "change": 4.0},
    "bfloat16, change 4, own steps": {
        "dit": {"products": "bfloat16"},
        "change": 4.0,
        "times": "own steps",
    },
    "bfloat16, change 4, own inputs": {
        "dit": {"products": "bfloat16"},
        "change": 4.0,
        "task": FewSteps,
    },
    "batch 4": {"batch": 4},
    "batch 16": {"batch": 16},
    "routing": {"task": Routing},
    "wide": {"dit": {"dim": 384, "ffn_dim": 1152, "heads": 6}},
    "deep": {"dit": {"layers": 12}},
    "random": {"random": True},
}
"""Changes of the recipe `tabletop`; `wide`, `deep` and `random` start from random weights.

`routing` leaves half of the tokens out of most blocks (`routing.py`); `own steps` trains at the
noise levels that the sampler visits alone (`OwnSteps`), `own inputs` at those, and on what the
sampler has there (`few_steps.py`)."""


@dataclass(frozen=True, kw_only=True)
class OwnSteps(Objective):
    """The objective at the noise levels of a sampler's steps alone, each as likely."""

    steps: int
    """Number of its denoising steps."""

    def sample_times(
        self, process: Process, key: Key[Array, " *keys"], batch: int
    ) -> Float[Array, " b"]:
        """Draw one of the steps for each sample."""
        times = jnp.asarray(process.times(self.steps)[:-1], jnp.float32)
        draw = jax.vmap(lambda key: jax.random.randint(key, (), 0, self.steps))
        return times[draw(sample_keys(key, batch))]


@dataclass(frozen=True)
class Trained:
    """A variant after its training."""

    networks: Any
    """Trained networks."""
    row: dict[str, float] = field(default_factory=dict)
    """Measured numbers by name."""


def main(settings: Settings) -> None:
    """Train and judge every variant that has no row yet."""
    settings.out.mkdir(parents=True, exist_ok=True)
    rows = settings.out / "rows.jsonl"
    done = {json.loads(line)["variant"] for line in rows.open()} if rows.exists() else set()
    known = VAES if settings.what == "vae" else DENOISERS
    if unknown := [name for name in settings.variants if name not in known]:
        raise InputError(f"Unknown variants {unknown}: known are {', '.join(known)}. (--variants)")
    if (settings.frames if settings.what == "vae" else settings.latents) is None:
        raise InputError("The VAE needs --frames, the denoiser --latents.")
    judge = Judge(settings)
    if "start" not in done and settings.scenes:
        write(rows, {"variant": "start", **judge.folder(settings.weights)})
    for name in settings.variants:
        if name not in done:
            train = train_vae if settings.what == "vae" else train_denoiser
            trained = train(settings, known[name])
            write(rows, {"variant": name, **trained.row, **judge(trained)})
            trained.networks.save(settings.out / name.replace(" ", "_"), dtype="float16")


def write(rows: Path, row: Mapping[str, Any]) -> None:
    """Print a row, and append it."""
    line = json.dumps({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()})
    print(line, flush=True)
    with rows.open("a") as file:
        file.write(line + "\n")


def train_vae(settings: Settings, changes: Mapping[str, Any]) -> Trained:
    """Refine the VAE."""
    assert settings.frames is not None
    optimizer = replace(TABLETOP_VAE.vae.optimizer, learning_rate=settings.learning_rate)
    changes = dict(changes)
    critic = changes.pop("critic", False)
    recipe = replace(TABLETOP_VAE, vae=replace(TABLETOP_VAE.vae, optimizer=optimizer), **changes)
    task, training = recipe.stages()["vae"]
    if critic:
        task = Adversarial(**vars(task))
    return spend(settings, Stage(task, training), settings.frames, random=False)


def train_denoiser(settings: Settings, changes: Mapping[str, Any]) -> Trained:
    """Train the denoiser and its encoders further."""
    assert settings.latents is not None
    model = configs.get("tabletop")
    model = replace(model, dit=replace(model.dit, **changes.get("dit", {})))
    if "shift" in changes:
        model = replace(model, process=replace(model.process, shift=changes["shift"]))
    training = TABLETOP.denoiser
    optimizer = replace(
        training.optimizer,
        learning_rate=settings.learning_rate,
        warmup_steps=20,
        **changes.get("optimizer", {}),
    )
    training = replace(training, optimizer=optimizer, batch_size=changes.get("batch", 8))
    kind = changes.get("task", Denoising)
    times = changes.get("times", "uniform")
    own = OwnSteps(steps=settings.sampling_steps)
    task = kind(
        model=model,
        dropout=TABLETOP.dropout,
        objective=own if times == "own steps" else Objective(times=times),
        change_loss_weight=changes.get("change", 0.0),
    )
    sizes = {"dim", "layers"} & changes.get("dit", {}).keys()
    random = bool(sizes) or changes.get("random", False)
    return spend(settings, Stage(task, training), settings.latents, random=random)


def spend(settings: Settings, stage: Stage, data: Path, *, random: bool) -> Trained:
    """Train for the processor seconds; return the networks and the validation's metrics."""
    probe = list(run(settings, stage, data, PROBE, random=random))
    each = float(np.median(probe[-1][2][2:]))
    steps = max(PROBE, round(settings.core_seconds / each))
    programs, state, spent, frozen = list(run(settings, stage, data, steps, random=random))[-1]
    row = {"updates": steps, "core_seconds": sum(spent), "core_seconds_each": sum(spent) / steps}
    networks = nnx.merge(programs.graph, state.eval_params, frozen)
    with jax.set_mesh(make_mesh(stage.training.mesh)):
        sharding = batch_sharding(jax.sharding.get_mesh())
        source = ShardReader(data / "test")
        means, _ = mean_validation(
            programs.validate(state.eval_params, frozen, batch)
            for batch in validation_batches(source, stage.task, stage.training, sharding)
        )
    return Trained(networks, {**row, **means})


def arrays(batch: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return a batch without the numbers of its records."""
    return {name: value for name, value in batch.items() if name != "record"}


def run(
    settings: Settings, stage: Stage, data: Path, steps: int, *, random: bool
) -> Iterator[tuple[Programs, TrainState, list[float], Any]]:
    """Train for a number of updates; yield the end: state, and processor seconds of each update."""
    training = replace(stage.training, steps=steps)
    warmup = min(training.optimizer.warmup_steps, steps // 5)
    training = replace(training, optimizer=replace(training.optimizer, warmup_steps=warmup))
    mesh = make_mesh(training.mesh)
    with jax.set_mesh(mesh):
        programs = Programs.of(stage.task, training, mesh)
        if random:
            state, frozen = jax.jit(programs.create)(), programs.frozen
        else:
            state, frozen = start(settings, programs)
        source, spent = ShardReader(data / "train"), []
        sharding = batch_sharding(mesh)
        with closing(make_batches(source, stage.task, training, sharding)) as batches:
            update = programs.update.lower(state, frozen, arrays(next(batches))).compile()
            for _ in range(steps):
                before = time.process_time()
                state, metrics = update(state, frozen, arrays(next(batches)))
                jax.block_until_ready(metrics["loss"])
                spent.append(time.process_time() - before)
    yield programs, state, spent, frozen


def start(settings: Settings, programs: Programs) -> tuple[TrainState, Any]:
    """Return state and frozen weights of the folder of weights; a critic's are random."""
    frozen, params = programs.frozen, programs.state.params
    in_folder = lambda path, _: path[0] != "critic"  # noqa: E731
    wanted, _ = nnx.split_state(nnx.merge_state(frozen, params), in_folder, ...)
    shardings = nnx.merge_state(programs.frozen_sharding, programs.state_sharding.params)
    shardings, _ = nnx.split_state(shardings, in_folder, ...)
    placed = place(settings.weights, wanted, shardings)
    paths = {path for path, _ in nnx.to_flat_state(frozen)}
    frozen, loaded = nnx.split_state(placed, lambda path, _: path in paths, ...)
    return jax.jit(programs.create)(loaded), frozen


class Judge:
    """Scores of networks on held-out scenes, which are made once."""

    def __init__(self, settings: Settings):
        self.settings, self.model = settings, configs.get("tabletop")
        seeds = range(FIRST_SCENE, FIRST_SCENE + settings.scenes)
        spec = self.model.video
        self.clips = [scenes.HeldOutClip.make(seed, spec, "human") for seed in seeds]

    def folder(self, weights: Path) -> dict[str, float]:
        """Return the scores of a folder of weights."""
        return self.score(self.model, Networks.load(self.model, weights))

    def __call__(self, trained: Trained) -> dict[str, float]:
        """Return the scores of a trained variant, with the other networks as at the start."""
        if not self.clips:
            return {}
        parts = trained.networks.parts()
        model = self.model
        if "dit" in parts:
            model = replace(model, dit=parts["dit"].config)
        others = [name for name in ("dit", "vae", "text", "image") if name not in parts]
        given = Networks.load(model, self.settings.weights, only=others)
        return self.score(model, Networks(**given.parts(), **parts))

    def score(self, model: ModelConfig, networks: Networks) -> dict[str, float]:
        """Return means over the scenes."""
        generator = Generator(replace(model, steps=self.settings.sampling_steps), networks)
        make: Callable[..., Iterator[np.ndarray]] = (
            scenes.reconstruct if self.settings.what == "vae" else scenes.generate
        )
        videos = list(make(generator, self.clips, batch_size=4))
        found = scenes.evaluate(self.clips, videos)
        vgg = lpips.Lpips.load("vgg")
        for clip, video, row in zip(self.clips, videos, found, strict=True):
            ours, theirs = video[1::4], clip.clip.frames[1::4]
            row["lpips_vgg"] = float(lpips.frame_distances(vgg, ours, theirs).mean())
        return {name: float(np.nanmean([row[name] for row in found])) for name in found[0]}


if __name__ == "__main__":
    main(tyro.cli(Settings))
