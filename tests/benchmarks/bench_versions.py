"""Commands of two versions of this package in turn: the ratio of their seconds, with its interval.

    python -m tests.benchmarks.bench_versions --before PYTHON --after PYTHON [--pairs 10]
        [--commands simulate generate convert] [--folder FOLDER]

PYTHON is the interpreter of an environment in which that version is installed. Each command runs
once before it is timed, so that its programs are compiled; then the two versions take turns, the
one that goes first alternating. Printed are the median of the ratios after / before and its 95 %
bootstrap interval. `convert` takes a 1.3B video transformer of random bfloat16 values, 3.3 GB, and
writes it to a folder in memory (--target).
"""

from __future__ import annotations

import os
import random
import shutil
import statistics
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

Command = Literal["simulate", "generate", "convert"]
SAMPLES = 10_000
"""Resamples of the bootstrap."""


@dataclass(frozen=True, kw_only=True)
class Versions:
    """Time the commands of two versions in turn."""

    before: Path
    """Interpreter of the older version's environment."""
    after: Path
    """Interpreter of the newer version's environment."""
    pairs: int = 10
    """Timed runs of each version."""
    commands: tuple[Command, ...] = ("simulate", "generate", "convert")
    """Names of the cases to time."""
    folder: Path = Path(tempfile.gettempdir())
    """Folder of inputs and outputs, which are removed again."""
    target: Path = Path("/dev/shm")  # noqa: S108
    """Folder of converted weights."""

    def run(self) -> None:
        """Run the pairs, print ratios."""
        with (
            tempfile.TemporaryDirectory(dir=self.folder) as folder,
            tempfile.TemporaryDirectory(dir=self.target) as target,
        ):
            for command in self.commands:
                if command == "convert":
                    from tests.benchmarks.bench_convert import make_random

                    (Path(folder) / "source").mkdir()
                    make_random(Path(folder) / "source")
                seconds = self._time(command, Path(folder), Path(target))
                _print(command, seconds)

    def _time(self, command: Command, folder: Path, target: Path) -> list[tuple[float, float]]:
        found = []
        for pair in range(-1, self.pairs):
            versions = ["before", "after"][:: 1 if pair % 2 else -1]
            seconds = {name: self._once(command, name, folder, target) for name in versions}
            if pair >= 0:
                found.append((seconds["before"], seconds["after"]))
        return found

    def _once(self, command: Command, version: str, folder: Path, target: Path) -> float:
        out = (target if command == "convert" else folder) / "out"
        programs = {
            "simulate": ["cli", "simulate", "--out"],
            "generate": ["cli", "generate", "--config", "tabletop", "--out"],
            "convert": [
                "convert", "weights", str(folder / "source"), "--config", "egosim_1_3b",
                "--only", "dit", "--out",
            ],
        }  # fmt: skip
        package, *options = programs[command]
        python = self.before if version == "before" else self.after
        cache = os.environ | {"XDG_CACHE_HOME": str(folder / f"cache_{version}")}
        begun = time.perf_counter()
        subprocess.run(
            [python, "-m", f"egosim_jax.{package}", *options, str(out)],
            env=cache, cwd=folder, check=True, capture_output=True,
        )  # fmt: skip
        seconds = time.perf_counter() - begun
        shutil.rmtree(out)
        return seconds


def _print(command: str, seconds: list[tuple[float, float]]) -> None:
    ratios = [after / before for before, after in seconds]
    draw = random.Random(0)
    medians = sorted(statistics.median(draw.choices(ratios, k=len(ratios))) for _ in range(SAMPLES))
    low, high = medians[round(0.025 * SAMPLES)], medians[round(0.975 * SAMPLES)]
    before, after = (statistics.median(pair[i] for pair in seconds) for i in (0, 1))
    print(
        f"{command}: before {before:.2f} s, after {after:.2f} s, ratio "
        f"{statistics.median(ratios):.3f} [{low:.3f}, {high:.3f}], {len(ratios)} pairs",
        flush=True,
    )


if __name__ == "__main__":
    tyro.cli(Versions).run()
