"""The state of a training run: finished updates, weights and the optimiser's moments."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import optax
from flax import nnx


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """Everything that an update changes."""

    step: jax.Array
    """Finished updates, int32."""
    params: nnx.State
    """Weights in float32."""
    moments: Any
    """State of the optax transformation."""

    @classmethod
    def create(cls, params: nnx.State, optimizer: optax.GradientTransformation) -> TrainState:
        """The state before the first update."""
        return cls(step=jnp.int32(0), params=params, moments=optimizer.init(params))

    def apply(self, gradients: nnx.State, optimizer: optax.GradientTransformation) -> TrainState:
        """The state after one more update."""
        updates, moments = optimizer.update(gradients, self.moments, self.params)
        params: Any = optax.apply_updates(self.params, updates)
        return TrainState(step=self.step + 1, params=params, moments=moments)
