"""Fine-tuning of a denoiser on latents that `egosim data encode` wrote."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from egosim_jax.conditioning.condition import ConditionDropout
from egosim_jax.models.attention import Kernel
from egosim_jax.models.chunks import Chunks
from egosim_jax.models.layers import Products
from egosim_jax.runtime.command import ExitCode, HelpGroups
from egosim_jax.runtime.terminal import print_line
from egosim_jax.train.config import TrainConfig
from egosim_jax.train.recipe import Recipe
from egosim_jax.train.task import Stage
from egosim_jax.types import InputError, check_counts

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig, Networks
    from egosim_jax.models.lora import Change


@dataclass(frozen=True, kw_only=True)
class FineTuning(Recipe):
    """Train a denoiser from given weights, all of it or a LoRA, on cached latents.

    Writes OUT/weights, a complete weights folder, or OUT/lora.safetensors, and the log, checkpoints
    and sample clips. The same command resumes an interrupted run, also on other devices.
    """

    help_groups: ClassVar[HelpGroups] = {
        "preflight report": ("json", "search"),
        "object stores": ("cache", "cache_gb"),
        "method": (
            "rank", "lora", "chunks", "times", "sampler_steps", "max_difference",
            "change_loss_weight", "navigation", "remat", "attention", "dtype", "products",
            "samples",
        ),
    }  # fmt: skip
    config: str
    """Name of the model."""
    training: TrainConfig
    """Hyper-parameters of the denoiser's training."""
    latents: str | Path | None = None
    """Folder of latents shards, or its address: s3://BUCKET/FOLDER or gs://BUCKET/FOLDER."""
    weights: Path | None = None
    """Weights folder to start from, with the encoders that made the latents."""
    validation: str | Path | None = None
    """Folder or address of latents shards for validation and sample clips."""
    cache: Path | None = None
    """Folder for copies of shards at addresses; None: in the user's cache folder."""
    cache_gb: int = 1000
    """Maximum size of these copies in GB."""
    rank: int | None = None
    """Rank of a LoRA to train instead of the weights."""
    lora: Path | None = None
    """LoRA of these weights to train further, a run's lora.safetensors.

    `egosim convert lora --layout egosim` writes such a file from a LoRA of another project."""
    chunks: tuple[int, ...] | None = None
    """Latent frames of each chunk of a causal student; None: the model's.

    The student learns from the clean chunks of the clip before each chunk (teacher forcing)."""
    times: Literal["uniform", "logit-normal", "diffsynth"] = "diffsynth"
    """Distribution and weighting of the noise levels."""
    sampler_steps: int | None = None
    """Half of the samples have a noise level that a sampler of so many steps visits; None: none."""
    max_difference: float | None = None
    """Ignore elements whose prediction is further than this from the target; None: ignore none."""
    dropout: ConditionDropout = field(default_factory=ConditionDropout)
    """Dropout rate of each condition."""
    change_loss_weight: float = 0.0
    """Additional loss weight where the clip differs from its prior: hands and moved objects."""
    navigation: float = 0.0
    """Rate of samples without hands whose target is the prior (DWM's regularizer)."""
    remat: str | None = None
    """Rematerialization in the backward pass (`remat_levels`); None: the model's."""
    attention: Kernel | None = None
    """Attention kernel; None: the model's."""
    dtype: Literal["float32", "bfloat16"] | None = None
    """Compute dtype; None: the model's. Trained weights and moments are always float32."""
    products: Products | None = None
    """Dtype of the factors of products; None: the model's."""
    samples: int = 2
    """Number of validation clips to generate every `sample_every` updates."""

    def stages(self) -> Mapping[str, Stage]:
        """Return the training of the denoiser."""
        from egosim_jax.diffusion.objective import Objective
        from egosim_jax.train.tasks.denoising import Denoising

        objective = Objective(
            times=self.times, max_difference=self.max_difference, sampler_steps=self.sampler_steps
        )
        return {"training": Stage(Denoising(objective=objective, **self.options()), self.training)}

    def options(self) -> dict[str, Any]:
        """Return the fields of every task that trains this recipe's model."""
        return {
            "model": self.model(),
            "dropout": self.dropout,
            "change_loss_weight": self.change_loss_weight,
            "rank": self.rank,
            "navigation": self.navigation,
        }

    @property
    def teacher_folder(self) -> Path | None:
        """Weights folder of the teacher of a distillation; None: the student at its start."""
        return None

    def train(self) -> int:
        """Check the latents, train, and write the weights."""
        out, latents, weights = self.require("out", "latents", "weights")
        from egosim_jax.io.weights import check_folder, check_trainable
        from egosim_jax.train.encode import check_encoders
        from egosim_jax.train.loop import train
        from egosim_jax.train.monitor import Samples

        model = self.model()
        check_folder(weights, model.name)
        check_trainable(weights)
        lora = self.check_lora(weights)
        latents = self._local_shards(latents)
        validation = None if self.validation is None else self._local_shards(self.validation)
        for shards in (latents, validation):
            if shards is not None:
                check_encoders(shards, model, weights)
        trained = train(
            *self.stages()["training"],
            data=latents,
            validation=validation,
            out=out,
            weights=weights,
            lora=lora,
            teacher=self.teacher_folder,
            samples=validation
            and Samples(model=model, latents=validation, vae=weights, count=self.samples),
        )
        print_line(write_trained(trained, out, model=model, start=weights, rank=self.rank))
        return ExitCode.DONE

    def check_lora(self, weights: Path) -> tuple[Path, Mapping[str, Change]] | None:
        """Return the LoRA to train further and its changes, if any.

        Raises `InputError` for a LoRA of other weights or in other names, or without `rank`.
        """
        if self.lora is None:
            return None
        from egosim_jax.convert.lora import check_base
        from egosim_jax.io.bounded import quote_path
        from egosim_jax.io.weights import hashes
        from egosim_jax.models.lora import read_own

        if self.rank is None:
            raise InputError(
                f"{self.lora} is trained further as a LoRA: give its rank. (--rank, --lora)"
            )
        convert = f"egosim convert lora {quote_path(self.lora)} --config {self.config} "
        convert += f"--layout egosim --base {quote_path(weights)} --out lora.safetensors"
        changes = read_own(self.lora, convert=convert)
        check_base(self.lora, [hashes(weights, only=["dit"])["dit"]])
        return self.lora, changes

    def _local_shards(self, shards: str | Path) -> Path:
        """Return a folder of shards; after a copy from a store, when all processes have theirs."""
        from egosim_jax.data.stores import local_shards
        from egosim_jax.train.distributed import wait_for_all

        check_counts({"--cache-gb": self.cache_gb})
        folder = local_shards(shards, cache=self.cache, limit=self.cache_gb * 10**9)
        if folder != Path(shards):
            wait_for_all(f"shards {shards}")
        return folder

    def model(self) -> ModelConfig:
        """Return the model's config with the options of this recipe.

        Raises `InputError` for an option that the model's denoiser lacks.
        """
        from egosim_jax import configs

        model = configs.get(self.config)
        model = model if self.weights is None else model.at(self.weights)
        changes = {
            "remat": self.remat,
            "attention": self.attention,
            "dtype": self.dtype,
            "products": self.products,
        }
        given = {name: value for name, value in changes.items() if value is not None}
        if unknown := sorted(given.keys() - set(model.dit.numerics_only)):
            options = ", ".join(f"--{name}" for name in unknown)
            raise InputError(f"The denoiser of {model.name} has no {options}: omit it.")
        levels = model.dit.remat_levels
        if self.remat is not None and self.remat not in levels:
            raise InputError(
                f"The denoiser of {model.name} has no rematerialization {self.remat}: it must be "
                f"one of {', '.join(levels)}. (--remat)"
            )
        # A refresh: the student has seen clean chunks, not the end of their denoising.
        chunks = model.chunks if self.chunks is None else Chunks(sizes=self.chunks, refresh=True)
        return replace(model, dit=replace(model.dit, **given), chunks=chunks)


