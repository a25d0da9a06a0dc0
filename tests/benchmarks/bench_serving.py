"""Steps a second of `egosim serve` at several numbers of sessions, and what 500 steps leave behind.

    python -m tests.benchmarks.bench_serving [--sessions 1 4 8 16] [--seconds 60] [--batch 4]
    python -m tests.benchmarks.bench_serving --stream [--sessions 1 4]
    python -m tests.benchmarks.bench_serving --leak 500

The first line is one session at a time, without batching, one thread; each other one is as many
clients that send their next step when they have the result of the last. Latency is the client's:
from sending the action to having the frames. A level ends after `--seconds`, and the steps under
way are waited for. With `--stream` the clients ask for frames as they are decoded, and the
seconds until they have the first and the last ones are printed. The last form steps one session of
a small painted world and reads resident memory and open files of the server on the way.
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

from egosim_jax.interactive.server.client import Client

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
    address: str,
    seed: int,
    until: list[float],
    ready: threading.Barrier,
    seconds: list,
    streamed: list | None,
):
    """Make steps of one session until a time; append the seconds of each.

    To `streamed`, those until its first and its last frames.
    """
    with Client(address) as client:
        session = client.create(seed=seed)
        row, count = session.reply["row"], client.server["rows"]
        path = 0.03 * np.linspace(0, 1, count)[:, None] * np.eye(7)[1]
        session.step(row + path)  # its first step has waited for others to start
        ready.wait()
        number = 1
        while time.monotonic() < until[0]:
            then, shown = time.monotonic(), []
            rows = row + path + 0.03 * (number % 8) * np.eye(7)[1]
            if streamed is None:
                session.step(rows)
            else:
                session.step(rows, show=lambda _, n=shown: n.append(time.monotonic()), observe=[])
                streamed.append((shown[0] - then, shown[-1] - then))
            seconds.append(time.monotonic() - then)
            number += 1


def core_seconds(process: subprocess.Popen) -> float:
    """Return the seconds of cores that a process has used."""
    fields = Path(f"/proc/{process.pid}/stat").read_text("ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def load(
    process: subprocess.Popen, address: str, sessions: int, seconds: float, *, stream: bool = False
) -> str:
    """Return the figures of a number of sessions."""
    until, took = [0.0], [[] for _ in range(sessions)]
    groups: list[list] = [[] for _ in range(sessions)]
    begun, used = [0.0], [0.0]

    def begin() -> None:
        begun[0], used[0] = time.monotonic(), core_seconds(process)
        until[0] = begun[0] + seconds

    ready = threading.Barrier(sessions, action=begin)
    threads = [
        threading.Thread(
            target=step_until,
            args=(address, 3 + n, until, ready, took[n], groups[n] if stream else None),
        )
        for n in range(sessions)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    span = time.monotonic() - begun[0]
    all_ = np.concatenate([np.array(one) for one in took])
    p50, p99 = np.percentile(all_, [50, 99])
    found = (
        f"{sessions:>8} sessions {len(all_):>4} steps {len(all_) / span:>7.3f} steps/s "
        f"p50 {p50:>6.2f} s p99 {p99:>6.2f} s, "
        f"{(core_seconds(process) - used[0]) / len(all_):.2f} core seconds a step"
    )
    if not stream:
        return found
    first, last = np.median(np.concatenate([np.array(one) for one in groups]), axis=0)
    return f"{found}, first frames p50 {first:.2f} s, last frames p50 {last:.2f} s"


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
    parser.add_argument("--stream", action="store_true")
    parser.add_argument("--leak", type=int, default=0)
    given = parser.parse_args()
    if given.leak:
        leak(given.leak)
        return
    served = ["egosim_jax.cli", "serve", "--port", "0"]
    with server(*served, "--batch", "1", "--threads", "1", "--out") as (process, address):
        alone = load(process, address, 1, given.seconds, stream=given.stream)
        print("one at a time:", alone, os.getloadavg(), flush=True)
    with server(*served, "--batch", given.batch, "--out") as (process, address):
        for sessions in given.sessions:
            found = load(process, address, sessions, given.seconds, stream=given.stream)
            print(found, os.getloadavg(), flush=True)


if __name__ == "__main__":
    main()
