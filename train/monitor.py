"""What watches over a run: the clock, the watchdog, and sample clips."""

from __future__ import annotations

import faulthandler
import os
import resource
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from itertools import cycle, islice
from pathlib import Path
from statistics import median
from typing import Any, Literal

import jax
import numpy as np
from flax import nnx
from jax.experimental import multihost_utils

from egosim_jax.command import HUNG
from egosim_jax.conditioning.video import to_uint8
from egosim_jax.data.records import Record
from egosim_jax.data.shards import ShardReader
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.generator import denoise
from egosim_jax.io.video import write_video
from egosim_jax.networks import ModelConfig, Networks
from egosim_jax.preflight.targets import peak
from egosim_jax.sharding import batch_sharding, parts
from egosim_jax.train.tasks.denoising import condition_of

Phase = Literal["start", "compile", "data", "step", "validate", "sample", "save"]
PHASES: dict[Phase, str] = {
    "start": "weights, checkpoint",
    "compile": "compiling",
    "data": "waiting for data",
    "step": "updates",
    "validate": "validation",
    "sample": "sample clips",
    "save": "waiting for checkpoints",
}


class Clock:
    """Adds up seconds by phase, and says how fast the steps are."""

    def __init__(self, *, flops: float):
        """`flops` are the model's in an update, over all devices."""
        self.flops = flops
        self.seconds: dict[str, float] = dict.fromkeys(PHASES, 0.0)
        self._before = dict(self.seconds)
        self._step = 0
        self._began = time.monotonic()

    @contextmanager
    def phase(self, name: Phase) -> Iterator[None]:
        """Count what is done here."""
        then = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] += time.monotonic() - then

    def begin(self, step: int) -> None:
        """Count steps from this one on."""
        self._step, self._before = step, dict(self.seconds)

    def tick(self, step: int, steps: int) -> dict[str, float]:
        """The numbers of the steps since the last call: how fast they were, and what is left.

        `seconds` a step has the wait for data in it, of which `waiting` is the share; TFLOP/s and
        MFU are per device, and left out where FLOPs or the device's peak are not known.
        """
        count = max(1, step - self._step)
        waited, worked = (self.seconds[name] - self._before[name] for name in ("data", "step"))
        self.begin(step)
        seconds = (waited + worked) / count
        rate = self.flops / jax.device_count() / seconds
        numbers = {
            "seconds": seconds,
            "waiting": waited / (waited + worked),
            "tflops": rate / 1e12,
            "mfu": rate / peak(jax.devices()[0].device_kind),
            "gigabytes": memory() / 1e9,
            "minutes_left": seconds * (steps - step) / 60,
        }
        return {name: value for name, value in numbers.items() if value == value}

    def table(self) -> str:
        """Seconds and share of each phase, a line each."""
        whole = time.monotonic() - self._began
        rows = {PHASES[name]: self.seconds[name] for name in PHASES if self.seconds[name]}
        rows["the rest"] = whole - sum(rows.values())
        return "\n".join(
            f"  {name:<24}{seconds:>10.1f} s {seconds / whole:>7.1%}"
            for name, seconds in {**rows, "in all": whole}.items()
        )


