"""Distillation of a causal student of few steps, in two stages after teacher forcing.

    student_ar    FineTuning      each chunk from the clean chunks before it (`--chunks`)
    student_cd    Consistency     few steps: consistent predictions along the teacher's steps
    student_dmd   SelfForcing     on its own clips: regression, distribution matching

All roles of a stage share the weights that are not trained. With `rank` they are LoRAs of one
frozen base.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from egosim_jax.runtime.command import HelpGroups
from egosim_jax.train.config import CriticConfig
from egosim_jax.train.fine_tuning import FineTuning
from egosim_jax.train.task import Stage
from egosim_jax.types import InputError, check_counts

if TYPE_CHECKING:
    from egosim_jax.configs.model import ModelConfig
    from egosim_jax.models.chunks import Chunks


@dataclass(frozen=True, kw_only=True)
class ConsistencyDistillation(FineTuning):
    """Distill a causal student, trained by teacher forcing, into one of few steps.

    The teacher is the student at its start. Writes what `FineTuning` writes.
    """

    help_groups: ClassVar[HelpGroups] = {"distillation": ("points",), **FineTuning.help_groups}
    points: int = 48
    """Number of steps of the teacher's sampler."""

    def stages(self) -> Mapping[str, Stage]:
        """Return the distillation."""
        from egosim_jax.train.tasks.consistency import Consistency

        task = Consistency(points=self.points, **self.options())
        return {"training": Stage(task, self.training)}

    def train(self) -> int:
        """Check that the weights are a causal student's, and train."""
        (weights,) = self.require("weights")
        check_causal(self, self.lora or weights / "dit.safetensors")
        return super().train()


@dataclass(frozen=True, kw_only=True)
class SelfForcing(FineTuning):
    """Train a causal student on its own clips: regression, and matching of a teacher.

    The teacher makes clips at once. With `rank`, it is the base of the LoRA. Writes what
    `FineTuning` writes.
    """

    help_groups: ClassVar[HelpGroups] = {
        "distillation": ("teacher", "steps", "first_steps", "refresh", "matching", "regression"),
        **FineTuning.help_groups,
    }
    teacher: Path | None = None
    """Weights folder of the teacher; with `rank`, it is `weights`."""
    steps: int = 2
    """Denoising steps of a chunk."""
    first_steps: int | None = None
    """Denoising steps of the first chunk; None: as many as of the others."""
    refresh: bool = False
    """Compute keys and values of a finished chunk by one more pass."""
    matching: float = 1.0
    """Weight of distribution matching; 0: regression alone, without teacher and critic."""
    regression: float = 0.25
    """Weight of the squared distance to the recorded clip."""
    critic: CriticConfig = field(default_factory=CriticConfig)
    """Training of the critic."""

    def stages(self) -> Mapping[str, Stage]:
        """Return the training on own clips."""
        from egosim_jax.train.tasks.matching import Matching

        task = Matching(
            matching=self.matching,
            regression=self.regression,
            training=self.critic,
            **self.options(),
        )
        return {"training": Stage(task, self.training)}

    def model(self) -> ModelConfig:
        """Return the model's config with the student's chunks and steps."""
        check_counts({"--steps": self.steps, "--first-steps": self.first_steps})
        model = super().model()
        chunks = replace(student_chunks(model), first_steps=self.first_steps, refresh=self.refresh)
        return replace(model, chunks=chunks, steps=self.steps)

    def train(self) -> int:
        """Check student and teacher, and train."""
        from egosim_jax.io.weights import check_chunks

        (weights,) = self.require("weights")
        if self.matching and self.rank is None:
            (teacher,) = self.require("teacher")
            check_chunks(teacher / "dit.safetensors", None)
        if self.matching and self.rank is not None:
            check_chunks(weights / "dit.safetensors", None)
        if (self.rank is None) or self.lora is not None:
            check_causal(self, self.lora or weights / "dit.safetensors")
        return super().train()

    @property
    def teacher_folder(self) -> Path | None:
        """Weights folder of the teacher; the base of a LoRA."""
        return self.teacher if self.rank is None else self.weights


def check_causal(recipe: FineTuning, file: Path) -> None:
    """Raise `InputError` unless a file's weights are a student's with the recipe's chunks."""
    from egosim_jax.io.weights import check_chunks

    if recipe.lora is not None:
        recipe.check_lora(*recipe.require("weights"))
    check_chunks(file, str(student_chunks(recipe.model())))


def student_chunks(model: ModelConfig) -> Chunks:
    """Return the chunks of a student. Raises `InputError` for a model of whole clips."""
    if model.chunks is None:
        raise InputError(
            f"{model.name} makes clips at once: give the latent frames of the student's chunks. "
            "(--chunks)"
        )
    return model.chunks
