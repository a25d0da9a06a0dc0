"""The training script, from top to bottom: mesh, data, step, state, loop.

Resuming restores the state and the data iterator together, in this order: the data iterator is
made as for a new run, the newest checkpoint is read straight into the shardings of the mesh, the
iterator is set to the saved position, and the log is cut back to the restored step. A resumed run
therefore repeats the losses of the run that was not interrupted bit for bit.

The step is compiled before weights are read, so that a batch or a head count that the mesh does
not divide is refused at once. The numbers of a step are looked at when the next one is under way,
so that the devices never wait for the host.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx
from jax.experimental import multihost_utils

from egosim_jax.command import FAILED, RESUBMIT, CommandExit
from egosim_jax.data.loader import Loader, make_loader
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.checkpoint import Checkpoints
from egosim_jax.io.executables import share_with_jax
from egosim_jax.io.run import open_folder
from egosim_jax.io.weights import hashes, place
from egosim_jax.metric_writers import Console, JsonLines, TensorBoard, WandB, Writers
from egosim_jax.models.layers import initialize
from egosim_jax.sharding import (
    batch_sharding,
    make_mesh,
    parts,
)
from egosim_jax.train.config import HOW_COMPUTED, Training, learning_rate, may_differ
from egosim_jax.train.monitor import Clock, Samples, Watchdog
from egosim_jax.train.update import Programs, Task, TrainState
from egosim_jax.types import InputError

MOST_LEFT_OUT = 3
"""Updates in a row that may be left out: then the run stops."""


def train(
    task: Task,
    training: Training,
    *,
    data: Path,
    validation: Path | None,
    out: Path,
    weights: Path | None = None,
    samples: Samples | None = None,
) -> Any:
    """Train `task` on the shards in `data`, resuming what `out` holds; the trained networks.

    `validation` names shards whose loss is measured at fixed times and with fixed noise; `weights`
    a folder to start from instead of random weights. The run folder holds config.json,
    environment.json, metrics.jsonl, checkpoints/ and samples/. Several processes call it alike, and
    the first one writes.
    """
    training.check_packages()
    digests = None if weights is None else hashes(weights)
    settings = {"task": task, "training": training, "weights": digests}
    open_folder(out, settings, may_differ=[*may_differ("training"), *HOW_COMPUTED])
    share_with_jax()
    mesh = make_mesh(training.mesh)
    placed = batch_sharding(mesh)
    source = ShardReader(data)
    load = partial(_load, task=task, placed=placed)
    clock = Clock(flops=float("nan"))

    programs = Programs.of(task, training, mesh)
    graph, abstract, sharding = programs.graph, programs.state, programs.state_sharding
    frozen, update, validate = programs.frozen, programs.update, programs.validate
    if weights is None and jax.tree.leaves(frozen):
        raise InputError("Weights that stay as they are have to come from somewhere. (--weights)")

    with jax.set_mesh(mesh), ExitStack() as opened:
        batches = opened.enter_context(closing(load(source, training)))
        checkpoints = Checkpoints(
            out / "checkpoints", keep=training.keep, keep_every=training.keep_every
        )
        opened.callback(checkpoints.close)
        if max(checkpoints.steps, default=0) < training.steps:
            with clock.phase("data"), closing(load(source, training, peek=True)) as peek:
                example = _to_devices(next(peek), placed)
            clock.flops = task.flops(training.batch_size)
            with clock.phase("compile"):
                update = update.lower(abstract, frozen, example).compile()
            _say(f"compiled in {clock.seconds['compile']:.1f} s{_need(update)}")
        checkpoints.check_room(abstract)
        with clock.phase("start"):
            if weights is not None:
                frozen = place(weights, frozen, programs.frozen_sharding)
            if checkpoints.steps:
                state = checkpoints.restore(
                    _placed(abstract, sharding), batches, fallback=training.fallback
                )
            elif weights is None or jax.tree.leaves(frozen):
                state = initialize(programs.create, out_shardings=sharding)
            else:
                params = place(weights, abstract.params, sharding.params)
                begin = partial(TrainState.create, config=training.optimizer, steps=training.steps)
                state = jax.jit(begin, out_shardings=sharding, donate_argnums=0)(params)
        start = int(state.step)
        _say(_greeting(state, start, training, out))
        for name, digest in (digests or {}).items():
            _say(f"{out}: from {name} sha256 {digest[:16]}")

        writer = opened.enter_context(closing(_writers(training, out, start)))
        watchdog = opened.enter_context(closing(Watchdog(training.patience)))
        rate = learning_rate(training.optimizer, training.steps)

        def measure(state: TrainState, shards: Path) -> dict[str, float]:
            """Validation numbers, means over batches."""
            with clock.phase("validate"), closing(load(shards, training)) as some:
                rows = [
                    jax.device_get(validate(state.best, frozen, _to_devices(batch, placed)))
                    for batch in some
                ]
            return {f"validation_{name}": _average(rows, name) for name in rows[0]}

        if validation is not None and start == 0:
            writer.write(0, measure(state, validation))
        pending: dict[int, Mapping[str, jax.Array]] = {}
        before: _LeftOut | None = None
        clock.begin(start)
        for step in range(start + 1, training.steps + 1):
            last = step == training.steps
            with clock.phase("data"):
                examples = next(batches)
            with clock.phase("step"):
                state, metrics = update(state, frozen, _to_devices(examples, placed))
                pending[step] = metrics
                if before is not None:
                    before.check()
                before = _LeftOut(step, metrics, examples["record"], source)
            watchdog.beat()
            if step % training.log_every == 0 or last:
                with clock.phase("step"):
                    before.check()
                    numbers = _mean(pending)
                pending = {}
                if batches.skipped:
                    numbers["skipped"] = float(len(batches.skipped))
                numbers["rate"] = float(np.asarray(rate(step - 1)))
                writer.write(step, {**numbers, **clock.tick(step, training.steps)})
            if validation is not None and (step % training.validate_every == 0 or last):
                watchdog.rest()
                writer.write(step, measure(state, validation))
            every = training.sample_every
            if samples is not None and every is not None and (step % every == 0 or last):
                watchdog.rest()
                with clock.phase("sample"):
                    networks = nnx.merge(graph, state.best, frozen)
                    samples.write(networks, out / "samples", step)
            preempted = multihost_utils.reached_preemption_sync_point(step)
            if step % training.save_every == 0 or last or preempted:
                watchdog.rest()
                with clock.phase("save"):
                    checkpoints.save(step, state, batches)
                    if last or preempted:
                        checkpoints.wait()
            if preempted and not last:
                _say(f"where the time went:\n{clock.table()}")
                raise CommandExit(
                    f"{out}: stopped and saved after step {step}; run it again", RESUBMIT
                )
        _say(f"where the time went:\n{clock.table()}")
    return nnx.merge(graph, state.best, frozen)


def _load(
    source: ShardReader | Path, training: Training, *, task: Task, placed: Any, peek: bool = False
) -> Loader:
    """This process's part of each batch; of validation shards, those that fill a batch, once."""
    once = isinstance(source, Path)
    reader = ShardReader(source) if isinstance(source, Path) else source
    size = training.batch_size
    if once:
        devices = parts("batch", placed.mesh)
        size = min(size, max(devices, len(reader) // devices * devices))
    index, count = _part(placed, size)
    return make_loader(
        reader,
        batch_size=size,
        seed=0 if once else training.seed,
        shuffle=not once,
        repeat=not once,
        process_index=index,
        process_count=count,
        workers=0 if once or peek else training.workers,
        transform=task.examples(),
    )


def _part(placed: Any, size: int) -> tuple[int, int]:
    """Which part of a batch this process's devices hold, and of how many.

    Processes that share samples, along the context axis, hold the same part.
    """
    rows = {
        index[0].indices(size)[:2]
        for index in placed.addressable_devices_indices_map((size,)).values()
    }
    first, end = min(rows)[0], max(rows)[1]
    return first // (end - first), size // (end - first)


class _LeftOut:
    """Whether an update was left out, and of which records, looked at once it is done."""

    def __init__(
        self, step: int, metrics: Mapping[str, jax.Array], records: np.ndarray, source: ShardReader
    ):
        self.step, self.metrics, self.records, self.source = step, metrics, records, source
        self.looked = False

    def check(self) -> None:
        """Name the records of an update that was left out; stop the run after several."""
        count = 0 if self.looked else int(self.metrics["left_out"])
        self.looked = True
        if not count:
            return
        names = ", ".join(str(self.source[int(i)].metadata["video_id"]) for i in self.records)
        loss, norm = float(self.metrics["loss"]), float(self.metrics["gradient_norm"])
        said = f"step {self.step} left out: loss {loss:.4g}, gradient norm {norm:.4g}, of {names}"
        print(said, file=sys.stderr, flush=True)
        if count >= MOST_LEFT_OUT:
            raise CommandExit(
                f"{count} updates in a row were left out, so the run stops. The weights are those "
                "before them: look at the clips above, or lower the learning rate.",
                FAILED,
            )


def _writers(training: Training, out: Path, start: int) -> Writers:
    if jax.process_index() != 0:
        return Writers([])
    writers: list[Any] = [
        Console(training.steps),
        JsonLines(out / "metrics.jsonl", resume_after=start),
    ]
    if training.tensorboard:
        writers.append(TensorBoard(out / "tensorboard", resume_after=start))
    if training.wandb is not None:
        writers.append(WandB(out, project=training.wandb, name=out.name))
    return Writers(writers)


def _say(text: str) -> None:
    if jax.process_index() == 0:
        print(text, file=sys.stderr, flush=True)


def _placed(abstract: Any, sharding: Any) -> Any:
    def place(leaf: jax.ShapeDtypeStruct, where: Any) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=where)

    return jax.tree.map(place, abstract, sharding)


def _need(program: Any) -> str:
    """Memory of a compiled program, if the compiler says."""
    found = program.memory_analysis()
    if found is None:
        return ""
    gigabytes = (found.argument_size_in_bytes + found.temp_size_in_bytes) / 1e9
    return f", needs {gigabytes:.2f} GB a device"


def _greeting(state: TrainState, start: int, training: Training, out: Path) -> str:
    weights = sum(leaf.size for leaf in jax.tree.leaves(state.params))
    verb = f"resuming at step {start}" if start else "starting"
    devices = f"{jax.device_count()} x {jax.devices()[0].device_kind}"
    return f"{out}: {verb} of {training.steps}, {weights:,} weights to train, {devices}"


def _to_devices(batch: Mapping[str, np.ndarray], sharding: Any) -> dict[str, jax.Array]:
    return {
        name: jax.make_array_from_process_local_data(sharding, value)
        for name, value in batch.items()
    }


def _mean(pending: Mapping[int, Mapping[str, jax.Array]]) -> dict[str, float]:
    """Means over the steps since the last line, fetched from the devices once.

    Updates that were left out count as such alone.
    """
    rows = jax.device_get(list(pending.values()))
    kept = [row for row in rows if not row["left_out"]]
    numbers = {name: _average(kept, name) for name in rows[0] if name != "left_out" and kept}
    left_out = len(rows) - len(kept)
    return {**numbers, "left_out": float(left_out)} if left_out else numbers


def _average(rows: list[Mapping[str, np.ndarray]], name: str) -> float:
    return float(np.mean([row[name] for row in rows]))
