"""Monitoring of a run: clock, watchdog, skipped updates, sample clips."""

from __future__ import annotations

import faulthandler
import os
import resource
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
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

from egosim_jax.conditioning.pixels import to_uint8
from egosim_jax.configs.model import ModelConfig, Networks
from egosim_jax.data.mixing import Mixture, open_shards
from egosim_jax.data.records import Record, stacked
from egosim_jax.data.shards import ShardReader
from egosim_jax.generation.generator import denoise
from egosim_jax.preflight.targets import peak
from egosim_jax.runtime.command import CommandExit, ExitCode
from egosim_jax.runtime.terminal import printable
from egosim_jax.sharding import batch_sharding, parts
from egosim_jax.train.tasks.denoising import condition_of
from egosim_jax.train.update import MAX_CONSECUTIVE_SKIPS
from egosim_jax.types import check_counts

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
    """Wall-clock seconds of each phase of a run, and the speed of its updates."""

    def __init__(self, *, flops: float):
        """Start the clock; `flops` are the model FLOPs of an update, over all devices."""
        self.flops = flops
        self.seconds: dict[str, float] = dict.fromkeys(PHASES, 0.0)
        self._before = dict(self.seconds)
        self._step = 0
        self._began = time.monotonic()

    @contextmanager
    def phase(self, name: Phase) -> Iterator[None]:
        """Add the time spent in the context to a phase."""
        then = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] += time.monotonic() - then

    def begin(self, step: int) -> None:
        """Start an interval of updates at `step`."""
        self._step, self._before = step, dict(self.seconds)

    def tick(self, step: int, steps: int) -> dict[str, float]:
        """Return the speed over the interval that ends at `step`, and start the next interval.

        `step_time_s` includes the wait for data, and `data_wait_frac` is its share. TFLOP/s and MFU
        are per device; they are missing if the FLOPs or the device's peak are unknown.
        """
        count = max(1, step - self._step)
        waited, worked = (self.seconds[name] - self._before[name] for name in ("data", "step"))
        self.begin(step)
        seconds = (waited + worked) / count
        rate = self.flops / jax.device_count() / seconds
        numbers = {
            "step_time_s": seconds,
            "data_wait_frac": waited / (waited + worked),
            "tflops": rate / 1e12,
            "mfu": rate / peak(jax.devices()[0].device_kind),
            "peak_mem_gb": peak_memory() / 1e9,
            "eta_min": seconds * (steps - step) / 60,
        }
        return {name: value for name, value in numbers.items() if value == value}  # not NaN

    def by_phase(self) -> dict[str, float]:
        """Return the seconds of each phase by its title, and the remaining seconds as `other`."""
        rows = {PHASES[name]: self.seconds[name] for name in PHASES if self.seconds[name]}
        return {**rows, "other": time.monotonic() - self._began - sum(rows.values())}

    def table(self) -> str:
        """Return a table of the seconds and the share of each phase."""
        rows = self.by_phase()
        total = sum(rows.values())
        return "\n".join(
            f"  {name:<24}{seconds:>10.1f} s {seconds / total:>7.1%}"
            for name, seconds in {**rows, "total": total}.items()
        )


def peak_memory() -> float:
    """Return the peak memory in bytes of the first device or, on a CPU, of the process."""
    stats = jax.local_devices()[0].memory_stats()
    if stats and "peak_bytes_in_use" in stats:
        return float(stats["peak_bytes_in_use"])
    scale = 1 if sys.platform == "darwin" else 1024
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * scale)


HANG_FACTOR = 10
"""Multiple of the median update time beyond which an update counts as hung."""


class Watchdog:
    """A thread that ends the process if no update finishes for too long.

    The limit is `HANG_FACTOR` times the median interval between beats, and at least `timeout_s`
    seconds. Beyond it the watchdog prints the stacks of all threads and ends the process with exit
    code 70; a supervisor can then restart the run, which resumes. It is idle before the first
    `beat`, because compilation may take long, and between `rest` and the next `beat`.
    """

    def __init__(self, timeout_s: float):
        self.timeout_s = timeout_s
        self._intervals: deque[float] = deque(maxlen=100)
        self._last: float | None = None
        self._ended = threading.Event()
        threading.Thread(target=self._watch, daemon=True, name="watchdog").start()

    def beat(self) -> None:
        """Report a finished update."""
        now = time.monotonic()
        if self._last is not None:
            self._intervals.append(now - self._last)
        self._last = now

    def rest(self) -> None:
        """Pause until the next `beat`."""
        self._last = None

    def close(self) -> None:
        """End the thread."""
        self._ended.set()

    def _watch(self) -> None:
        while not self._ended.wait(min(self.timeout_s / 10, 10.0)):
            last = self._last
            if last is None:
                continue
            usual = median(self._intervals) if self._intervals else 0.0
            limit, waited = max(self.timeout_s, HANG_FACTOR * usual), time.monotonic() - last
            if waited > limit:
                print(
                    f"no update finished for {waited:.0f} s; the median is {usual:.1f} s. Stacks "
                    "of all threads:",
                    file=sys.stderr,
                )
                faulthandler.dump_traceback(all_threads=True)
                os._exit(ExitCode.HUNG)  # not sys.exit: the main thread hangs and would not see it


