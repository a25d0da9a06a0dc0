"""The training loop, read from top to bottom: `train`, then the actions of `Run` that it calls.

To resume, a run makes the data iterator as a new run does, reads the newest checkpoint straight
into the shardings of the mesh, sets the iterator to the saved position, and cuts the log back to
the restored step. It then repeats the losses of an uninterrupted run bit for bit.

The update is compiled before weights are read: the run refuses at once a batch size or a number of
heads that the mesh does not divide. The host reads the metrics of an update while the next one
runs, so the devices never wait for it.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx

from egosim_jax.data.loader import Loader, make_loader, one_pass
from egosim_jax.data.mixing import Mixture, open_shards
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.checkpoint import Checkpoints, has_checkpoint
from egosim_jax.io.digest import sha256
from egosim_jax.io.run import open_folder, write_json
from egosim_jax.io.weights import hashes, place
from egosim_jax.models.layers import LowRankParam, init_sharded
from egosim_jax.models.lora import Change, check_further, state_of
from egosim_jax.runtime.command import CommandExit, ExitCode
from egosim_jax.runtime.phases import phase
from egosim_jax.runtime.terminal import printable
from egosim_jax.sharding import (
    assemble,
    batch_sharding,
    make_mesh,
    parts,
    process_rows,
    put,
)
from egosim_jax.train.config import TrainConfig, numerics_only, resume_mutable
from egosim_jax.train.distributed import (
    count_distinct,
    is_preempted,
    stop_if_preempted,
)
from egosim_jax.train.metric_writers import Console, JsonLines, TensorBoard, WandB, Writer
from egosim_jax.train.monitor import Clock, Samples, SkipMonitor, Watchdog
from egosim_jax.train.task import Distillation, Task
from egosim_jax.train.update import Programs, TrainState, mean_metrics, mean_validation
from egosim_jax.types import InputError


def train(
    task: Task,
    training: TrainConfig,
    *,
    data: Path,
    validation: Path | None,
    out: Path,
    weights: Path | None = None,
    lora: tuple[Path, Mapping[str, Change]] | None = None,
    teacher: Path | None = None,
    samples: Samples | None = None,
) -> Any:
    """Train `task` on the shards in `data`, resuming the run in `out`, and return the networks.

    `validation` is a folder of shards to validate on, with fixed noise. `weights` is a folder to
    start from instead of random weights, `lora` a LoRA of it to train further: file and changes.
    `teacher` is the folder of a distillation's teacher, by default the student at its start. OUT
    gets config.json, environment.json, metrics.jsonl, times.json, checkpoints/ and samples/. All
    processes of a run call this with the same arguments; the first one writes.
    """
    training.check_packages()
    digests = None if weights is None else hashes(weights)
    settings = {"task": task, "training": training, "weights": digests}
    if lora is not None:
        settings["lora"] = sha256(lora[0])
    if teacher is not None:
        settings["teacher"] = hashes(teacher, only=["dit"])
    resumable = [*resume_mutable("training"), *numerics_only(task, "task")]
    mesh, source = make_mesh(training.mesh), open_shards(data)
    programs = Programs.of(task, training, mesh)
    if lora is not None:
        check_further(lora[1], programs.state.params)
    open_folder(out, settings, mutable=resumable, begun=has_checkpoint(out))
    if weights is None and jax.tree.leaves(programs.frozen):
        raise InputError("Frozen weights cannot be random: give a weights folder. (--weights)")

    with jax.set_mesh(mesh), ExitStack() as stack:
        run = Run(task, training, programs, source, out, stack)
        run.compile()
        stop_if_preempted(out)
        with phase0("loads the weights"):
            state = run.start(weights, None if lora is None else lora[1], teacher)
        log0(startup_message(state, training, out))
        for name, digest in (digests or {}).items():
            log0(f"{out}: from {name} sha256 {digest[:16]}")
        run.open_log(int(state.step))
        hooks = [Every(training.log_every, run.log)]
        if validation is not None:
            hooks.append(Every(training.validate_every, partial(run.validate, validation)))
        if samples is not None and training.sample_every is not None:
            hooks.append(Every(training.sample_every, partial(run.sample, samples)))
        hooks.append(Every(training.validate_every, run.write_times))
        if validation is not None and int(state.step) == 0:
            run.validate(validation, 0, state)
        stop_if_preempted(out)
        state = run.loop(state, hooks)
        log0(f"time spent:\n{run.clock.table()}")
    return run.networks(state)


@dataclass(frozen=True)
class Every:
    """An action that the loop repeats at an interval."""

    steps: int
    """Updates between two calls."""
    action: Callable[[int, TrainState], None]
    """Function of the number of finished updates and the state."""

    def __call__(self, step: int, state: TrainState, *, last: bool) -> None:
        """Run the action if it is due; after the last update it always is."""
        if last or step % self.steps == 0:
            self.action(step, state)


class Run:
    """A training in progress: data, checkpoints, metrics, and the actions of its loop."""

    def __init__(
        self,
        task: Task,
        training: TrainConfig,
        programs: Programs,
        source: ShardReader | Mixture,
        out: Path,
        stack: ExitStack,
    ):
        """Open data and checkpoints, which `stack` closes. The training's mesh must be set."""
        self.task, self.training, self.programs, self.out = task, training, programs, out
        self.stack, self.sharding = stack, batch_sharding(jax.sharding.get_mesh())
        self.source, self.frozen, self.update = source, programs.frozen, programs.update
        self.clock, self.skips = Clock(flops=float("nan")), SkipMonitor(source)
        self.pending: list[Mapping[str, jax.Array]] = []
        self.writers: list[Writer] = []
        batches = make_batches(source, task, training, self.sharding)
        self.batches = stack.enter_context(closing(batches))
        self.checkpoints = Checkpoints(
            out / "checkpoints", keep=training.keep, keep_every=training.keep_every
        )
        stack.callback(self.checkpoints.close)

    def compile(self) -> None:
        """Compile the update, unless no step remains, and check the disk space for checkpoints."""
        done, steps = max(self.checkpoints.steps, default=0), self.training.steps
        if done < steps:
            first = make_batches(self.source, self.task, self.training, self.sharding, peek=True)
            with self.clock.phase("data"), closing(first):
                example = self._to_devices(next(first))
            self.clock.flops = self.task.flops(self.training.batch_size)
            with phase0("compiles the update"), self.clock.phase("compile"):
                self.update = self.update.lower(self.programs.state, self.frozen, example).compile()
            log0(f"compiled in {self.clock.seconds['compile']:.1f} s{memory_summary(self.update)}")
        every, left = self.training.save_every, range(done + 1, steps + 1)
        saved = [step for step in left if step % every == 0 or step == steps]
        self.checkpoints.check_room(self.programs.state, saved)

    def start(
        self, weights: Path | None, lora: Mapping[str, Change] | None, teacher: Path | None
    ) -> TrainState:
        """Return the state of the newest checkpoint, or the initial state."""
        with self.clock.phase("start"):
            loaded = None
            if weights is not None and (self.frozen or not self.checkpoints.steps):
                loaded = self._load(weights)
            if not self.checkpoints.steps:
                if lora is not None:
                    base = loaded or nnx.State({})
                    changed = state_of(lora, self.programs.state.params, base)
                    loaded = nnx.merge_state(base, changed)
                return self._initial_state(loaded, teacher)
            state = jax.tree.map(put, self.programs.state, self.programs.state_sharding)
            return self.checkpoints.restore(state, self.batches, fallback=self.training.fallback)

    def open_log(self, step: int) -> None:
        """Start the metric writers and the watchdog of a run that has finished `step` updates."""
        self.writers = make_writers(self.training, self.out, step) if is_first() else []
        for writer in self.writers:
            self.stack.callback(writer.close)
        self.watchdog = self.stack.enter_context(closing(Watchdog(self.training.hang_timeout_s)))

    def loop(self, state: TrainState, hooks: list[Every]) -> TrainState:
        """Update to the last step and run the hooks; on SIGTERM, save a checkpoint and stop."""
        self.clock.begin(int(state.step))
        for step in range(int(state.step) + 1, self.training.steps + 1):
            state = self.step(step, state)
            last = step == self.training.steps
            for hook in hooks:
                hook(step, state, last=last)
            ends = is_preempted() or last
            if step % self.training.save_every == 0 or ends:
                self.save(step, state, wait=ends)
            if ends and not last:
                log0(f"time spent:\n{self.clock.table()}")
                raise CommandExit(
                    f"{self.out}: stopped and saved after step {step}; run it again",
                    ExitCode.RESUBMIT,
                )
        return state

    def step(self, step: int, state: TrainState) -> TrainState:
        """Return the state after one more update, and check the previous one."""
        with self.clock.phase("data"):
            examples = next(self.batches)
        with self.clock.phase("step"):
            state, metrics = self.update(state, self.frozen, self._to_devices(examples))
            self.pending.append(metrics)
            self.skips.watch(step, metrics, examples["record"])
        self.watchdog.beat()
        return state

    def log(self, step: int, state: TrainState) -> None:
        """Write the mean metrics since the last log line, and the speed."""
        with self.clock.phase("step"):
            self.skips.check()
            metrics = mean_metrics(self.pending)
        self.pending = []
        if bad := count_distinct(self.batches.skipped):
            metrics["skipped_records"] = float(bad)
        self.write(step, {**metrics, **self.clock.tick(step, self.training.steps)})

    def validate(self, shards: Path, step: int, state: TrainState) -> None:
        """Write the validation metrics: means over the readable records of `shards`."""
        self.watchdog.rest()
        with self.clock.phase("validate"):
            source, params = open_shards(shards), state.eval_params
            batches = validation_batches(source, self.task, self.training, self.sharding)
            metrics, readable = mean_validation(
                self.programs.validate(params, self.frozen, batch) for batch in batches
            )
        if (bad := len(source) - readable) > Loader.MAX_BAD:  # summed over all processes
            raise InputError(
                f"{bad} of {len(source)} records of {shards} cannot be read: at most "
                f"{Loader.MAX_BAD} may be damaged. Encode or pack them again. (--validation)"
            )
        self.write(step, metrics)

    def sample(self, samples: Samples, step: int, state: TrainState) -> None:
        """Generate and write sample clips."""
        self.watchdog.rest()
        with self.clock.phase("sample"):
            samples.write(self.networks(state), self.out / "samples", step)

    def write_times(self, step: int, state: TrainState) -> None:
        """Write times.json."""
        if is_first():
            write_json(self.out / "times.json", self.clock.by_phase())

    def save(self, step: int, state: TrainState, *, wait: bool) -> None:
        """Write a checkpoint in the background; with `wait`, return when it is on disk."""
        self.watchdog.rest()
        with self.clock.phase("save"):
            self.checkpoints.save(step, state, self.batches)
            if wait:
                self.checkpoints.wait()

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Pass metrics to every writer."""
        for writer in self.writers:
            writer.write(step, metrics)

    def networks(self, state: TrainState) -> Any:
        """Return the networks with the weights of a state."""
        return nnx.merge(self.programs.graph, state.eval_params, self.frozen)

    def _load(self, weights: Path) -> nnx.State:
        """Load the frozen weights of a folder; return its weights that are trained further."""
        programs = self.programs
        trained, sharding = self._trained()
        placed = place(
            weights,
            nnx.merge_state(self.frozen, trained),
            nnx.merge_state(programs.frozen_sharding, sharding),
        )
        frozen = {path for path, _ in nnx.to_flat_state(self.frozen)}
        self.frozen, loaded = nnx.split_state(placed, lambda path, _: path in frozen, ...)
        return loaded

    def _trained(self) -> tuple[nnx.State, nnx.State]:
        """Return shapes and shardings of the trained weights that a weights folder has.

        No weights folder has the LoRA.
        """
        held = nnx.Not(LowRankParam)
        programs = self.programs
        trained, _ = nnx.split_state(programs.state.params, held, ...)
        sharding, _ = nnx.split_state(programs.state_sharding.params, held, ...)
        return trained, sharding

    def _initial_state(self, loaded: nnx.State | None, teacher: Path | None) -> TrainState:
        """Return the state before the first update; weights that were not loaded are random."""
        sharding, params = self.programs.state_sharding, self.programs.state.params
        if isinstance(self.task, Distillation):
            given = None if teacher is None else place(teacher, *self._trained())
            create = partial(self.programs.create, loaded, given)
            return init_sharded(create, out_shardings=sharding)
        if loaded is None or len(jax.tree.leaves(loaded)) < len(jax.tree.leaves(params)):
            create = partial(self.programs.create, loaded)
            return init_sharded(create, out_shardings=sharding)
        # All weights were loaded: donate them, so that no second copy takes memory.
        create = partial(TrainState.create, config=self.training.optimizer)
        return jax.jit(create, out_shardings=sharding, donate_argnums=0)(loaded)

    def _to_devices(self, batch: Mapping[str, np.ndarray]) -> dict[str, jax.Array]:
        return assemble(batch, self.sharding, self.training.batch_size)


def make_batches(
    source: ShardReader | Mixture,
    task: Task,
    training: TrainConfig,
    sharding: Any,
    *,
    peek: bool = False,
) -> Loader:
    """Return an iterator over this process's rows of each batch, shuffled and endless.

    With `peek` it starts no worker processes.
    """
    return make_loader(
        source,
        batch_size=training.batch_size,
        seed=training.seed,
        rows=process_rows(sharding, training.batch_size)[jax.process_index()],
        workers=0 if peek else training.workers,
        transform=task.examples(),
    )


def validation_batches(
    source: ShardReader | Mixture, task: Task, training: TrainConfig, sharding: Any
) -> Iterator[dict[str, jax.Array]]:
    """Yield the batches of one pass over all records, on the devices of all processes."""
    devices = parts("batch", sharding.mesh)
    size = min(training.batch_size, -(-len(source) // devices) * devices)
    rows = process_rows(sharding, size)[jax.process_index()]
    for batch in one_pass(source, batch_size=size, rows=rows, transform=task.examples()):
        yield assemble(batch, sharding, size)


def make_writers(training: TrainConfig, out: Path, step: int) -> list[Writer]:
    """Return the metric writers of a run that starts or resumes after `step` updates."""
    writers: list[Writer] = [
        Console(training.steps),
        JsonLines(out / "metrics.jsonl", resume_after=step),
    ]
    if training.tensorboard:
        writers.append(TensorBoard(out / "tensorboard", resume_after=step))
    if training.wandb is not None:
        writers.append(WandB(out, project=training.wandb, name=out.name))
    return writers


def is_first() -> bool:
    """Return True in the first process of the run, which writes."""
    return jax.process_index() == 0


def log0(text: str) -> None:
    """Print to stderr, in the first process only."""
    if is_first():
        print(printable(text), file=sys.stderr, flush=True)


def phase0(text: str) -> AbstractContextManager[None]:
    """Return a phase in the first process, and an empty context in all others."""
    return phase(text) if is_first() else nullcontext()


def memory_summary(program: Any) -> str:
    """Return the memory of a compiled program as text; empty if the compiler reports none."""
    analysis = program.memory_analysis()
    if analysis is None:
        return ""
    peak_gb = (analysis.argument_size_in_bytes + analysis.temp_size_in_bytes) / 1e9
    return f", needs {peak_gb:.2f} GB per device"


def startup_message(state: TrainState, training: TrainConfig, out: Path) -> str:
    """Return the first log line of a run: step, number of trained weights, devices."""
    step = int(state.step)
    weights = sum(leaf.size for leaf in jax.tree.leaves(state.params))
    verb = f"resuming at step {step}" if step else "starting"
    devices = f"{jax.device_count()} x {jax.devices()[0].device_kind}"
    return f"{out}: {verb} of {training.steps}, {weights:,} weights to train, {devices}"
