"""Hyper-parameters of a training, and its optax optimizer.

The optimizer chains gradient clipping and AdamW or Muon under a learning-rate schedule.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from optax.contrib import MuonDimensionNumbers, muon

from egosim_jax.train.grouped import group_dimensions, grouped
from egosim_jax.train.metric_writers import EXTRAS, check_installed
from egosim_jax.types import InputError, MeshConfig, check_counts, check_seed

WeightsDtype = Literal["float32", "bfloat16", "float16"]
"""Dtype of written weights."""


@dataclass(frozen=True, kw_only=True)
class OptimizerConfig:
    """Optimizer, learning-rate schedule and guard against bad gradients."""

    name: Literal["adamw", "muon"] = "adamw"
    """Name of the optimizer.

    `muon` orthogonalizes the updates of matrices and convolutions and uses Adam for the rest."""
    learning_rate: float = 1e-5
    """Peak learning rate."""
    warmup_steps: int = 0
    """Updates of linear warm-up from zero."""
    schedule: Literal["constant", "cosine", "cosine_restarts"] = "constant"
    """Learning rate after the warm-up.

    `cosine` decays to a twentieth of the peak; `cosine_restarts` to 0 in each of its `cycles`."""
    cycles: int | None = None
    """Number of cycles of `cosine_restarts`; None: 1."""
    weight_decay: float = 0.0
    """Decoupled weight decay of matrices and kernels; biases and norms have none."""
    b1: float = 0.9
    """Adam's decay of the first moment."""
    b2: float = 0.999
    """Adam's decay of the second moment."""
    clip_grad_norm: float = 1.0
    """Maximum global norm of the gradient; longer gradients are scaled down to it."""
    skip_grad_norm_factor: float | None = None
    """Skip an update whose gradient norm exceeds this multiple of the running mean; None: never."""
    ema_decay: float | None = None
    """Decay of the moving average of the weights (EMA), for instance 0.9999; None: no EMA.

    Validation uses the EMA, and it is written. It takes as much memory as the weights. The
    decay is warmed up (`ema_decay_at`)."""

    def __post_init__(self) -> None:
        for name in ("learning_rate", "clip_grad_norm"):
            if getattr(self, name) <= 0:
                raise InputError(f"{name} must be positive, not {getattr(self, name)}.")
        check_counts({"cycles": self.cycles})
        if self.cycles is not None and self.schedule != "cosine_restarts":
            raise InputError(
                f"Only the schedule cosine_restarts has cycles, not {self.schedule}: omit them, or "
                f"choose it. {self.cycles} were given. (cycles)"
            )
        factor, decay = self.skip_grad_norm_factor, self.ema_decay
        if factor is not None and factor <= 1:
            raise InputError(f"skip_grad_norm_factor must be above 1, not {factor}.")
        if decay is not None and not 0 < decay < 1:
            raise InputError(f"ema_decay must be between 0 and 1, not {decay}.")

    def ema_decay_at(self, step: jax.Array) -> jax.Array:
        """Return the decay of the moving average at an update; the first is 0.1.

        It is min(d, (1 + n) / (10 + n)) at update n, so the start is soon forgotten, whatever the
        decay d (Abadi et al. 2016, `tf.train.ExponentialMovingAverage`).
        """
        return jnp.minimum(self.ema_decay or 0.0, (1 + step) / (10 + step))


@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Training hyper-parameters: duration, batch, optimizer, devices, checkpoints and logs."""

    steps: int
    """Total number of updates."""
    batch_size: int = 32
    """Examples per update, over all devices."""
    grad_accum_steps: int = 1
    """Parts of a batch whose gradients are computed one after the other, to save memory."""
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    """Optimizer and learning-rate schedule."""
    mesh: MeshConfig = field(default_factory=MeshConfig)
    """Shape of the device mesh."""
    seed: int = 0
    """Seed of the initial weights, the data order and the noise."""
    log_every: int = 10
    """Updates between log lines."""
    save_every: int = 500
    """Updates between checkpoints."""
    validate_every: int = 500
    """Updates between validations."""
    sample_every: int | None = None
    """Updates between sample clips; None: no sample clips."""
    keep: int = 2
    """Number of newest checkpoints to keep."""
    keep_every: int | None = None
    """Also keep the checkpoints whose step is a multiple of this."""
    fallback: bool = False
    """If the newest checkpoint is damaged, resume from the previous one."""
    workers: int = 0
    """Number of processes that load data; 0: threads of the training process."""
    hang_timeout_s: float = 300.0
    """Minimum seconds without a finished update before a run exits with code 70.

    The wait must also exceed ten times the median time of an update."""
    tensorboard: bool = False
    """Also write metrics for TensorBoard, to OUT/tensorboard."""
    wandb: str | None = None
    """Weights & Biases project that also gets the metrics."""

    def __post_init__(self) -> None:
        counts = ("steps", "batch_size", "grad_accum_steps")
        every = ("log_every", "save_every", "validate_every", "sample_every", "keep_every")
        check_counts({name: getattr(self, name) for name in (*counts, *every, "keep")})
        check_seed(self.seed)

    def check_packages(self) -> None:
        """Raise `InputError` if a metric writer needs a package that is not installed."""
        for extra in EXTRAS:
            if getattr(self, extra):
                check_installed(extra)


@dataclass(frozen=True, kw_only=True)
class CriticConfig:
    """Training of a distillation's critic, which follows what the student makes."""

    updates: int = 5
    """Updates of the critic before each update of the student."""
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    """Optimizer and learning-rate schedule of the critic."""

    def __post_init__(self) -> None:
        check_counts({"critic.updates": self.updates})


