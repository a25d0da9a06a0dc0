"""Batches from shards: shuffled, split over processes, cut into windows, prefetched, resumable.

The loader iterates over one endless sequence of records that depends on the seed alone: every epoch
is a new permutation, and position k of the sequence has its own random numbers for its window.
Row r of batch b is position b * batch size + r, for any number of processes, of worker processes
and any mesh. A process reads the rows that its devices hold (`sharding.process_rows`). So a saved
position is a number of batches.

The example of a record that cannot be read is replaced by the one of the next position, which any
process can do alone. The record is counted in `Loader.skipped` under its file and position. More
than `Loader.MAX_BAD` different bad records stop the run.

For validation, `one_pass` yields every record once, in order, with weight 1. Fillers of weight 0
complete the batches, so that all processes get the same number of batches.

Position k of a mixture is a record of the part whose share is furthest behind its weight. Any long
stretch of the sequence therefore has the proportions of the weights.
"""

from __future__ import annotations

import logging
import re
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import grain
import ml_dtypes
import numpy as np
from absl import flags

from egosim_jax.data.manifest import Manifest
from egosim_jax.data.mixing import Mixture
from egosim_jax.data.shards import ShardReader
from egosim_jax.io.bounded import listing, named
from egosim_jax.runtime.command import ExitCode, ProcessExit
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)

LATENTS = ("target", "prior", "hands", "mask")
"""Arrays of a latents record with latent frames, rows and columns."""
_DEATH = re.compile(r"Worker process was terminated unexpectedly with exit code (-?\d+)")
"""Grain's error for a worker process that ended by itself."""
_THREADS = 4
_READING = grain.ReadOptions(num_threads=_THREADS, prefetch_buffer_size=2 * _THREADS)

Example = Mapping[str, np.ndarray]
Transform = grain.transforms.RandomMap | grain.transforms.Map | Callable[[Example], Example] | None


