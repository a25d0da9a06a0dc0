"""Runs the cases of a target in processes that may die, and counts what came of them."""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[2]
GOOD = ("refused", "equal", "as reference", "unseen")
"""Outcomes of a case that passes; `unseen`: the format has no way to notice (`Target.lossy`)."""
HANGS = 300
"""Seconds without a word after which a process counts as hung, since a busy machine may be slow.

The worker itself ends a case that takes more than 20 s of processor time.
"""


@dataclass
class Counts:
    """Results of the cases of a target."""

    outcomes: Counter[str] = field(default_factory=Counter)
    kinds: Counter[str] = field(default_factory=Counter)
    failures: list[dict[str, object]] = field(default_factory=list)

    @property
    def cases(self) -> int:
        """Return the number of cases."""
        return sum(self.outcomes.values())

    @property
    def bad(self) -> int:
        """Return the cases that did not pass."""
        return sum(count for outcome, count in self.outcomes.items() if outcome not in GOOD)


def run(name: str, *, seed: int, cases: int, seconds: float | None = None) -> Counts:
    """Fuzz a target; stops after `cases`, or some seconds after the first if they are given."""
    counts, number, kind = Counts(), 0, ""
    until: float | None = None
    while number < cases:
        command = [sys.executable, "-m", "tests.fuzz.worker", name, str(seed), str(number)]
        environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
        with subprocess.Popen(
            [*command, str(cases)], stdout=subprocess.PIPE, cwd=ROOT, env=environment
        ) as process:
            assert process.stdout is not None
            selector = selectors.DefaultSelector()
            selector.register(process.stdout, selectors.EVENT_READ)
            under_way = False
            while True:
                if until is not None and time.monotonic() > until:
                    process.kill()
                    return counts
                if not under_way and not selector.select(HANGS + 60):
                    process.kill()
                    raise RuntimeError(f"{name} does not start")
                if under_way and not selector.select(HANGS):
                    process.kill()
                line = process.stdout.readline()
                if not line:
                    break
                record = json.loads(line)
                if "kind" in record:
                    under_way, number, kind = True, record["case"], record["kind"]
                    continue
                under_way, number = False, record["case"] + 1
                _count(counts, record, kind)
                if until is None and seconds is not None:
                    until = time.monotonic() + seconds
        if under_way:
            _count(counts, {"case": number, "outcome": f"died ({process.returncode})"}, kind)
            number += 1
        elif number < cases:
            raise RuntimeError(f"{name}: the worker ended with {process.returncode}")
    return counts


def _count(counts: Counts, record: dict[str, object], kind: str) -> None:
    outcome = str(record["outcome"])
    counts.outcomes[outcome] += 1
    counts.kinds[kind] += 1
    if outcome not in GOOD:
        counts.failures.append({**record, "kind": kind})
