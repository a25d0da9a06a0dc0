"""One training update: its state, its pure functions and their compiled form.

    (state, frozen weights, batch)  ->  loss and gradients  ->  guard  ->  optimizer  ->  state

The guard skips an update if its loss or gradient norm is not finite. With
`skip_grad_norm_factor` it also skips one whose gradient norm is far above the running mean. A
skipped update changes no weight.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
import optax
from einops import rearrange
from flax import nnx
from jax.sharding import Mesh
from jaxtyping import Array, Key

from egosim_jax.sharding import batch_sharding, check_batch, constrain, state_sharding
from egosim_jax.train.config import OptimizerConfig, TrainConfig, learning_rate, make_optimizer
from egosim_jax.train.task import Batch, Criticized, Distillation, Metrics, Roles, Task

GUARD_WARMUP = 50
"""Updates before the guard compares a gradient norm with the running mean."""
GRAD_NORM_DECAY = 0.98
"""Decay of the running mean of gradient norms; it averages over about 50 updates."""
MAX_CONSECUTIVE_SKIPS = 3
"""Number of consecutive skipped updates that stops the run."""
COUNTS = ("consecutive_skips", "critic_skips", "critic_consecutive_skips")
"""Names of an update's counts among its metrics; the others are averaged."""


@no_type_check
@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class TrainState:
    """All arrays that an update changes."""

    step: jax.Array
    """Number of finished updates, skipped ones included, int32."""
    params: nnx.State
    """Trained weights in float32."""
    opt_state: Any
    """State of the optax transformation."""
    grad_norm_ema: jax.Array
    """Running geometric mean of gradient norms without skipped updates, float32; 0 at first."""
    consecutive_skips: jax.Array
    """Number of consecutive skipped updates, int32."""
    ema_params: nnx.State | None
    """Exponential moving average of `params`; None without `ema_decay`."""
    teacher: nnx.State | None = None
    """Weights of a distillation's teacher, which no update changes.

    They are part of the state so that a checkpoint has all that a resumed run needs."""
    critic: TrainState | None = None
    """State of a distillation's critic."""

    @classmethod
    def create(cls, params: nnx.State, config: OptimizerConfig) -> TrainState:
        """Return the state before the first update."""
        return cls(
            step=jnp.int32(0),
            params=params,
            opt_state=make_optimizer(config).init(params),
            grad_norm_ema=jnp.float32(0),
            consecutive_skips=jnp.int32(0),
            ema_params=None if config.ema_decay is None else jax.tree.map(jnp.copy, params),
        )

    def apply_gradients(
        self,
        gradients: nnx.State,
        norm: jax.Array,
        rate: jax.Array,
        training: TrainConfig,
    ) -> TrainState:
        """Return the state after an update with gradients of global norm `norm`, at a rate."""
        optimizer = make_optimizer(training.optimizer)
        updates, opt_state = optimizer.update(gradients, self.opt_state, self.params)
        updates = jax.tree.map(lambda update: rate * update, updates)
        params: Any = optax.apply_updates(self.params, updates)
        ema_params: Any = self.ema_params
        if ema_params is not None:
            decay = training.optimizer.ema_decay_at(self.step)
            ema_params = optax.incremental_update(params, ema_params, 1 - decay)
        # A geometric mean: a spike hardly moves the mean that the guard compares it with.
        norm = jnp.maximum(norm, jnp.finfo(norm.dtype).tiny)
        mixed = self.grad_norm_ema**GRAD_NORM_DECAY * norm ** (1 - GRAD_NORM_DECAY)
        return replace(
            self,
            step=self.step + 1,
            params=params,
            opt_state=opt_state,
            grad_norm_ema=jnp.where(self.grad_norm_ema == 0, norm, mixed),
            consecutive_skips=jnp.int32(0),
            ema_params=ema_params,
        )

    def skip_update(self) -> TrainState:
        """Return the state after a skipped update, which changes no weight."""
        return replace(self, step=self.step + 1, consecutive_skips=self.consecutive_skips + 1)

    @property
    def eval_params(self) -> nnx.State:
        """Weights to validate and to export: the moving average, if there is one."""
        return self.params if self.ema_params is None else self.ema_params


def make_update(
    task: Task, graph: nnx.GraphDef, training: TrainConfig
) -> Callable[[TrainState, nnx.State, Batch], tuple[TrainState, Metrics]]:
    """Return the update, a function of state, frozen weights and batch.

    Its randomness depends only on seed and step. `grad_accum_steps` parts of the batch are
    processed one after the other and give the same gradient. The critic of a distillation is
    updated first, several times.
    """

    def update(state: TrainState, frozen: nnx.State, batch: Batch) -> tuple[TrainState, Metrics]:
        # Keys depend on the step, not on a saved key, so a resumed run repeats the noise.
        key = jax.random.fold_in(jax.random.key(training.seed), state.step)
        size = next(iter(batch.values())).shape[0]
        metrics: Metrics = {}
        if isinstance(task, Criticized) and task.critic is not None:
            critic, metrics = _update_critic(task, graph, training, state, frozen, batch, key)
            state = replace(state, critic=critic)

        def loss(params: nnx.State, batch: Batch, keys: jax.Array) -> tuple[jax.Array, Metrics]:
            networks: Any = nnx.merge(graph, params, frozen)
            if isinstance(task, Distillation):
                networks = _roles(graph, replace(state, params=params), frozen)
            return task.loss(networks, batch, keys)

        state, own = advance(state, loss, batch, task.keys(key, size), training)
        return state, {**own, **metrics}

    return update


