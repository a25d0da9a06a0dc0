"""The optimizer of a run: a learning-rate schedule, clipping, and AdamW or Muon, all from optax."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import jax
import optax
from flax import nnx
from optax.contrib import MuonDimensionNumbers, muon

from egosim_jax.types import InputError


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
