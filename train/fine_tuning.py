"""Training the denoiser of a large model further, on latents that `egosim data encode` made."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from egosim_jax.command import DONE
from egosim_jax.conditioning.dropout import ConditionDropout
from egosim_jax.models.attention import Kernel
from egosim_jax.models.wan.config import Remat
from egosim_jax.train.config import Recipe, Training
from egosim_jax.train.update import Stage

if TYPE_CHECKING:
    from egosim_jax.networks import ModelConfig, Networks


@dataclass(frozen=True, kw_only=True)
class FineTuning(Recipe):
    """Train a denoiser from weights, all of it or a LoRA, on cached latents.

    Writes OUT/weights, a folder that is complete, or OUT/lora.safetensors; beside it the log,
    checkpoints and sample clips. The same command, started again, resumes, on other devices, too.
    """

    latents: Path
    """Folder of latents shards."""
    weights: Path
    """Weights folder to start from; its encoders must be those that made the latents."""
    out: Path
    """Folder of the run."""
    config: str
    """Name of the model."""
    training: Training
    """How long, how fast and how often."""
    validation: Path | None = None
    """Folder of latents shards to validate on, and to make sample clips of."""
    rank: int | None = None
    """Train a LoRA of this rank on the blocks' linear layers; the weights stay."""
    times: Literal["uniform", "logit-normal", "diffsynth"] = "diffsynth"
    """How noise levels are drawn and weighted."""
    dropout: ConditionDropout = field(default_factory=ConditionDropout)
    """How often each condition is hidden."""
    remat: Remat | None = None
    """What the backward pass computes again, if not what the model says."""
    attention: Kernel | None = None
    """Attention kernel, if not the model's."""
    dtype: Literal["float32", "bfloat16"] | None = None
    """Dtype to compute in, if not the model's; weights and moments are float32 in any case."""
    samples: int = 2
    """Clips of the validation that are generated every `sample_every` updates."""

    def stages(self) -> Mapping[str, Stage]:
        """The denoiser's only."""
        from egosim_jax.diffusion.objective import Objective
        from egosim_jax.train.tasks.denoising import Denoising

        model = self._model()
        task = Denoising(
            model=model,
            objective=Objective(schedule=model.schedule, times=self.times),
            dropout=self.dropout,
            rank=self.rank,
        )
        return {"training": Stage(task, self.training)}

    def train(self) -> int:
        """Check the latents, train, write the weights."""
        from egosim_jax.train.encode import check_encoders
        from egosim_jax.train.loop import train
        from egosim_jax.train.monitor import Samples

        model = self._model()
        for shards in (self.latents, self.validation):
            if shards is not None:
                check_encoders(shards, model, self.weights)
        trained = train(
            *self.stages()["training"],
            data=self.latents,
            validation=self.validation,
            out=self.out,
            weights=self.weights,
            samples=self.validation
            and Samples(model=model, latents=self.validation, vae=self.weights, count=self.samples),
        )
        print(write_trained(trained, self.out, model=model, start=self.weights))
        return DONE

    def _model(self) -> ModelConfig:
        from egosim_jax import configs

        changes = {"remat": self.remat, "attention": self.attention, "dtype": self.dtype}
        model = configs.get(self.config).at(self.weights)
        given = {name: value for name, value in changes.items() if value is not None}
        return replace(model, dit=replace(model.dit, **given))


def write_trained(trained: Networks, out: Path, *, model: ModelConfig, start: Path) -> Path:
    """Write OUT/lora.safetensors, if that was trained, or OUT/weights, which is then complete.

    `start` is the weights folder that a LoRA is for, or that has the networks that stayed. All
    processes call this alike.
    """
    import jax

    from egosim_jax.io import weights
    from egosim_jax.models import lora

    if deltas := lora.deltas_of(trained.dit):
        path, base = out / "lora.safetensors", weights.hashes(start)["dit"]
        if jax.process_index() == 0:
            weights.write(path, lora.tensors(deltas), metadata=lora.about(model.name, base=base))
        return path
    folder = out / "weights"
    for name, network in trained.parts().items():
        weights.save(folder / f"{name}.safetensors", network, dtype=model.dit.dtype)
    if jax.process_index() == 0:
        weights.link_others(folder, start)
    return folder
