"""Training from a bundle (`train/bundle_writer.py`) on a machine that has jax and little else.

    cd BUNDLE
    python -m egosim_jax.train.bundle train --out run --minutes 10
    python -m egosim_jax.train.bundle join run/weights --out weights

needs jax, flax, optax, orbax-checkpoint, einops, jaxtyping, safetensors, numpy and pillow, and no
installation: the code is in the bundle. The first command trains for 10 minutes, saves and exits
with code 75. Run again, it resumes bit for bit; at the end it exits with 0. On a GPU it takes the
model and the batch size of `gpu` in `recipe.json`. Checkpoint and weights are folders of parts of
at most 16 MiB, which the second command joins.

Batch k has positions k n to k n + n - 1 of an endless sequence. Each of its epochs is a permutation
that depends only on seed and epoch, so the checkpoint needs no position in the data.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import numpy as np
from flax import nnx

from egosim_jax import configs
from egosim_jax.io import parts, weights
from egosim_jax.io.bounded import quote_path, read_bytes, read_json
from egosim_jax.io.executables import share_with_jax
from egosim_jax.io.mapped import digest, read_safetensors
from egosim_jax.io.run import open_folder
from egosim_jax.io.untrusted.npz import array_names, read_arrays
from egosim_jax.models.layers import init_sharded
from egosim_jax.runtime.command import CommandExit, ExitCode, run_with_exit_codes
from egosim_jax.sharding import batch_sharding, make_mesh
from egosim_jax.train.config import TrainConfig, numerics_only, resume_mutable
from egosim_jax.train.metric_writers import JsonLines
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.train.update import (
    MAX_CONSECUTIVE_SKIPS,
    Programs,
    TrainState,
    mean_metrics,
    mean_validation,
)
from egosim_jax.types import InputError

RECIPE, FILES, LATENTS, WEIGHTS = "recipe.json", "files.json", "latents", "weights"
"""Names in a bundle: two files (recipe, SHA-256 of all other files) and two folders."""
SHARD_BYTES = 30 << 20
"""Maximum size of a shard of latents in bytes."""
CHECKPOINT, STATE = "checkpoint", "state.safetensors"
"""Folder of the parts of the training state, in a run folder, and the file that they make up."""


@dataclass(frozen=True, kw_only=True)
class BundleRecipe:
    """Training of a bundle on one kind of machine."""

    task: Denoising
    """Networks, examples and loss."""
    training: TrainConfig
    """Hyper-parameters of the training."""
    weights: Path | None
    """Folder of weights to start from; None: random weights, as for a wider model."""
    dtype: str
    """Dtype of written weights."""

    @classmethod
    def read(cls, bundle: Path, machine: str, *, steps: int | None = None) -> BundleRecipe:
        """Read the recipe of a machine, `cpu` or `gpu`; `steps` replaces its number of updates."""
        recipe = read_json(bundle / RECIPE)
        changes = recipe[machine]
        task = replace_fields(Denoising(model=configs.get(recipe["config"])), recipe["task"])
        task = replace(task, model=replace_fields(task.model, changes.get("model", {})))
        training = replace_fields(TrainConfig(steps=1), recipe["training"])
        training = replace_fields(training, changes.get("training", {}))
        start = bundle / WEIGHTS
        fits = not changes.get("model") and (start / "dit.safetensors").exists()
        return cls(
            task=task,
            training=replace(training, steps=steps or training.steps),
            weights=start if fits else None,
            dtype=recipe["dtype"],
        )


def replace_fields(value: Any, changes: Mapping[str, Any]) -> Any:
    """Return a config with the fields of a JSON object, also in nested configs."""
    known = {field.name: getattr(value, field.name) for field in fields(value)}
    found = {}
    for name, new in changes.items():
        if name not in known:
            raise InputError(f"{type(value).__name__} has no field {name}. ({RECIPE})")
        if is_dataclass(known[name]) and isinstance(new, Mapping):
            new = replace_fields(known[name], new)
        found[name] = tuple(new) if isinstance(new, list) else new
    return replace(value, **found)


class Latents:
    """The records of one split of a bundle, in memory."""

    def __init__(self, bundle: Path, split: str):
        hashes = read_json(bundle / FILES)["sha256"]
        shards = sorted((bundle / LATENTS).glob(f"{split}-*.npz"))
        if not shards:
            raise InputError(f"{quote_path(bundle / LATENTS)} has no shards {split}-*.npz.")
        found = [read_shard(shard, hashes.get(str(shard.relative_to(bundle)))) for shard in shards]
        self.arrays = {name: np.concatenate([x[name] for x in found]) for name in found[0]}

    def __len__(self) -> int:
        return len(next(iter(self.arrays.values())))

    def batch(self, number: int, *, size: int, seed: int) -> dict[str, np.ndarray]:
        """Return batch `number`, from 0, of the shuffled endless sequence."""
        positions = (divmod(p, len(self)) for p in range(number * size, (number + 1) * size))
        return self.take(np.array([order(len(self), seed, epoch)[i] for epoch, i in positions]))

    def one_pass(self, size: int) -> Iterator[dict[str, np.ndarray]]:
        """Yield batches of all records in order, filled up with the last one at weight 0."""
        for start in range(0, len(self), size):
            records = np.arange(start, start + size, dtype=np.int32)
            weight = (records < len(self)).astype(np.float32)
            yield {
                **self.take(np.minimum(records, len(self) - 1)),
                "record": records,
                "weight": weight,
            }

    def take(self, records: np.ndarray) -> dict[str, np.ndarray]:
        """Return records as a batch; latents are float16 on disk and float32 here."""
        rows = {name: array[records] for name, array in self.arrays.items()}
        return {
            name: row.astype(np.float32) if row.dtype == np.float16 else row
            for name, row in rows.items()
        }


@lru_cache(maxsize=2)
def order(count: int, seed: int, epoch: int) -> np.ndarray:
    """Return the order of the records in an epoch."""
    return np.random.default_rng([seed, epoch]).permutation(count)


def read_shard(path: Path, sha256: str | None) -> dict[str, np.ndarray]:
    """Read a shard of latents. Raises `InputError` if its SHA-256 differs."""
    if digest(read_bytes(path, limit=SHARD_BYTES)) != sha256:
        raise InputError(f"{quote_path(path)} is damaged: not the SHA-256 in {FILES}. Copy it.")
    return read_arrays(path, {}, others=array_names(path))


class BundleRun:
    """A training from a bundle: compiled programs, data and run folder."""

    def __init__(self, bundle: Path, recipe: BundleRecipe, out: Path):
        self.bundle, self.recipe, self.out = bundle, recipe, out
        task, training = recipe.task, recipe.training
        settings = {"task": task, "training": training, "dtype": recipe.dtype}
        free = [*resume_mutable("training"), *numerics_only(task, "task")]
        open_folder(out, settings, mutable=free)
        self.data = {split: Latents(bundle, split) for split in ("train", "test")}
        self.mesh = make_mesh(training.mesh)
        self.sharding = batch_sharding(self.mesh)
        self.programs = Programs.of(task, training, self.mesh)
        self.frozen = self.programs.frozen  # empty: the denoiser and its encoders are trained

    def start(self) -> TrainState:
        """Return the state of the checkpoint, or the initial one."""
        programs, sharding = self.programs, self.programs.state_sharding
        if (self.out / CHECKPOINT).exists():
            return self._restore()
        loaded = None
        if self.recipe.weights is not None:
            params = programs.state.params
            loaded = weights.place(self.recipe.weights, params, sharding.params)
        return init_sharded(partial(programs.create, loaded), out_shardings=sharding)

    def train(self, state: TrainState, *, until: float) -> TrainState:
        """Update to the last step, or until a time of `time.monotonic`, and save."""
        training, step = self.recipe.training, int(state.step)
        log = JsonLines(self.out / "metrics.jsonl", resume_after=step)
        pending: list[Mapping[str, jax.Array]] = []
        began = time.monotonic()
        while step < training.steps:
            batch = self.data["train"].batch(step, size=training.batch_size, seed=training.seed)
            state, metrics = self.programs.update(state, self.frozen, self._to_devices(batch))
            step += 1
            if pending:
                jax.block_until_ready(pending[-1])  # one runs while the next is prepared
            pending.append(metrics)
            last = step == training.steps or time.monotonic() > until
            if last or step % training.log_every == 0:
                means = mean_metrics(pending)
                seconds = (time.monotonic() - began) / len(pending)
                self._log(log, step, {**means, "step_time_s": seconds})
                _check_skips(metrics)
                pending, began = [], time.monotonic()
            if last or step % training.validate_every == 0:
                self._log(log, step, self._validate(state))
            if last or step % training.save_every == 0:
                self.save(state)
            if last:
                break
        return state

    def save(self, state: TrainState) -> None:
        """Write the weights and the state, each as a folder of parts.

        The state is written last: a run that is killed in between repeats its last updates and
        writes the weights again.
        """
        networks = nnx.merge(self.programs.graph, state.eval_params, self.frozen)
        with TemporaryDirectory(dir=self.out) as folder:
            networks.save(Path(folder), dtype=self.recipe.dtype)
            vae = self.bundle / WEIGHTS / "vae.safetensors"
            parts.cut([*sorted(Path(folder).glob("*.safetensors")), vae], self.out / WEIGHTS)
        with TemporaryDirectory(dir=self.out) as folder:
            path = Path(folder) / STATE
            weights.write(path, {name: np.asarray(leaf) for name, leaf in _named(state)})
            parts.cut([path], self.out / CHECKPOINT)

    def _restore(self) -> TrainState:
        with TemporaryDirectory(dir=self.out) as folder:
            (path,) = parts.join(self.out / CHECKPOINT, Path(folder))
            tensors = read_safetensors(path)
            shapes = {name: tuple(leaf.shape) for name, leaf in _named(self.programs.state)}
            if problems := weights.mismatches(tensors, shapes):
                raise weights.WeightsError(problems, source=str(self.out / CHECKPOINT))
            arrays = [np.array(tensors[name].array()) for name in shapes]
        state = jax.tree.unflatten(jax.tree.structure(self.programs.state), arrays)
        return jax.device_put(state, self.programs.state_sharding)

    def _validate(self, state: TrainState) -> dict[str, float]:
        test, size = self.data["test"], self.recipe.training.batch_size
        metrics, _ = mean_validation(
            self.programs.validate(state.eval_params, self.frozen, self._to_devices(batch))
            for batch in test.one_pass(size)
        )
        return metrics

    def _to_devices(self, batch: Mapping[str, np.ndarray]) -> dict[str, jax.Array]:
        return {name: jax.device_put(value, self.sharding) for name, value in batch.items()}

    def _log(self, log: JsonLines, step: int, values: Mapping[str, float]) -> None:
        log.write(step, values)
        numbers = "  ".join(f"{name} {value:.4g}" for name, value in values.items())
        print(f"step {step:>6}  {numbers}", file=sys.stderr, flush=True)


def _named(state: Any) -> list[tuple[str, Any]]:
    """Return path and array of each leaf of a training state."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return [(jax.tree_util.keystr(path), leaf) for path, leaf in leaves]


