"""Steps a second of `egosim serve` at several numbers of sessions, and what 500 steps leave behind.

    python -m tests.benchmarks.bench_serving [--sessions 1 4 8 16] [--seconds 60] [--batch 4]
    python -m tests.benchmarks.bench_serving --leak 500

The first line is one session at a time, without batching, one thread; each other one is as many
clients that send their next step when they have the result of the last. Latency is the client's:
from sending the action to having the frames. A level ends after `--seconds`, and the steps under
way are waited for. The second form steps one session of a small painted world and reads resident
memory and open files of the server on the way.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from egosim_jax.serving.client import Client

ROOT = Path(__file__).parents[2]


@contextmanager
def server(*command: str):
    """Yield process and address of a server in a new folder."""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    with (
        tempfile.TemporaryDirectory() as folder,
        subprocess.Popen(
            [sys.executable, "-m", *command, f"{folder}/sessions"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            cwd=ROOT,
            env=environment,
        ) as process,
    ):
        assert process.stdout is not None
        try:
            yield process, process.stdout.readline().strip().replace("http", "ws")
        finally:
            process.terminate()
            process.wait(300)


def step_until(
    address: str, seed: int, until: list[float], ready: threading.Barrier, seconds: list
):
    """Make steps of one session until a time; append the seconds of each."""
    with Client(address) as client:
        session = client.create(seed=seed)
        row, count = session.reply["row"], client.server["rows"]
        path = 0.03 * np.linspace(0, 1, count)[:, None] * np.eye(7)[1]
        session.step(row + path)  # its first step has waited for others to start
        ready.wait()
        number = 1
        while time.monotonic() < until[0]:
            then = time.monotonic()
            session.step(row + path + 0.03 * (number % 8) * np.eye(7)[1])
            seconds.append(time.monotonic() - then)
            number += 1


def load(address: str, sessions: int, seconds: float) -> str:
    """Return the figures of a number of sessions."""
    until, took = [0.0], [[] for _ in range(sessions)]
    begun = [0.0]

    def begin() -> None:
        begun[0] = time.monotonic()
        until[0] = begun[0] + seconds

    ready = threading.Barrier(sessions, action=begin)
    threads = [
        threading.Thread(target=step_until, args=(address, 3 + n, until, ready, took[n]))
        for n in range(sessions)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    span = time.monotonic() - begun[0]
    all_ = np.concatenate([np.array(one) for one in took])
    p50, p99 = np.percentile(all_, [50, 99])
    return (
        f"{sessions:>8} sessions {len(all_):>4} steps {len(all_) / span:>7.3f} steps/s "
        f"p50 {p50:>6.2f} s p99 {p99:>6.2f} s"
    )


def leak(steps: int) -> None:
    """Print memory and open files of a server along the steps of one session."""
    with server("tests.painted") as (process, address), Client(address) as client:
        session = client.create(seed=3)
        row = session.reply["row"]
        for number in range(1, steps + 1):
            session.step(row + 0.02 * (number % 5) * np.eye(7)[1][None])
            if number % (steps // 10) == 0:
                status = Path(f"/proc/{process.pid}/status").read_text("ascii")
                (line,) = (text for text in status.splitlines() if text.startswith("VmRSS"))
                files = len(list(Path(f"/proc/{process.pid}/fd").iterdir()))
                rss = int(line.split()[1]) / 1024
                print(f"step {number:>4}: {rss:.0f} MiB, {files} open files", flush=True)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sessions", type=int, nargs="+", default=[1, 4, 8, 16])
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--batch", default="4")
    parser.add_argument("--leak", type=int, default=0)
    given = parser.parse_args()
    if given.leak:
        leak(given.leak)
        return
    served = ["egosim_jax.cli", "serve", "--port", "0"]
    with server(*served, "--batch", "1", "--threads", "1", "--out") as (_, address):
        print("one at a time:", load(address, 1, given.seconds), os.getloadavg(), flush=True)
    with server(*served, "--batch", given.batch, "--out") as (_, address):
        for sessions in given.sessions:
            print(load(address, sessions, given.seconds), os.getloadavg(), flush=True)


if __name__ == "__main__":
    main()
