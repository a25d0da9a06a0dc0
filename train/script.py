"""The training script, from top to bottom: mesh, data, state, step, loop.

Resuming restores the state and the data iterator together, in this order: the data iterator is
made as for a new run, the newest checkpoint is read straight into the shardings of the mesh, the
iterator is set to the saved position, and the log is cut back to the restored step. A resumed run
therefore repeats the losses of the run that was not interrupted bit for bit.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx

from egosim_jax.data.loader import make_loader
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.checkpoint import Checkpoints
from egosim_jax.io.run import open_folder
from egosim_jax.io.weights import hashes, place
from egosim_jax.logging import Console, JsonLines, Writers
from egosim_jax.models.layers import initialise
from egosim_jax.sharding import MeshConfig, batch_sharding, make_mesh, state_sharding
from egosim_jax.train.optimizer import OptimizerConfig, learning_rate, make_optimizer
from egosim_jax.train.state import TrainState
from egosim_jax.train.step import Task, make_update, make_validation
from egosim_jax.types import check_counts


@dataclass(frozen=True, kw_only=True)
class Training:
    """How long, how fast and how often."""

    steps: int
    """Updates in all."""
    batch_size: int = 32
    """Examples per update, over all devices."""
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
    workers: int = 0
    """Processes that prepare data; part of the data's order, so keep it when resuming."""

    def __post_init__(self) -> None:
        """Check that every count is positive."""
        counts = ("steps", "batch_size", "log_every", "save_every", "validate_every")
        check_counts({name: getattr(self, name) for name in counts})


def train(
    task: Task,
    training: Training,
    *,
    data: Path,
    validation: Path | None,
    out: Path,
    weights: Path | None = None,
) -> Any:
    """Train `task` on the shards in `data`, resuming what `out` holds; the trained networks.

    `validation` names shards whose loss is measured at fixed times and with fixed noise; `weights`
    a folder to start from instead of random weights. The run folder holds config.json,
    environment.json, metrics.jsonl and checkpoints/.
    """
    digests = None if weights is None else hashes(weights)
    open_folder(out, {"task": task, "training": training, "weights": digests})
    mesh = make_mesh(training.mesh)
    placed = batch_sharding(mesh)

    batches = make_loader(
        ShardReader(data),
        batch_size=training.batch_size,
        seed=training.seed,
        process_index=jax.process_index(),
        process_count=jax.process_count(),
        workers=training.workers,
        transform=task.examples(),
    )

    optimizer = make_optimizer(training.optimizer, training.steps)

    def create() -> TrainState:
        networks = task.networks(nnx.Rngs(training.seed))
        return TrainState.create(nnx.state(networks, nnx.Param), optimizer)

    graph = nnx.graphdef(nnx.eval_shape(lambda: task.networks(nnx.Rngs(0))))
    abstract = jax.eval_shape(create)
    sharding = state_sharding(mesh, abstract)

    checkpoints = Checkpoints(out / "checkpoints")
    if checkpoints.steps:
        state = checkpoints.restore(_placed(abstract, sharding), batches)
    elif weights is None:
        state = initialise(create, out_shardings=sharding)
    else:
        params = place(weights, abstract.params, sharding.params)
        begin = partial(TrainState.create, optimizer=optimizer)
        state = jax.jit(begin, out_shardings=sharding, donate_argnums=0)(params)
    start = int(state.step)
    print(_greeting(state, start, training, out), file=sys.stderr, flush=True)
    for name, digest in (digests or {}).items():
        print(f"{out}: from {name} sha256 {digest[:16]}", file=sys.stderr, flush=True)

    update = jax.jit(
        make_update(task, graph, optimizer, training.seed),
        in_shardings=(sharding, placed),
        out_shardings=(sharding, None),
        donate_argnums=0,
    )
    validate = jax.jit(make_validation(task, graph), in_shardings=(sharding.params, placed))

    writer = Writers([Console(), JsonLines(out / "metrics.jsonl", resume_after=start)])
    rate = learning_rate(training.optimizer, training.steps)
    clock = _Clock(start, training.steps)
    pending: dict[int, Mapping[str, jax.Array]] = {}
    with jax.set_mesh(mesh):
        for step in range(start + 1, training.steps + 1):
            last = step == training.steps
            batch = _to_devices(next(batches), placed)
            state, metrics = update(state, batch)
            pending[step] = metrics
            if step % training.log_every == 0 or last:
                numbers = _mean(pending)
                pending = {}
                writer.write(
                    step, {**numbers, "rate": float(np.asarray(rate(step - 1))), **clock.tick(step)}
                )
            if validation is not None and (step % training.validate_every == 0 or last):
                writer.write(step, _validate(validate, state, validation, task, training, placed))
            if step % training.save_every == 0 or last:
                checkpoints.save(step, state, batches)
    checkpoints.close()
    return nnx.merge(graph, state.params)


def _placed(abstract: Any, sharding: Any) -> Any:
    def place(leaf: jax.ShapeDtypeStruct, where: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where)

    return jax.tree.map(place, abstract, sharding)


def _greeting(state: TrainState, start: int, training: Training, out: Path) -> str:
    weights = sum(leaf.size for leaf in jax.tree.leaves(state.params))
    verb = f"resuming at step {start}" if start else "starting"
    devices = f"{jax.device_count()} x {jax.devices()[0].device_kind}"
    return f"{out}: {verb} of {training.steps}, {weights:,} weights, {devices}"


def _to_devices(batch: Mapping[str, np.ndarray], sharding: Any) -> dict[str, jax.Array]:
    return {
        name: jax.make_array_from_process_local_data(sharding, value)
        for name, value in batch.items()
    }


def _mean(pending: Mapping[int, Mapping[str, jax.Array]]) -> dict[str, float]:
    """Means over the steps since the last line, fetched from the devices once."""
    rows = jax.device_get(list(pending.values()))
    return {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}


def _validate(
    validate: Any, state: TrainState, folder: Path, task: Task, training: Training, placed: Any
) -> dict[str, float]:
    """Validation numbers, averaged over every example that fills a whole batch."""
    source = ShardReader(folder)
    size = min(training.batch_size, len(source))
    batches: Iterator = make_loader(
        source,
        batch_size=size,
        seed=0,
        shuffle=False,
        repeat=False,
        process_index=jax.process_index(),
        process_count=jax.process_count(),
        transform=task.examples(),
    )
    rows = [
        jax.device_get(validate(state.params, _to_devices(batch, placed)))
        for batch in itertools.islice(batches, len(source) // size)
    ]
    return {f"validation_{name}": float(np.mean([row[name] for row in rows])) for name in rows[0]}


class _Clock:
    """Seconds a step and time left; the first interval, which compiles, is told apart."""

    def __init__(self, start: int, steps: int):
        self.then, self.step, self.steps = time.monotonic(), start, steps
        self.compiling = True

    def tick(self, step: int) -> dict[str, float]:
        """The numbers since the last call."""
        now = time.monotonic()
        seconds = (now - self.then) / max(1, step - self.step)
        self.then, self.step = now, step
        if self.compiling:
            self.compiling = False
            return {"seconds_with_compiling": seconds}
        return {"seconds": seconds, "minutes_left": seconds * (self.steps - step) / 60}
