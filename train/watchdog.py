"""Ends a run that hangs, after printing where."""

from __future__ import annotations

import faulthandler
import os
import sys
import threading
import time
from collections import deque
from statistics import median

from egosim_jax.command import HUNG

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