class SkipMonitor:
    """Reporter of skipped updates and their records.

    It checks an update while the next one runs, so the devices never wait for the host.
    """

    def __init__(self, source: ShardReader | Mixture):
        self.source = source
        self._last: tuple[int, Mapping[str, jax.Array], np.ndarray] | None = None

    def watch(self, step: int, metrics: Mapping[str, jax.Array], records: np.ndarray) -> None:
        """Check the previous update, and keep this one for the next check."""
        self.check()
        self._last = step, metrics, records

    def check(self) -> None:
        """Print the records of the last update if it was skipped; stop the run after several."""
        if self._last is None:
            return
        (step, metrics, records), self._last = self._last, None
        student = int(metrics["consecutive_skips"])
        critic = int(metrics.get("critic_consecutive_skips", 0))
        if not student and not int(metrics.get("critic_skips", 0)):
            return
        names = ", ".join(str(self.source[int(i)].metadata["video_id"]) for i in records)
        who = "" if student else "critic: "
        loss, norm = (float(metrics[f"critic_{m}" if who else m]) for m in ("loss", "grad_norm"))
        print(
            printable(
                f"step {step} skipped: {who}loss {loss:.4g}, grad_norm {norm:.4g}, records {names}"
            ),
            file=sys.stderr,
            flush=True,
        )
        if max(student, critic) >= MAX_CONSECUTIVE_SKIPS:
            raise CommandExit(
                f"{max(student, critic)} updates in a row were skipped{who and ' by the critic'}, "
                "so the run stops. They did not "
                "change the weights: inspect the records above, or lower the learning rate.",
                ExitCode.FAILED,
            )


SHEET_FRAMES = 6
"""Number of frames of a clip on the contact sheet."""


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Clips generated during training, always from the same noise, next to their targets.

    A target is the VAE's reconstruction of the ground truth, the best that the denoiser can reach.
    """

    model: ModelConfig
    """Model in training."""
    latents: Path
    """Folder of latents shards, usually the validation's; the first records are used."""
    vae: Path
    """Weights folder with the autoencoder that made the latents."""
    count: int = 2
    """Number of clips to generate."""

    def __post_init__(self) -> None:
        check_counts({"--samples": self.count})

    def write(self, networks: nnx.Module, out: Path, step: int) -> None:
        """Write OUT/step_N.mp4 and .png: each generated clip next to its decoded target.

        All processes of the training call it, under its mesh.
        """
        from egosim_jax.data.sheet import SheetClip, draw_sheet
        from egosim_jax.io.writing import write_video

        graph, params = nnx.split(networks)
        generated = self._frames(_generate(graph, params, self._batch, self.model))
        targets = self._targets
        if jax.process_index() != 0:
            return
        pairs = [np.concatenate(pair, axis=2) for pair in zip(generated, targets, strict=True)]
        path = out / f"step_{step:06d}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_video(path, np.concatenate(pairs, axis=1), self.model.video.fps)
        frames = self.model.video.frames
        moments = np.linspace(0, frames - 1, SHEET_FRAMES).round().astype(int).tolist()
        blocks = [
            SheetClip(f"{name}, step {step}: generated, VAE reconstruction", list(pair))
            for name, *pair in zip(_names(self._records), generated, targets, strict=True)
        ]
        draw_sheet(blocks, path.with_suffix(".png"), moments=moments)

    def _frames(self, latents: jax.Array) -> np.ndarray:
        frames = _decode(*self._vae, latents)
        return multihost_utils.process_allgather(frames, tiled=True)[: len(self._records)]

    @cached_property
    def _targets(self) -> np.ndarray:
        return self._frames(self._batch["target"])

    @cached_property
    def _vae(self) -> tuple[nnx.GraphDef, nnx.State]:
        return nnx.split(Networks.load(self.model, self.vae, only=["vae"]).vae)

    @cached_property
    def _records(self) -> list[Record]:
        reader = open_shards(self.latents)
        return [reader[i] for i in range(min(self.count, len(reader)))]

    @cached_property
    def _batch(self) -> dict[str, jax.Array]:
        """Return the records, repeated until the devices divide the batch size."""
        found = [record.arrays for record in self._records]
        size = -(-len(found) // parts("batch")) * parts("batch")
        where = batch_sharding(jax.sharding.get_mesh())
        rows = list(islice(cycle(found), size))
        arrays = stacked(rows)
        return {
            name: jax.make_array_from_callback(array.shape, where, array.__getitem__)
            for name, array in arrays.items()
        }


def _names(records: Sequence[Record]) -> list[str]:
    """Return a distinct name of each clip: its video and first frame, and a number if needed."""
    names = []
    for number, record in enumerate(records, start=1):
        name, start = record.metadata["video_id"], record.metadata.get("start")
        name = f"{name} from frame {start}" if start else str(name)
        names.append(f"{name} ({number})" if name in names else name)
    return names


@jax.jit(static_argnums=(0, 3))
def _generate(
    graph: nnx.GraphDef, params: nnx.State, batch: dict[str, jax.Array], model: ModelConfig
) -> Any:
    networks: Any = nnx.merge(graph, params)
    keys = jax.random.split(jax.random.key(0), len(batch["target"]))
    noise = jax.vmap(lambda key: jax.random.normal(key, batch["target"].shape[1:]))(keys)
    condition = condition_of(networks, batch, model)
    return denoise(networks.dit, condition, noise, model, keys)


@jax.jit(static_argnums=0)
def _decode(graph: nnx.GraphDef, params: nnx.State, latents: jax.Array) -> jax.Array:
    vae: Any = nnx.merge(graph, params)
    return to_uint8(vae.decode(latents))
