"""Trainings that get SIGTERM at random times and run again, until they are complete.

Each must end with the exit code 75 after at most one more update, and come to the files of a run
without a signal, as in `kills.py`. Of several processes it may be two: a waiting process passes the
signal on (`train/peers.py`), and an update here takes less time.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from egosim_jax.train.distributed import free_local_address
from tests.crash.kills import MODEL, artifacts, differences, prepare
from tests.flags import QUICK

BEGINS_S = 2.0
"""Time after which Python runs the program's first line, in seconds."""
END_S = 300.0
"""Time in which a run must end after the signal, in seconds."""
STOPS = 5
"""Signals of a trial, at most."""


def _stage(name: str, steps: int) -> str:
    every = {"log": 1, "save": 3, "validate": 4}
    options = [f"--{name}.{what}-every {count}" for what, count in every.items()]
    return " ".join([f"--{name}.steps {steps}", *options])


BATCH = "--latents ../latents --training.batch-size 2 --training.grad-accum-steps 1"
# The random weights end in zeros, which give a LoRA no gradient.
START = f"egosim_14b_fewshot {MODEL} {BATCH} --training.steps 2 --out start"
START += " --training.optimizer.learning-rate 0.01"
TUNED = f"--config debug --weights ../start/weights {BATCH} {_stage('training', 20)}"
TUNED += " --validation ../latents --samples 1"
SCRATCH = f"{_stage('vae', 8)} {_stage('denoiser', 8)}"
COMMANDS = {
    "debug": f"debug {SCRATCH}",
    "tabletop": f"tabletop --scenes 4 --held-out 2 {SCRATCH} --denoiser.sample-every 6",
    "lora": f"egosim_14b_lora {TUNED} --rank 4",
    "student": f"egosim_14b_student_ar {TUNED} --chunks 1 2",
}
"""Trainings without their `--out out`, run in a folder next to the `kills.INPUTS`."""
SHARED = ("lora", "student")
"""Trainings that several processes can share."""


@dataclass
class Tally:
    """Results of the signals of a training."""

    name: str
    processes: int
    seconds: float
    stops: int = 0
    updates: int = 0
    longest_s: float = 0.0
    trials: int = 0
    failures: int = 0

    def __str__(self) -> str:
        return (
            f"{self.name}, {self.processes} process(es), {self.seconds:.0f} s: {self.stops} stops, "
            f"at most {self.updates} update(s) and {self.longest_s:.1f} s after the signal, "
            f"{self.failures} failures in {self.trials} trials"
        )


class Training:
    """A training in a folder, by one process or several."""

    def __init__(self, name: str, place: Path, processes: int):
        self.place, self.processes = place, processes
        options = [*COMMANDS[name].split(), "--out", "out"]
        self.command = [sys.executable, "-m", "egosim_jax.train", *options]
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)

    def start(self) -> list[subprocess.Popen[bytes]]:
        """Start or resume it, each process in a separate group."""
        started, address = [], free_local_address()
        for index in range(self.processes):
            joins = {
                "JAX_COORDINATOR_ADDRESS": address,
                "JAX_NUM_PROCESSES": str(self.processes),
                "JAX_PROCESS_ID": str(index),
            }
            environment = os.environ | (joins if self.processes > 1 else {})
            with (self.place / f"log_{index}").open("ab") as log:
                started.append(
                    subprocess.Popen(
                        self.command,
                        cwd=self.place,
                        env=environment,
                        stdout=log,
                        stderr=log,
                        start_new_session=True,
                    )
                )
        return started

    def finish(self) -> dict[str, str]:
        """Run to the end; return the digests of its files."""
        codes = [process.wait() for process in self.start()]
        assert not any(codes), self.said()
        return artifacts(self.place / "out")

    def updates(self) -> int:
        """Return the number of logged updates of all stages."""
        lines = [
            json.loads(line)
            for path in (self.place / "out").rglob("metrics.jsonl")
            for line in path.read_text("utf-8").splitlines(keepends=True)
            if line.endswith("\n")
        ]
        return sum("grad_norm" in line for line in lines)

    def said(self) -> str:
        """Return the end of the output of all processes."""
        logs = sorted(self.place.glob("log_*"))
        return "\n".join(log.read_text("utf-8", "replace")[-2000:] for log in logs)


def stop_often(name: str, folder: Path, *, processes: int, stops: int, seed: int) -> Tally:
    """Send a training so many signals; several in each trial, whose end is compared."""
    chance = random.Random(f"{seed} {name} {processes}")
    title = f"{name}_{processes}"
    Training(name, folder / f"{title}_warm", processes).finish()  # fills the compile cache
    then = time.monotonic()
    wanted = Training(name, folder / f"{title}_reference", processes).finish()
    tally = Tally(name, processes, time.monotonic() - then)
    while tally.stops < stops:
        run = Training(name, folder / f"{title}_{tally.trials}", processes)
        for _ in range(min(STOPS, stops - tally.stops)):
            if not _stopped_after(chance, run, tally):
                break
        for line in differences(wanted, run.finish()):
            tally.failures += 1
            print(f"{run.place}: {line}", flush=True)
        tally.trials += 1
    return tally


def _stopped_after(chance: random.Random, run: Training, tally: Tally) -> bool:
    """Send SIGTERM to all processes at a random time; return whether it ended the run."""
    started = run.start()
    time.sleep(chance.uniform(BEGINS_S, max(BEGINS_S, tally.seconds)))
    send = chance.choice([os.kill, os.killpg])
    if any(process.poll() is not None for process in started):
        assert not any(process.wait() for process in started), run.said()
        return False
    for process in started:  # Slurm signals their children as well, Kubernetes does not
        send(process.pid, signal.SIGTERM)
    then, before = time.monotonic(), run.updates()
    codes = [process.wait(timeout=END_S) for process in started]
    tally.longest_s = max(tally.longest_s, time.monotonic() - then)
    if not any(codes):
        return False
    tally.stops += 1
    further = run.updates() - before
    tally.updates = max(tally.updates, further)
    if {*codes} != {75} or further > run.processes:
        tally.failures += 1
        print(f"{run.place}: {codes}, {further} updates: {run.said()}", flush=True)
    return True


def main(names: Sequence[str], folder: Path, *, stops: int, seed: int) -> int:
    """Stop each of the trainings, on one and on two processes; the exit code."""
    os.environ |= {"XLA_FLAGS": QUICK, "XDG_CACHE_HOME": str(folder.absolute() / "cache")}
    prepare(folder, [START])
    if not (folder / "start" / "weights").exists():
        command = [sys.executable, "-m", "egosim_jax.train", *START.replace("../", "").split()]
        subprocess.run(command, cwd=folder, check=True)
    tallies = []
    for name in names:
        for processes in (1, 2) if name in SHARED else (1,):
            tallies.append(stop_often(name, folder, processes=processes, stops=stops, seed=seed))
            print(tallies[-1], flush=True)
    return int(any(tally.failures for tally in tallies))