def make_loader(
    source: ShardReader | Mixture,
    *,
    batch_size: int,
    seed: int,
    rows: Sequence[int] | None = None,
    workers: int = 0,
    shuffle: bool = True,
    transform: Transform = None,
) -> Loader:
    """Return an iterator over the examples of some rows of each batch, by default of all.

    `transform` maps a record's arrays to an example, with random numbers if it is a `RandomMap`;
    examples also get `record`, their index in the source. `workers` processes prepare examples; 0
    prepares them in threads of this process.
    """
    rows = _checked(rows, batch_size)
    mixed = isinstance(source, Mixture)
    if isinstance(source, Mixture):
        positions = _mixed(source, seed, shuffle)
    else:
        positions = _positions(source, seed, shuffle).repeat()
    examples = positions.random_map(_Read(source, transform), seed=seed if mixed else None)
    skipped: Counter[str] = Counter()

    def open_at(batch: int) -> grain.DatasetIterator:
        positions_of_rows = grain.MapDataset.range(batch * len(rows), sys.maxsize // batch_size)
        read = positions_of_rows.map(_Row(examples, rows, batch_size)).to_iter_dataset(_READING)
        if workers:
            flags.FLAGS.mark_as_parsed()
            read = read.mp_prefetch(
                grain.MultiprocessingOptions(num_workers=workers), _outlive_sigterm
            )
        return iter(read.map(_Count(skipped)).batch(len(rows), drop_remainder=True))

    contract = {
        "data": source.manifest.fingerprint,
        "batch_size": batch_size,
        "seed": seed,
        "shuffle": shuffle,
    }
    if isinstance(source, Mixture):
        contract["weights"] = list(source.weights)
    return Loader(open_at, contract, skipped)


def one_pass(
    source: ShardReader | Mixture,
    *,
    batch_size: int,
    rows: Sequence[int] | None = None,
    transform: Transform = None,
) -> Iterator[dict[str, np.ndarray]]:
    """Yield the examples of some rows of each batch of one pass, in order, with their `weight`.

    Every readable record occurs once with weight 1. A copy of one readable record, with weight 0
    and the same on all processes, replaces bad records and completes the last batch. Raises
    `InputError` if none of the first records can be read.
    """
    rows = _checked(rows, batch_size)
    examples = _positions(source, 0, shuffle=False).random_map(_Read(source, transform))
    filler = _first_readable(examples, source)
    firsts = range(0, len(source), batch_size)
    in_data = [first + row for first in firsts for row in rows if first + row < len(source)]
    chosen = grain.MapDataset.source(in_data).map(examples.__getitem__).to_iter_dataset(_READING)
    with closing(iter(chosen)) as stream:
        for _ in firsts:
            read = [next(stream, None) for _ in rows]
            for bad in read:
                if isinstance(bad, _Bad):
                    logger.warning("skipping %s", printable(bad.message))
            kept = [example if isinstance(example, dict) else filler for example in read]
            batch = {name: np.stack([example[name] for example in kept]) for name in filler}
            weight = [isinstance(example, dict) for example in read]
            yield {**batch, "weight": np.array(weight, np.float32)}


def _outlive_sigterm(worker: int, workers: int) -> None:
    """Ignore SIGTERM, which Slurm sends to worker processes too: the trainer stops them."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)


def _checked(rows: Sequence[int] | None, batch_size: int) -> Sequence[int]:
    """Return the rows, by default all. Raises `InputError` unless they ascend within the batch."""
    rows = range(batch_size) if rows is None else rows
    if not rows or list(rows) != sorted(set(rows)) or not 0 <= rows[0] <= rows[-1] < batch_size:
        raise InputError(
            f"A batch of {batch_size} has no rows {list(rows)}: give at least one row, in "
            f"ascending order, from 0 to {batch_size - 1}. (--batch-size)"
        )
    return rows


def _first_readable(
    examples: grain.MapDataset, source: ShardReader | Mixture
) -> dict[str, np.ndarray]:
    """Return the first example that is not a placeholder of a bad record."""
    bad = []
    for number in range(min(len(source), Loader.MAX_BAD + 1)):
        example: Any = examples[number]
        if not isinstance(example, _Bad):
            return example
        bad.append(example.message)
    raise InputError(
        f"None of the first {len(bad)} records of {source.folder} can be read: at most "
        f"{Loader.MAX_BAD} of all, and not all, may be damaged. Encode or pack them again: "
        f"{listing(bad)}"
    )


def _positions(source: ShardReader | Mixture, seed: int, shuffle: bool) -> grain.MapDataset:
    """Return one pass over the records of a source."""
    positions = grain.MapDataset.range(len(source)).seed(seed)
    return positions.shuffle() if shuffle else positions


def _mixed(source: Mixture, seed: int, shuffle: bool) -> grain.MapDataset:
    """Return endless passes over each part, in proportion to their weights."""
    passes, start = [], 0
    for number, part in enumerate(source.parts):
        seed_of_part = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
        positions = grain.MapDataset.range(start, start + len(part)).seed(seed_of_part)
        passes.append((positions.shuffle() if shuffle else positions).repeat())
        start += len(part)
    return grain.MapDataset.mix(passes, list(source.weights))


class Loader:
    """An iterator over batches, whose state is saved in checkpoints along with the weights.

    `skipped` counts the bad records so far, by name. `set_state` raises `InputError` if the state
    was saved by a loader of another sequence. Close the loader to end its worker processes.
    """

    MAX_BAD = 16
    """Maximum number of different bad records."""

    def __init__(
        self,
        open_at: Callable[[int], grain.DatasetIterator],
        contract: Mapping[str, Any],
        skipped: Counter[str],
    ):
        """`open_at` returns an iterator that begins at a batch."""
        self.contract, self.skipped = dict(contract), skipped
        self._open_at, self._read = open_at, 0
        self._batches = open_at(0)

    def __iter__(self) -> Loader:
        return self

    def __next__(self) -> dict[str, np.ndarray]:
        """Raise `ProcessExit` if a worker process has died."""
        try:
            batch = next(self._batches)
        except RuntimeError as error:
            if (death := _DEATH.search(str(error))) is None:
                raise
            raise ProcessExit(
                f"A worker process that reads data has died with exit code {death[1]} (-9: killed, "
                "often because memory ran out). Run the same command again, or with fewer workers. "
                "(--training.workers)",
                ExitCode.RESUBMIT,
            ) from error
        self._read += 1
        return batch

    def get_state(self) -> dict[str, Any]:
        """Return the number of batches read and all settings that determine them, as JSON values.

        It is the same on all processes.
        """
        return {"contract": self.contract, "batches": self._read}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from a state of `get_state`, also of a loader of other rows or workers."""
        saved = state["contract"]
        differing = [
            f"{name}: the state has {saved.get(name)}, this loader {value}"
            for name, value in self.contract.items()
            if saved.get(name) != value
        ]
        if differing:
            raise InputError(
                f"The saved data position is of another sequence: {listing(differing)}."
            )
        self.close()
        self._read = state["batches"]
        self._batches = self._open_at(self._read)

    def close(self) -> None:
        """End the threads and worker processes."""
        self._batches.close()


def _check(arrays: Example, manifest: Manifest) -> None:
    """Raise `InputError` for non-finite values, or latents of another shape than the manifest's."""
    for name, array in arrays.items():
        floating = array.dtype.kind == "f" or array.dtype == ml_dtypes.bfloat16
        if floating and not np.isfinite(array).all():
            raise InputError(f"{name} has values that are not finite (NaN or infinity).")
        if manifest.kind == "latents" and manifest.spec is not None and name in LATENTS:
            shape, expected = array.shape[:-1], manifest.grid.latent_shape(manifest.spec)
            if shape != expected:
                raise InputError(
                    f"{name} has {shape} latent frames, rows and columns; expected {expected}."
                )


@dataclass(frozen=True)
class _Bad:
    """A placeholder of a record that cannot be read."""

    message: str


@dataclass(frozen=True)
class _Read(grain.transforms.RandomMap):
    """A transform from the index of a record to an example."""

    source: ShardReader | Mixture
    transform: Transform

    def random_map(self, element: int, rng: np.random.Generator) -> Any:
        """Return the example, or a placeholder with the error."""
        try:
            arrays = self.source[element].arrays
            _check(arrays, self.source.manifest)
            example = self._transformed(arrays, rng)
        except InputError as error:
            return _Bad(named(self.source.name(element), error))
        return {**example, "record": np.int32(element)}

    def _transformed(self, arrays: Example, rng: np.random.Generator) -> Any:
        match self.transform:
            case None:
                return arrays
            case grain.transforms.RandomMap():
                return self.transform.random_map(arrays, rng)
            case grain.transforms.Map():
                return self.transform.map(arrays)
            case _:
                return self.transform(arrays)


@dataclass(frozen=True)
class _Row(grain.transforms.Map):
    """A transform from the index of an example of some rows of all batches to the example.

    It returns bad records before the example, too, and no example after too many.
    """

    examples: grain.MapDataset
    rows: Sequence[int]
    batch_size: int

    def map(self, element: int) -> Any:
        """Return the first example that can be read from the row's position on."""
        batch, row = divmod(element, len(self.rows))
        position, bad = batch * self.batch_size + self.rows[row], []
        while isinstance(example := self.examples[position + len(bad)], _Bad):
            bad.append(example)
            if len(bad) > Loader.MAX_BAD:
                return None, bad
        return example, bad


@dataclass(frozen=True)
class _Count(grain.transforms.Map):
    """A transform that counts the bad records before an example; too many stop the run."""

    skipped: Counter[str]

    def map(self, element: tuple[Any, list[_Bad]]) -> Any:
        """Return the example."""
        example, bad = element
        for message in (record.message for record in bad):
            if message not in self.skipped:
                logger.warning("skipping %s", printable(message))
            self.skipped[message] += 1
        if example is None or len(self.skipped) > Loader.MAX_BAD:
            raise InputError(f"Too many records cannot be read: {listing(list(self.skipped))}")
        return example