def advance(
    state: TrainState,
    loss: Callable[[nnx.State, Any, jax.Array], tuple[jax.Array, Metrics]],
    batch: Any,
    keys: Key[Array, " *keys"],
    training: TrainConfig,
    rate: jax.Array | None = None,
) -> tuple[TrainState, Metrics]:
    """Return the state after an update by the gradient of `loss`, and the metrics.

    Without a `rate`, the learning rate follows the schedule.
    """
    config = training.optimizer
    gradient = jax.value_and_grad(loss, has_aux=True)
    if training.grad_accum_steps > 1:
        gradient = accumulate_gradients(gradient, training.grad_accum_steps)
    (value, metrics), gradients = gradient(state.params, batch, keys)

    norm = optax.tree.norm(gradients)
    valid = jnp.isfinite(value) & jnp.isfinite(norm)
    if config.skip_grad_norm_factor is not None:
        limit = config.skip_grad_norm_factor * state.grad_norm_ema
        valid &= (state.step < GUARD_WARMUP) | (norm <= limit)
    if rate is None:
        # The optimizer's own count would lag behind: it does not count skipped updates.
        rate = jnp.asarray(learning_rate(config, training.steps)(state.step), jnp.float32)
    changed = state.apply_gradients(gradients, norm, rate, training)
    # `where` drops the NaNs of a bad update: the optimizer state stays finite, too.
    state = jax.tree.map(lambda new, old: jnp.where(valid, new, old), changed, state.skip_update())
    own = {"loss": value, "grad_norm": norm, "lr": rate}
    return state, {**own, "consecutive_skips": state.consecutive_skips, **metrics}


def _update_critic(
    task: Criticized,
    graph: nnx.GraphDef,
    training: TrainConfig,
    state: TrainState,
    frozen: nnx.State,
    batch: Batch,
    key: Key[Array, ""],
) -> tuple[Any, Metrics]:
    """Return the critic's state after its updates on a batch, each with its own noise."""
    config: Any = task.critic
    before: Any = state.critic
    steps = config.updates * training.steps
    own = replace(training, optimizer=config.optimizer, steps=steps)

    def step(critic: TrainState, number: jax.Array) -> tuple[TrainState, Metrics]:
        def loss(params: nnx.State, batch: Batch, keys: jax.Array) -> tuple[jax.Array, Metrics]:
            changed = replace(state, critic=replace(critic, params=params))
            return task.critic_loss(_roles(graph, changed, frozen), batch, keys)

        size = next(iter(batch.values())).shape[0]
        keys = task.keys(jax.random.fold_in(key, number), size)
        return advance(critic, loss, batch, keys, own)

    critic, rows = jax.lax.scan(step, before, jnp.arange(1, config.updates + 1))
    valid = rows["consecutive_skips"] == 0
    means = {
        f"critic_{name}": jnp.where(valid, rows[name], 0).sum() / valid.sum()
        for name in ("loss", "grad_norm")
    }
    skips = {"skips": (~valid).sum(), "consecutive_skips": critic.consecutive_skips}
    return critic, means | {f"critic_{name}": count for name, count in skips.items()}


def _roles(graph: nnx.GraphDef, state: TrainState, frozen: nnx.State) -> Roles:
    """Return the networks of a distillation; gradients reach what `state` was replaced with."""
    critic = state.critic
    return Roles(
        student=nnx.merge(graph, state.params, frozen),
        average=nnx.merge(graph, jax.lax.stop_gradient(state.eval_params), frozen),
        teacher=nnx.merge(graph, state.teacher, frozen),
        critic=None if critic is None else nnx.merge(graph, critic.params, frozen),
    )


def accumulate_gradients(gradient: Callable[..., Any], parts: int) -> Callable[..., Any]:
    """Return a function that averages `gradient(params, batch, keys)` over parts of a batch.

    Part i has samples i, i + `parts`, i + 2 `parts`, ...
    """

    def split(x: jax.Array) -> jax.Array:
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(split(jax.random.key_data(x)))
        # Not "(k b)": with strided parts, no sample moves to another device.
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


