"""How a training is run: its settings, its optimizer, and what all recipes have in common."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import jax
import optax
from flax import nnx
from optax.contrib import MuonDimensionNumbers, muon

from egosim_jax.metric_writers import EXTRAS, check_installed
from egosim_jax.sharding import MeshConfig
from egosim_jax.types import InputError, check_counts, check_seed

if TYPE_CHECKING:
    from egosim_jax.train.update import Stage


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """Update rule and learning rate."""

    rule: Literal["adamw", "muon"] = "adamw"
    """`muon` orthogonalises the updates of matrices and convolutions and uses Adam for the rest."""
    learning_rate: float = 1e-5
    """Peak learning rate."""
    warmup: int = 0
    """Steps of linear warm-up from zero."""
    decay: Literal["constant", "cosine"] = "constant"
    """After the warm-up: constant, or a cosine down to a twentieth of the peak."""
    weight_decay: float = 0.0
    """Decoupled weight decay, on matrices and kernels alone."""
    b1: float = 0.9
    """Adam's decay of the first moment."""
    b2: float = 0.999
    """Adam's decay of the second moment."""
    clip: float = 1.0
    """Largest global norm of the gradient."""
    spike: float | None = None
    """Leave an update out whose gradient is so many times as long as usual; None: none."""
    average: float | None = None
    """Decay of a moving average of the weights, for instance 0.9999, which is then what is
    validated and kept; None: no average, which saves its memory."""

    def __post_init__(self) -> None:
        """Check that rates are positive, and that what limits or decays does."""
        for name in ("learning_rate", "clip"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name} must be positive, not {getattr(self, name)}.")
        if self.spike is not None and self.spike <= 1:
            raise InputError(f"spike must be above 1, the usual length, not {self.spike}.")
        if self.average is not None and not 0 < self.average < 1:
            raise InputError(f"average must be between 0 and 1, not {self.average}.")


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


@dataclass(frozen=True, kw_only=True)
class Recipe(ABC):
    """A training that one command runs."""

    preflight: str | None = None
    """Train nothing, but compile each stage's update for a machine that need not be there, as in
    h200:8, v5p:2x2x2 or cpu:1, and say whether it fits. Needs no other option."""
    json: bool = False
    """With --preflight: print JSON."""
    search: bool = True
    """With --preflight: also compile the other settings that take the same batch, which takes
    minutes."""

    def run(self) -> int:
        """Train, unless a preflight was asked for."""
        if self.preflight is None:
            for stage in self.stages().values():
                stage.training.check_packages()
            return self.train()
        from egosim_jax.train.preflight import preflight

        return preflight(self.stages(), self.preflight, as_json=self.json, search=self.search)

    @abstractmethod
    def train(self) -> int:
        """Train to the end, or go on."""

    @abstractmethod
    def stages(self) -> Mapping[str, Stage]:
        """What is trained, by the names of the recipe's options."""


def learning_rate(config: OptimizerConfig, steps: int) -> optax.Schedule:
    """The learning rate by finished updates."""
    peak, warmup = config.learning_rate, config.warmup
    if config.decay == "cosine":
        return optax.warmup_cosine_decay_schedule(
            0.0 if warmup else peak, peak, warmup, max(steps, warmup + 1), end_value=peak / 20
        )
    return optax.schedules.join_schedules(
        [optax.linear_schedule(0.0 if warmup else peak, peak, warmup), lambda _: peak], [warmup]
    )


def make_optimizer(config: OptimizerConfig, steps: int) -> optax.GradientTransformation:
    """The transformation for a run of `steps` updates."""
    rate = learning_rate(config, steps)
    if config.rule == "muon":
        rule = muon(
            rate,
            weight_decay=config.weight_decay,
            adam_b1=config.b1,
            adam_b2=config.b2,
            consistent_rms=0.2,  # the size of an AdamW update, so that one rate serves both
            muon_weight_dimension_numbers=_matrices,
        )
    else:
        rule = optax.adamw(
            rate,
            config.b1,
            config.b2,
            weight_decay=config.weight_decay,
            mask=lambda params: _map(lambda leaf: _dimensions(leaf) is not None, params),
        )
    return optax.chain(optax.clip_by_global_norm(config.clip), rule)


def _matrices(params: Any) -> Any:
    return _map(_dimensions, params)


def _dimensions(leaf: nnx.Variable) -> MuonDimensionNumbers | None:
    """Inputs and outputs of a kernel `[layers?, ..., in, out]`, or None for anything else."""
    if isinstance(leaf.get_value(), optax.MaskedNode):  # optax asks again for its own part
        return None
    axes = leaf.get_metadata().get("axes", ())
    stacked = axes[:1] == ("layers",)
    rank = len(leaf.shape)
    if rank - stacked < 2 or "vocab" in axes:
        return None
    return MuonDimensionNumbers(tuple(range(int(stacked), rank - 1)), rank - 1)


def _map(function: Any, params: Any) -> Any:
    is_variable = lambda leaf: isinstance(leaf, nnx.Variable)  # noqa: E731
    return jax.tree.map(lambda leaf: leaf.replace(function(leaf)), params, is_leaf=is_variable)
