"""What a training compiles, before there are weights, data or even devices to run it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
from flax import nnx
from jax.sharding import Mesh

from egosim_jax.sharding import batch_sharding, check_batch, state_sharding
from egosim_jax.train.settings import Training
from egosim_jax.train.state import TrainState
from egosim_jax.train.step import Task, make_update, make_validation


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