def mean_metrics(rows: Sequence[Mapping[str, jax.Array]]) -> dict[str, float]:
    """Fetch the metrics of updates from the devices; return their means, and the last rate.

    Skipped updates are counted as `skipped_updates` and `skipped_critic_updates`, and excluded from
    the means. A metric without any finite value is omitted.
    """
    fetched = jax.device_get(rows)
    kept = [row for row in fetched if not row["consecutive_skips"]]
    metrics = {}
    for name in (name for name in fetched[0] if name not in (*COUNTS, "lr")):
        if values := [row[name] for row in kept if np.isfinite(row[name])]:
            metrics[name] = float(np.mean(values))
    skips = {
        "skipped_updates": len(fetched) - len(kept),
        "skipped_critic_updates": sum(int(row.get("critic_skips", 0)) for row in fetched),
    }
    metrics |= {name: float(count) for name, count in skips.items() if count}
    return {**metrics, "lr": float(fetched[-1]["lr"])}


def make_validation(
    task: Task, graph: nnx.GraphDef
) -> Callable[[nnx.State, nnx.State, Batch], Metrics]:
    """Return the validation, a function of trained weights, frozen weights and batch.

    It returns the sum of each metric under the samples' `weight`, and the sum of these weights.
    """

    def validate(params: nnx.State, frozen: nnx.State, batch: Batch) -> Metrics:
        weight = batch["weight"]
        metrics = task.validate(nnx.merge(graph, params, frozen), batch)
        sums = {name: (weight * each).sum() for name, each in metrics.items()}
        return {**sums, "weight": weight.sum()}

    return validate


def mean_validation(rows: Iterable[Mapping[str, jax.Array]]) -> tuple[dict[str, float], int]:
    """Return the mean of each metric over the samples of all batches, and the number of samples."""
    fetched = [jax.device_get(row) for row in rows]
    totals = {name: sum(float(row[name]) for row in fetched) for name in fetched[0]}
    samples = totals.pop("weight")
    return {f"validation_{name}": total / samples for name, total in totals.items()}, int(samples)


def _with_roles(state: TrainState, task: Distillation, teacher: nnx.State) -> TrainState:
    """Return a distillation's state before the first update; the critic starts as the teacher."""
    critic = None
    if task.critic is not None:
        critic = TrainState.create(jax.tree.map(jnp.copy, teacher), task.critic.optimizer)
    # Copies: the state is donated, so no array may be in it twice.
    kept: Any = jax.tree.map(lambda leaf: jnp.array(leaf, task.frozen_dtype), teacher)
    return replace(state, teacher=kept, critic=critic)


@dataclass(frozen=True, kw_only=True)
class Programs:
    """The jitted update and validation of a task, with the shapes and shardings of their arguments.

    Needs neither weights nor data; with an abstract mesh, no devices either.
    """

    graph: nnx.GraphDef
    """Graph of the task's networks."""
    create: Callable[..., TrainState]
    """Return the initial state, from loaded weights of the student and of its teacher.

    Weights that were not loaded are random. Without a teacher, it is the student at its start."""
    state: TrainState
    """Shape and dtype of each array of the state."""
    state_sharding: Any
    """Shardings of the state."""
    frozen: Any
    """Shape and dtype of each frozen weight."""
    frozen_sharding: Any
    """Shardings of the frozen weights."""
    update: Any
    """Jitted update (`make_update`), which donates the state."""
    validate: Any
    """Jitted validation (`make_validation`)."""

    @classmethod
    def of(cls, task: Task, training: TrainConfig, mesh: Mesh) -> Programs:
        """Return the programs of a task on a mesh.

        Raises `InputError` if the mesh does not divide the batch.
        """
        check_batch(training.batch_size, mesh, training.grad_accum_steps, stage="training")
        graph, _, frozen = nnx.split(
            nnx.eval_shape(lambda: task.networks(nnx.Rngs(0))), task.trained, ...
        )
        frozen = jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct(leaf.shape, task.frozen_dtype), frozen
        )

        def create(loaded: nnx.State | None = None, teacher: nnx.State | None = None) -> TrainState:
            new = nnx.state(task.networks(nnx.Rngs(training.seed)), task.trained)
            params = new if loaded is None else nnx.merge_state(new, loaded)
            state = TrainState.create(params, training.optimizer)
            if isinstance(task, Distillation):
                start = params if teacher is None else nnx.merge_state(new, teacher)
                state = _with_roles(state, task, start)
            return state

        state, placed = jax.eval_shape(create), batch_sharding(mesh)
        sharding, frozen_sharding = state_sharding(mesh, state), state_sharding(mesh, frozen)
        return cls(
            graph=graph,
            create=create,
            state=state,
            state_sharding=sharding,
            frozen=frozen,
            frozen_sharding=frozen_sharding,
            update=jax.jit(
                make_update(task, graph, training),
                in_shardings=(sharding, frozen_sharding, placed),
                out_shardings=(sharding, None),
                donate_argnums=0,
            ),
            validate=jax.jit(
                make_validation(task, graph),
                in_shardings=(sharding.params, frozen_sharding, placed),
            ),
        )
