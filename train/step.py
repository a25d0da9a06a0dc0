"""One update, and one validation pass, as pure functions of the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import jax
import optax
from flax import nnx

from egosim_jax.train.state import TrainState

Batch = Mapping[str, jax.Array]
Metrics = dict[str, jax.Array]


@runtime_checkable
class Task(Protocol):
    """What is trained, on what, and by which loss."""

    def networks(self, rngs: nnx.Rngs) -> nnx.Module:
        """The networks whose weights are trained."""
        ...

    def examples(self) -> Any:
        """The Grain transform from a shard's record to an example of arrays."""
        ...

    def loss(self, networks: Any, batch: Batch, key: jax.Array) -> tuple[jax.Array, Metrics]:
        """The loss of a batch, and numbers worth logging."""
        ...

    def validate(self, networks: Any, batch: Batch) -> Metrics:
        """Numbers that depend on nothing random, the same at every call."""
        ...


def make_update(
    task: Task, graph: nnx.GraphDef, optimizer: optax.GradientTransformation, seed: int
) -> Callable[[TrainState, Batch], tuple[TrainState, Metrics]]:
    """The update function; its randomness is a function of seed and step alone."""

    def update(state: TrainState, batch: Batch) -> tuple[TrainState, Metrics]:
        key = jax.random.fold_in(jax.random.key(seed), state.step)

        def loss(params: nnx.State) -> tuple[jax.Array, Metrics]:
            return task.loss(nnx.merge(graph, params), batch, key)

        (value, metrics), gradients = jax.value_and_grad(loss, has_aux=True)(state.params)
        metrics = {"loss": value, "gradient_norm": optax.tree.norm(gradients), **metrics}
        return state.apply(gradients, optimizer), metrics

    return update


def make_validation(task: Task, graph: nnx.GraphDef) -> Callable[[nnx.State, Batch], Metrics]:
    """The validation function of weights and a batch."""

    def validate(params: nnx.State, batch: Batch) -> Metrics:
        return task.validate(nnx.merge(graph, params), batch)

    return validate
