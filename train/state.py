"""The state of a training run: finished updates, weights and the optimizer's moments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import optax
from flax import nnx

from egosim_jax.train.optimizer import OptimizerConfig, make_optimizer

NORM_DECAY = 0.98
"""Of the running mean of gradient norms: it looks back some 50 updates."""


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Everything that an update changes."""

    step: jax.Array
    """Finished updates, with those that were left out, int32."""
    params: nnx.State
    """Trained weights in float32."""
    moments: Any
    """State of the optax transformation."""
    usual_norm: jax.Array
    """Geometric mean of the gradient norms of the last updates that were not left out, float32; 0
    before any."""
    left_out: jax.Array
    """Updates left out in a row, int32."""
    average: nnx.State | None
    """Exponential moving average of the weights, if there is one."""

    @classmethod
    def create(cls, params: nnx.State, config: OptimizerConfig, steps: int) -> TrainState:
        """The state before the first update of a run of `steps`."""
        return cls(
            step=jnp.int32(0),
            params=params,
            moments=make_optimizer(config, steps).init(params),
            usual_norm=jnp.float32(0),
            left_out=jnp.int32(0),
            average=None if config.average is None else jax.tree.map(jnp.copy, params),
        )

    def apply(
        self,
        gradients: nnx.State,
        norm: jax.Array,
        config: OptimizerConfig,
        optimizer: optax.GradientTransformation,
    ) -> TrainState:
        """The state after one more update by gradients of this norm."""
        updates, moments = optimizer.update(gradients, self.moments, self.params)
        params: Any = optax.apply_updates(self.params, updates)
        average: Any = self.average
        if average is not None and config.average is not None:
            average = optax.incremental_update(params, average, 1 - config.average)
        # Geometric, so that the spikes that are to be told from it do not move it much.
        norm = jnp.maximum(norm, jnp.finfo(norm.dtype).tiny)
        mixed = self.usual_norm**NORM_DECAY * norm ** (1 - NORM_DECAY)
        return TrainState(
            step=self.step + 1,
            params=params,
            moments=moments,
            usual_norm=jnp.where(self.usual_norm == 0, norm, mixed),
            left_out=jnp.int32(0),
            average=average,
        )

    def leave_out(self) -> TrainState:
        """The state after an update that changes no weight."""
        return replace(self, step=self.step + 1, left_out=self.left_out + 1)

    @property
    def best(self) -> nnx.State:
        """The weights to validate and to keep: the average, if there is one."""
        return self.params if self.average is None else self.average
