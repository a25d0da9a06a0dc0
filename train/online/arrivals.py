"""Queue of clips: the processes that fill it, and the thread that reads it."""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from egosim_jax.data.records import stacked
from egosim_jax.io.untrusted.npz import read_all
from egosim_jax.train.online.plan import OnlineTraining
from egosim_jax.train.online.pool import CHUNK
from egosim_jax.train.online.scenes import HELD_OUT, queued


class Clips(threading.Thread):
    """Reader of the queue: chunks of raw clips, and the held-out ones."""

    def __init__(self, folder: Path):
        super().__init__(daemon=True)
        self.folder, self.chunks = folder, queue.Queue(maxsize=4)
        self.held: list[Mapping[str, np.ndarray]] = []

    def run(self) -> None:
        """Read files as they appear."""
        rows: list[Mapping[str, np.ndarray]] = []
        while self.folder.is_dir():
            for path in queued(self.folder):
                row = read_all(path)  # NumPy's own reader fails in threads of Python 3.11
                path.unlink()
                if path.name.startswith(HELD_OUT):
                    self.held.append(row)
                    continue
                rows.append(row)
                if len(rows) == CHUNK:
                    self.chunks.put(stacked(rows))
                    rows = []
            time.sleep(0.1)


def start_workers(plan: OnlineTraining, folder: Path, *, made: int) -> list[subprocess.Popen]:
    """Start the processes that make scenes, first the held-out ones.

    `made` clips were made before an interruption; a scene has at least one of them.
    """
    threads = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", **dict.fromkeys(threads, "1")}
    command = [sys.executable, "-m", "egosim_jax.train.online.scenes"]
    command += ["--config", plan.model.name, "--queue", str(folder)]
    command += ["--stride", str(plan.workers), "--held-out", str(plan.held_out), "--first"]
    with (plan.out / "scenes.log").open("a") as log:
        return [
            subprocess.Popen(  # noqa: S603 - this package's module
                [*command, str(plan.first_scene + made + number)],
                env=environment,
                stderr=log,
                stdout=log,
            )
            for number in range(plan.workers)
        ]
