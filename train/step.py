"""One update, and one validation pass, as pure functions of the state."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import optax
from einops import rearrange
from flax import nnx
from jaxtyping import Array, Key

from egosim_jax.sharding import constrain
from egosim_jax.train.optimizer import OptimizerConfig, make_optimizer
from egosim_jax.train.state import TrainState

Batch = Mapping[str, jax.Array]
Metrics = dict[str, jax.Array]

SETTLED = 50
"""Updates before a gradient can be said to be unusual."""


@runtime_checkable
class Task(Protocol):
    """What is trained, on what, and by which loss."""

    @property
    def trained(self) -> Any:
        """The nnx filter of the weights that are trained; the others stay as they are."""
        ...

    @property
    def frozen_dtype(self) -> str:
        """The dtype in which those others are kept."""
        ...

    def networks(self, rngs: nnx.Rngs) -> nnx.Module:
        """The networks with random weights."""
        ...

    def examples(self) -> Any:
        """The Grain transform from a shard's record to an example of arrays."""
        ...

    def shapes(self, batch: int) -> Mapping[str, jax.ShapeDtypeStruct]:
        """The arrays of a batch of examples, to compile for before there is one."""
        ...

    def keys(self, key: Key[Array, ""], batch: int) -> Key[Array, " *keys"]:
        """The random keys of each sample of a batch."""
        ...

    def loss(
        self, networks: Any, batch: Batch, keys: Key[Array, " *keys"]
    ) -> tuple[jax.Array, Metrics]:
        """The mean loss of some samples, and numbers worth logging."""
        ...

    def validate(self, networks: Any, batch: Batch) -> Metrics:
        """Numbers that depend on nothing random, the same at every call."""
        ...

    def flops(self, samples: int) -> float:
        """Model FLOPs of an update on so many samples; NaN if nobody counted them."""
        ...


def make_update(
    task: Task,
    graph: nnx.GraphDef,
    config: OptimizerConfig,
    *,
    steps: int,
    seed: int,
    accumulate: int = 1,
) -> Callable[[TrainState, nnx.State, Batch], tuple[TrainState, Metrics]]:
    """The update function of state, frozen weights and a batch.

    Its randomness is a function of seed and step alone. The batch is taken in `accumulate` parts,
    one after the other, which gives the same gradient. An update whose loss or gradient is not
    finite, or whose gradient is `config.spike` times as long as usual, changes no weight.
    """
    optimizer = make_optimizer(config, steps)

    def update(state: TrainState, frozen: nnx.State, batch: Batch) -> tuple[TrainState, Metrics]:
        def loss(params: nnx.State, batch: Batch, keys: jax.Array) -> tuple[jax.Array, Metrics]:
            return task.loss(nnx.merge(graph, params, frozen), batch, keys)

        key = jax.random.fold_in(jax.random.key(seed), state.step)
        keys = task.keys(key, next(iter(batch.values())).shape[0])
        gradient = jax.value_and_grad(loss, has_aux=True)
        if accumulate > 1:
            gradient = in_parts(gradient, accumulate)
        (value, metrics), gradients = gradient(state.params, batch, keys)

        norm = optax.tree.norm(gradients)
        sound = jnp.isfinite(value) & jnp.isfinite(norm)
        if config.spike is not None:
            usual = (state.step < SETTLED) | (norm <= config.spike * state.usual_norm)
            sound &= usual
        changed = state.apply(gradients, norm, config, optimizer)
        state = jax.tree.map(
            lambda new, old: jnp.where(sound, new, old), changed, state.leave_out()
        )
        return state, {"loss": value, "gradient_norm": norm, "left_out": state.left_out, **metrics}

    return update


def in_parts(gradient: Callable[..., Any], parts: int) -> Callable[..., Any]:
    """The mean of `gradient(params, batch, keys)` over parts of a batch, one after the other.

    Part i takes every `parts`-th sample from the i-th on, so that each device's samples stay on it.
    """

    def split(x: jax.Array) -> jax.Array:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(split(jax.random.key_data(x)))
        x = rearrange(x, "(b k) ... -> k b ...", k=parts)
        return constrain(x, (None, "batch", *[None] * (x.ndim - 2)))

    def mean(params: nnx.State, batch: Batch, keys: jax.Array) -> Any:
        def add(total: Any, part: Any) -> tuple[Any, None]:
            return jax.tree.map(jnp.add, total, gradient(params, *part)), None

        pieces = jax.tree.map(split, (dict(batch), keys))
        shapes = jax.eval_shape(gradient, params, *jax.tree.map(lambda x: x[0], pieces))
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
        total, _ = jax.lax.scan(add, zeros, pieces)
        return jax.tree.map(lambda x: x / parts, total)

    return mean


def make_validation(
    task: Task, graph: nnx.GraphDef
) -> Callable[[nnx.State, nnx.State, Batch], Metrics]:
    """The validation function of trained weights, frozen weights and a batch."""

    def validate(params: nnx.State, frozen: nnx.State, batch: Batch) -> Metrics:
        return task.validate(nnx.merge(graph, params, frozen), batch)

    return validate