def _check_skips(metrics: Mapping[str, jax.Array]) -> None:
    """Stop the run after too many consecutive skipped updates."""
    if (count := int(metrics["consecutive_skips"])) >= MAX_CONSECUTIVE_SKIPS:
        raise CommandExit(
            f"{count} updates in a row were skipped, so the run stops. The checkpoint is older: "
            "lower the learning rate.",
            ExitCode.FAILED,
        )


def train(bundle: Path, out: Path, *, machine: str, minutes: float, steps: int | None) -> int:
    """Train for some minutes, compilation included, and return the exit code."""
    until = time.monotonic() + 60 * minutes
    recipe = BundleRecipe.read(bundle, machine, steps=steps)
    run = BundleRun(bundle, recipe, out)
    with jax.set_mesh(run.mesh):
        state = run.start()
        total = recipe.training.steps
        verb = f"step {int(state.step)} of {total}, {machine}, {jax.devices()[0].device_kind}"
        print(f"{out}: {verb}", file=sys.stderr, flush=True)
        state = run.train(state, until=until)
    done = int(state.step) == total
    print(f"{out}: step {int(state.step)} of {total} saved", file=sys.stderr)
    return ExitCode.DONE if done else ExitCode.RESUBMIT


def main(args: Sequence[str] | None = None) -> int:
    """Parse the command line with argparse, since a bare machine has no tyro, and run it."""
    parser = argparse.ArgumentParser(prog="python -m egosim_jax.train.bundle")
    commands = parser.add_subparsers(dest="command", required=True)
    training = commands.add_parser("train", help="train from the bundle, or resume")
    training.add_argument("--bundle", type=Path, default=Path(), help="folder of the bundle")
    training.add_argument("--out", type=Path, required=True, help="folder of the run")
    training.add_argument("--minutes", type=float, default=10.0, help="save and stop after these")
    training.add_argument("--machine", choices=("cpu", "gpu"), help="default: by the backend")
    training.add_argument("--steps", type=int, help="total updates; default: the recipe's")
    joining = commands.add_parser("join", help="join a folder of parts")
    joining.add_argument("parts", type=Path, help="folder of parts")
    joining.add_argument("--out", type=Path, required=True, help="folder of the joined files")
    options = parser.parse_args(args)

    def run() -> int:
        if options.command == "join":
            for path in parts.join(options.parts, options.out):
                print(path)
            return ExitCode.DONE
        share_with_jax()
        machine = options.machine or ("cpu" if jax.default_backend() == "cpu" else "gpu")
        return train(
            options.bundle,
            options.out,
            machine=machine,
            minutes=options.minutes,
            steps=options.steps,
        )

    return run_with_exit_codes(run)


if __name__ == "__main__":
    sys.exit(main())
