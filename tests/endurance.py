"""A run that is killed again and again gives what a run gives that was left alone, bit for bit.

    python -m tests.endurance [--kills 20] [--processes 1] [--seed 0]

trains a tiny denoiser with Muon, dropout and an average twice: once straight through, and once
killed by SIGKILL so many times, every other time while a checkpoint is half written, and otherwise
a few random updates on. Then every line of the logs and every byte of the weights must be equal.
With several processes all of them are killed. It takes minutes, so that it is not one of the tests.
"""

from __future__ import annotations

import random
import sys
import tempfile
import time
from pathlib import Path

import tyro

from egosim_jax.testing import write_latents
from tests.training.killing import Run
from tests.training.run_tiny import MODEL

MOST, SAVE_EVERY = 6, 3
"""Updates at most before a kill, and between checkpoints."""


class Moment:
    """When a run is to be killed: a few updates further than it ever was."""

    def __init__(self, run: Run, *, saving: bool, draw: random.Random):
        self.run, self.saving = run, saving
        self.step = len(run.lines()) + draw.randint(1, MOST)
        self.later = draw.uniform(0, 0.03)

    def is_there(self) -> bool:
        """Return True some milliseconds after the update or the save began."""
        if len(self.run.lines()) < self.step or (self.saving and not self.run.is_saving()):
            return False
        time.sleep(self.later)
        return True


def main(kills: int = 20, processes: int = 1, seed: int = 0) -> int:
    """Train, kill, compare.

    Args:
        kills: How often the run is killed.
        processes: Processes that share the run.
        seed: Seed of the moments at which it is killed.
    """
    steps, draw = (MOST + SAVE_EVERY) * kills + 10, random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "latents"
        write_latents(data, MODEL)
        straight, killed = (
            Run(data, Path(folder) / name, steps=steps, save_every=SAVE_EVERY, processes=processes)
            for name in ("straight", "killed")
        )
        straight.finish()
        inside = 0
        for kill in range(1, kills + 1):
            moment = Moment(killed, saving=kill % 2 == 0, draw=draw)
            assert killed.kill_when(moment.is_there), killed.output()
            inside += (was_saving := killed.is_saving())
            what = ", while saving" if was_saving else ""
            print(f"kill {kill}/{kills} at step {len(killed.lines())}{what}", file=sys.stderr)
        killed.finish()
        same = killed.lines() == straight.lines()
        weights = [(run.out / "dit.safetensors").read_bytes() for run in (killed, straight)]
    equal = same and weights[0] == weights[1]
    print(
        f"{kills} kills, {inside} of them inside a save, {processes} process(es), {steps} updates: "
        f"losses and weights {'equal, bit for bit' if equal else 'DIFFER'}"
    )
    return 0 if equal else 1


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