RESUME_MUTABLE = (
    "mesh", "grad_accum_steps", "log_every", "save_every", "validate_every", "sample_every", "keep",
    "keep_every", "fallback", "workers", "hang_timeout_s", "tensorboard", "wandb",
)  # fmt: skip
"""Fields of `TrainConfig` that may change on resume: they do not affect the result."""


def resume_mutable(*names: str) -> tuple[str, ...]:
    """Return the dotted paths of `RESUME_MUTABLE` below fields of these names."""
    return tuple(f"{name}.{free}" for name in names for free in RESUME_MUTABLE)


def numerics_only(value: Any, path: str) -> Iterator[str]:
    """Yield the dotted paths, below `path`, of the fields that affect only numerics.

    They may also change on resume. A config class lists such fields in its class variable
    `numerics_only`: dtype, rematerialization, kernel.
    """
    if is_dataclass(value):
        yield from (f"{path}.{name}" for name in getattr(value, "numerics_only", ()))
        for part in fields(value):
            yield from numerics_only(getattr(value, part.name), f"{path}.{part.name}")


def learning_rate(config: OptimizerConfig, steps: int) -> optax.Schedule:
    """Return the learning rate as a function of the number of finished updates.

    Skipped updates count, so that the last update of every run has the last rate.
    """
    peak, warmup = config.learning_rate, config.warmup_steps
    if config.schedule == "cosine":
        return optax.warmup_cosine_decay_schedule(
            0.0 if warmup else peak, peak, warmup, max(steps, warmup + 1), end_value=peak / 20
        )
    after = optax.constant_schedule(peak)
    if config.schedule == "cosine_restarts":
        rest, cycles = max(steps - warmup, 1), config.cycles or 1

        def restarted(count: Any) -> Any:
            """Return the learning rate `count` updates after the warm-up."""
            share = jnp.minimum(count / rest, 1.0)
            # Modulo 1 would restart at the peak after the last update, which must end at 0.
            angle = jnp.where(share < 1, cycles * share % 1.0, 1.0)
            return peak * 0.5 * (1 + jnp.cos(jnp.pi * angle))

        after = restarted
    ramp = optax.linear_schedule(0.0 if warmup else peak, peak, warmup)
    return optax.schedules.join_schedules([ramp, after], [warmup])


def make_optimizer(config: OptimizerConfig) -> optax.GradientTransformation:
    """Return the optax transformation at the learning rate 1; the update multiplies by the rate."""
    if config.name == "muon":
        rule = muon(
            1.0,
            weight_decay=config.weight_decay,
            adam_b1=config.b1,
            adam_b2=config.b2,
            consistent_rms=0.2,  # as large as an AdamW update: both share one learning rate
            muon_weight_dimension_numbers=group_dimensions,
        )
        clip = optax.clip_by_global_norm(config.clip_grad_norm)
        return grouped(optax.chain(clip, rule), _dimensions)
    rule = optax.adamw(
        1.0,
        config.b1,
        config.b2,
        weight_decay=config.weight_decay,
        mask=lambda params: _map(lambda leaf: _dimensions(leaf) is not None, params),
    )
    return optax.chain(optax.clip_by_global_norm(config.clip_grad_norm), rule)


def _dimensions(leaf: nnx.Variable) -> MuonDimensionNumbers | None:
    """Return the input and output axes of a kernel `[layers?, ..., in, out]`, else None."""
    axes = leaf.get_metadata().get("axes", ())
    stacked = axes[:1] == ("layers",)
    rank = len(leaf.shape)
    if rank - stacked < 2 or "vocab" in axes:
        return None
    return MuonDimensionNumbers(tuple(range(int(stacked), rank - 1)), rank - 1)


def _map(function: Any, params: Any) -> Any:
    is_variable = lambda leaf: isinstance(leaf, nnx.Variable)  # noqa: E731
    return jax.tree.map(lambda leaf: leaf.replace(function(leaf)), params, is_leaf=is_variable)
