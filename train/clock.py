"""Where the time of a run goes."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import jax

from egosim_jax.preflight.targets import peak

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