def memory() -> float:
    """Bytes at most in use: of the first device's memory, or, on a CPU, of the process."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "peak_bytes_in_use" in stats:
        return float(stats["peak_bytes_in_use"])
    scale = 1 if sys.platform == "darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale)


SLOWEST = 10
"""Times the median of the last intervals: longer is a hang."""


class Watchdog:
    """A thread that expects a sign of life.

    Without one for `SLOWEST` times the usual interval, and at least for `patience` seconds, it
    prints the stacks of all threads and ends the process with exit code 70: a supervisor can then
    start the run again, which resumes. It sleeps until the first `beat`, since compiling may take
    long, and between `rest` and the next one.
    """

    def __init__(self, patience: float):
        self.patience = patience
        self._intervals: deque[float] = deque(maxlen=100)
        self._last: float | None = None
        self._ended = threading.Event()
        threading.Thread(target=self._watch, daemon=True, name="watchdog").start()

    def beat(self) -> None:
        """Say that a step was finished."""
        now = time.monotonic()
        if self._last is not None:
            self._intervals.append(now - self._last)
        self._last = now

    def rest(self) -> None:
        """Expect nothing until the next beat."""
        self._last = None

    def close(self) -> None:
        """End the thread."""
        self._ended.set()

    def _watch(self) -> None:
        while not self._ended.wait(min(self.patience / 10, 10.0)):
            last = self._last
            if last is None:
                continue
            usual = median(self._intervals) if self._intervals else 0.0
            limit, waited = max(self.patience, SLOWEST * usual), time.monotonic() - last
            if waited > limit:
                print(
                    f"no step was finished for {waited:.0f} s, where one takes {usual:.1f} s. "
                    "Every thread's stack:",
                    file=sys.stderr,
                )
                faulthandler.dump_traceback(all_threads=True)
                os._exit(HUNG)


MOMENTS = 6
"""Frames of a clip on the contact sheet."""


@dataclass(frozen=True, kw_only=True)
class Samples:
    """The first records of a folder of latents, generated from the same noise each time."""

    model: ModelConfig
    """The model that is trained."""
    latents: Path
    """Shards, as a rule those of the validation."""
    vae: Path
    """Weights folder with the autoencoder that made them."""
    count: int = 2
    """How many clips."""

    def write(self, networks: nnx.Module, out: Path, step: int) -> None:
        """Write OUT/step_N.mp4 and .png: each clip generated and, beside it, its truth.

        Called under the mesh of the training, by all of its processes.
        """
        graph, params = nnx.split(networks)
        generated = self._frames(_generate(graph, params, self._batch, self.model))
        truth = self._truth
        if jax.process_index() != 0:
            return
        pairs = [np.concatenate(pair, axis=2) for pair in zip(generated, truth, strict=True)]
        path = out / f"step_{step:06d}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_video(path, np.concatenate(pairs, axis=1), self.model.video.fps)
        moments = np.linspace(0, self.model.video.frames - 1, MOMENTS).round().astype(int).tolist()
        names = [record.metadata["video_id"] for record in self._records]
        blocks = [
            SheetClip(f"{name}, step {step}: generated, truth", list(pair))
            for name, *pair in zip(names, generated, truth, strict=True)
        ]
        draw_sheet(blocks, path.with_suffix(".png"), moments=moments)

    def _frames(self, latents: jax.Array) -> np.ndarray:
        frames = _decode(*self._vae, latents)
        return multihost_utils.process_allgather(frames, tiled=True)[: len(self._records)]

    @cached_property
    def _truth(self) -> np.ndarray:
        return self._frames(self._batch["target"])

    @cached_property
    def _vae(self) -> tuple[nnx.GraphDef, nnx.State]:
        networks = Networks.load(self.model, self.vae, only=["vae"])
        return nnx.split(networks.vae)

    @cached_property
    def _records(self) -> list[Record]:
        reader = ShardReader(self.latents)
        return [reader[i] for i in range(min(self.count, len(reader)))]

    @cached_property
    def _batch(self) -> dict[str, jax.Array]:
        """The records, repeated until the devices can share them."""
        found = [record.arrays for record in self._records]
        size = -(-len(found) // parts("batch")) * parts("batch")
        where = batch_sharding(jax.sharding.get_mesh())
        rows = list(islice(cycle(found), size))
        arrays = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        return {
            name: jax.make_array_from_callback(array.shape, where, array.__getitem__)
            for name, array in arrays.items()
        }


@jax.jit(static_argnums=(0, 3))
def _generate(
    graph: nnx.GraphDef, params: nnx.State, batch: dict[str, jax.Array], model: ModelConfig
) -> Any:
    networks: Any = nnx.merge(graph, params)
    keys = jax.random.split(jax.random.key(0), len(batch["target"]))
    noise = jax.vmap(lambda key: jax.random.normal(key, batch["target"].shape[1:]))(keys)
    return denoise(networks.dit, condition_of(networks, batch), noise, model)


@jax.jit(static_argnums=0)
def _decode(graph: nnx.GraphDef, params: nnx.State, latents: jax.Array) -> jax.Array:
    vae: Any = nnx.merge(graph, params)
    return to_uint8(vae.decode(latents))
