"""Batches from shards: shuffled, split over processes, cut into windows, prefetched, resumable.

The loader iterates over one endless sequence of records that depends on the seed alone: every epoch
is a new permutation, and position k of the sequence has its own random numbers for its window.
Process p of n takes positions p, p + n, p + 2n, ..., so that global batch b holds the same
positions for any number of processes. Worker processes share the positions in the same order.

A record that cannot be read is skipped, counted in `Loader.skipped` under its file and position,
and replaced by the next one. More than `Loader.MAX_BAD` different bad records stop the run.

For validation, `one_pass` yields every record once, in order, with weight 1. Fillers of weight 0
complete the batches, so that all processes get the same number of batches.

Position k of a mixture is a record of the part whose share is furthest behind its weight. Any long
stretch of the sequence therefore has the proportions of the weights.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
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
from egosim_jax.runtime.terminal import printable
from egosim_jax.types import InputError

logger = logging.getLogger(__name__)

LATENTS = ("target", "prior", "hands", "mask")
"""Arrays of a latents record with latent frames, rows and columns."""
_THREADS = 4
_READING = grain.ReadOptions(num_threads=_THREADS, prefetch_buffer_size=2 * _THREADS)

Example = Mapping[str, np.ndarray]
Transform = grain.transforms.RandomMap | grain.transforms.Map | Callable[[Example], Example] | None


def make_loader(
    source: ShardReader | Mixture,
    *,
    batch_size: int,
    seed: int,
    process_index: int = 0,
    process_count: int = 1,
    workers: int = 0,
    shuffle: bool = True,
    transform: Transform = None,
) -> Loader:
    """Return an iterator over this process's examples of each batch.

    A process gets `batch_size / process_count` examples of each batch. `transform` maps a record's
    arrays to an example, with random numbers if it is a `RandomMap`; examples also get `record`,
    their index in the source. `workers` processes prepare examples; 0 prepares them in threads of
    this process.
    """
    if batch_size < 1 or batch_size % process_count:
        raise InputError(
            f"A batch of {batch_size} cannot be shared by {process_count} processes: it must be a "
            "multiple of their number. (--batch-size)"
        )
    mixed = isinstance(source, Mixture)
    if isinstance(source, Mixture):
        positions = _mixed(source, seed, shuffle)
    else:
        positions = _positions(source, seed, shuffle).repeat()
    examples = positions.random_map(_Read(source, transform), seed=seed if mixed else None)
    stream = examples[process_index::process_count].to_iter_dataset(_READING)
    if workers:
        flags.FLAGS.mark_as_parsed()
        stream = stream.mp_prefetch(grain.MultiprocessingOptions(num_workers=workers))
    skipped: Counter[str] = Counter()
    batches = stream.filter(_Healthy(skipped)).batch(
        batch_size // process_count, drop_remainder=True
    )
    contract = {
        "data": source.manifest.fingerprint,
        "batch_size": batch_size,
        "seed": seed,
        "process_index": process_index,
        "process_count": process_count,
        "workers": workers,
        "shuffle": shuffle,
    }
    if isinstance(source, Mixture):
        contract["weights"] = list(source.weights)
    return Loader(iter(batches), contract, skipped)


def one_pass(
    source: ShardReader | Mixture,
    *,
    batch_size: int,
    process_index: int = 0,
    process_count: int = 1,
    transform: Transform = None,
) -> Iterator[dict[str, np.ndarray]]:
    """Yield this process's examples of each batch of one pass, in order, with their `weight`.

    Every readable record occurs once with weight 1. A copy of one readable record, with weight 0
    and the same on all processes, replaces bad records and completes the last batch. Raises
    `InputError` if none of the first records can be read.
    """
    examples = _positions(source, 0, shuffle=False).random_map(_Read(source, transform))
    filler = _first_readable(examples, source)
    own = batch_size // process_count
    with closing(iter(examples[process_index::process_count].to_iter_dataset(_READING))) as stream:
        for _ in range(0, len(source), batch_size):
            read = [next(stream, None) for _ in range(own)]
            for bad in read:
                if isinstance(bad, _Bad):
                    logger.warning("skipping %s", printable(bad.message))
            kept = [example if isinstance(example, dict) else filler for example in read]
            batch = {name: np.stack([example[name] for example in kept]) for name in filler}
            weight = [isinstance(example, dict) for example in read]
            yield {**batch, "weight": np.array(weight, np.float32)}


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
        own = int(np.random.SeedSequence([seed, number]).generate_state(1)[0])
        positions = grain.MapDataset.range(start, start + len(part)).seed(own)
        passes.append((positions.shuffle() if shuffle else positions).repeat())
        start += len(part)
    return grain.MapDataset.mix(passes, list(source.weights))


class Loader(grain.DatasetIterator):
    """An iterator over batches, whose state is saved in checkpoints along with the weights.

    `skipped` counts the bad records so far, by name. `set_state` raises `InputError` if the state
    was saved by a loader of another sequence. Close the loader to end its worker processes.
    """

    MAX_BAD = 16
    """Maximum number of different bad records."""

    def __init__(
        self,
        batches: grain.DatasetIterator,
        contract: Mapping[str, Any],
        skipped: Counter[str],
    ):
        super().__init__(batches)
        self.contract, self.skipped = dict(contract), skipped
        self._batches = batches

    def __next__(self) -> dict[str, np.ndarray]:
        return next(self._batches)

    def get_state(self) -> dict[str, Any]:
        """Return the position and all settings that determine the sequence, as JSON values."""
        return {"contract": self.contract, "position": self._batches.get_state()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from a state of `get_state`."""
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
        self._batches.set_state(state["position"])


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
class _Healthy(grain.transforms.Filter):
    """A filter that drops and counts bad records, and stops the run after too many."""

    skipped: Counter[str]

    def filter(self, element: Any) -> bool:
        """Return True for an example, False for a placeholder."""
        if not isinstance(element, _Bad):
            return True
        if element.message not in self.skipped:
            logger.warning("skipping %s", printable(element.message))
        self.skipped[element.message] += 1
        if len(self.skipped) > Loader.MAX_BAD:
            raise InputError(f"Too many records cannot be read: {listing(list(self.skipped))}")
        return False