def write_trained(
    trained: Networks, out: Path, *, model: ModelConfig, start: Path, rank: int | None
) -> Path:
    """Write OUT/lora.safetensors if `rank` is given, else a complete OUT/weights.

    Of a student, OUT/weights also has the LoRA and its base.

    `start` is the weights folder that the training started from: the base of the LoRA, or the
    source of untrained networks. All processes of the training call it with the same arguments.
    """
    import jax

    from egosim_jax.configs.model import metadata_of
    from egosim_jax.io import weights
    from egosim_jax.io.mapped import read_safetensors
    from egosim_jax.models import lora

    if rank is not None:
        path, base = out / "lora.safetensors", weights.hashes(start)["dit"]
        changes: dict[str, lora.Change] = {**lora.deltas_of(trained.dit)}
        before = read_safetensors(start / "dit.safetensors")
        for name, value in lora.full_weights(trained.dit, model.dit.also_train).items():
            if (gathered := weights.gather(value)) is not None:
                changes[name] = gathered - before[name].array().astype(gathered.dtype)
        if jax.process_index() == 0:
            weights.write(
                path,
                lora.tensors(changes),
                metadata={
                    **lora.metadata(model.name, base=base),
                    **metadata_of("dit", model.chunks),
                },
            )
            if model.chunks is not None:
                (folder := out / "weights").mkdir(exist_ok=True)
                weights.link_or_copy(path, folder / weights.STUDENT)
                weights.add_others(folder, start)
        return path
    folder = out / "weights"
    trained.save(folder, dtype=model.dit.dtype)
    if jax.process_index() == 0:
        weights.add_others(folder, start)
    return folder
