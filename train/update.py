"""One update of a training: its state, its pure functions and the programs they compile to."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, no_type_check, runtime_checkable

import jax
import jax.numpy as jnp
import optax
from einops import rearrange
from flax import nnx
from jax.sharding import Mesh
from jaxtyping import Array, Key

from egosim_jax.sharding import batch_sharding, check_batch, constrain, state_sharding
from egosim_jax.train.config import OptimizerConfig, Training, make_optimizer

Batch = Mapping[str, jax.Array]
Metrics = dict[str, jax.Array]

SETTLED = 50
"""Updates before a gradient can be said to be unusual."""
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


class Stage(NamedTuple):
    """A training of a recipe."""

    task: Task
    """What is trained."""
    training: Training
    """How long, how fast and how often."""


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


@dataclass(frozen=True, kw_only=True)
class Programs:
    """The update and the validation of a task, and the shapes and shardings that they take."""

    graph: nnx.GraphDef
    """Of the networks."""
    create: Callable[[], TrainState]
    """What makes the first state, from random weights."""
    state: TrainState
    """The state's shapes."""
    state_sharding: Any
    """Where the state lies."""
    frozen: Any
    """Shapes of the weights that stay as they are."""
    frozen_sharding: Any
    """Where those lie."""
    update: Any
    """The jitted `step.make_update`."""
    validate: Any
    """The jitted `step.make_validation`."""

    @classmethod
    def of(cls, task: Task, training: Training, mesh: Mesh) -> Programs:
        """Those of a task on a mesh. Raises `InputError` if the mesh does not divide the batch."""
        check_batch(training.batch_size, mesh, training.accumulate)
        graph, _, frozen = nnx.split(
            nnx.eval_shape(lambda: task.networks(nnx.Rngs(0))), task.trained, ...
        )
        frozen = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, task.frozen_dtype), frozen
        )

        def create() -> TrainState:
            networks = task.networks(nnx.Rngs(training.seed))
            return TrainState.create(
                nnx.state(networks, task.trained), training.optimizer, training.steps
            )

        state, placed = jax.eval_shape(create), batch_sharding(mesh)
        sharding, frozen_sharding = state_sharding(mesh, state), state_sharding(mesh, frozen)
        update = make_update(
            task,
            graph,
            training.optimizer,
            steps=training.steps,
            seed=training.seed,
            accumulate=training.accumulate,
        )
        return cls(
            graph=graph,
            create=create,
            state=state,
            state_sharding=sharding,
            frozen=frozen,
            frozen_sharding=frozen_sharding,
            update=jax.jit(
                update,
                in_shardings=(sharding, frozen_sharding, placed),
                out_shardings=(sharding, None),
                donate_argnums=0,
            ),
            validate=jax.jit(
                make_validation(task, graph),
                in_shardings=(sharding.params, frozen_sharding, placed),
            ),
        )
