"""How a training is run, and what of that a resumed run may change."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from egosim_jax.logging import EXTRAS, check_installed
from egosim_jax.sharding import MeshConfig
from egosim_jax.train.optimizer import OptimizerConfig
from egosim_jax.types import check_counts, check_seed

if TYPE_CHECKING:
    from egosim_jax.train.step import Task


@dataclass(frozen=True, kw_only=True)
class Training:
    """How long, how fast and how often."""

    steps: int
    """Updates in all."""
    batch_size: int = 32
    """Examples per update, over all devices."""
    accumulate: int = 1
    """Parts in which an update takes its batch, one after the other, to save memory."""
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    """Update rule and learning rate."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """Layout of the devices."""
    seed: int = 0
    """Seed of the initial weights, the order of the data and the noise."""
    log_every: int = 10
    """Updates between lines of the log."""
    save_every: int = 500
    """Updates between checkpoints."""
    validate_every: int = 500
    """Updates between validations."""
    sample_every: int | None = None
    """Updates between sample clips; None: none are made."""
    keep: int = 2
    """Checkpoints to keep, the newest ones."""
    keep_every: int | None = None
    """Also keep the checkpoints whose step is a multiple of this."""
    fallback: bool = False
    """If the newest checkpoint is damaged, go on from the one before it."""
    workers: int = 0
    """Processes that prepare data; part of the data's order, so keep it when resuming."""
    patience: float = 300.0
    """Seconds without a finished step, and ten times what one takes, after which a run counts as
    hung and ends with exit code 70."""
    tensorboard: bool = False
    """Also write for TensorBoard, to OUT/tensorboard."""
    wandb: str | None = None
    """Project of Weights & Biases to log to, too."""

    def __post_init__(self) -> None:
        """Check that every count is positive and the seed in range."""
        counts = ("steps", "batch_size", "accumulate", "log_every", "save_every", "validate_every")
        optional = ("sample_every", "keep", "keep_every")
        check_counts({name: getattr(self, name) for name in (*counts, *optional)})
        check_seed(self.seed)

    def check_packages(self) -> None:
        """Raise `InputError` if a place that numbers should go to needs a package to install."""
        for extra in EXTRAS:
            if getattr(self, extra):
                check_installed(extra)


class Stage(NamedTuple):
    """A training of a recipe."""

    task: Task
    """What is trained."""
    training: Training
    """How long, how fast and how often."""


MAY_DIFFER = (
    "mesh", "accumulate", "log_every", "save_every", "validate_every", "sample_every", "keep",
    "keep_every", "fallback", "patience", "tensorboard", "wandb",
)  # fmt: skip
"""Fields of `Training` that a resumed run may change: they do not change what is computed."""
HOW_COMPUTED = tuple(f"task.model.dit.{name}" for name in ("dtype", "remat", "attention"))
"""Fields of a task that change how it is computed."""


def may_differ(*names: str) -> tuple[str, ...]:
    """What a resumed run may change, in fields of these names that are a `Training`."""
    return tuple(f"{name}.{free}" for name in names for free in MAY_DIFFER)
