"""`python -m tests.fuzz`: damage every kind of file that we read, and count what comes of it.

    python -m tests.fuzz --cases 1500
    python -m tests.fuzz --targets mp4 png --cases 300 --seed 7

A table on stdout, failures in full on stderr; exit code 1 if there are any.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass

import tyro

from tests.fuzz.runner import GOOD, run
from tests.fuzz.worker import targets


@dataclass(frozen=True, kw_only=True)
class Fuzz:
    """Damage every kind of file that we read, and count what comes of it."""

    targets: tuple[str, ...] = ()
    """Names of formats; all if none is given."""
    cases: int = 1500
    """Number of changed files of each format."""
    seed: int = 0
    """Seed of the changes."""
    seconds: float | None = None
    """Stop each format after so many."""

    def run(self) -> int:
        """Run all and print the table."""
        columns = (*GOOD, "other")
        print(f"{'format':<24}{'cases':>8}{'kinds':>7}" + "".join(f"{c:>14}" for c in columns))
        total = bad = 0
        for name in self.targets or [target.name for target in targets()]:
            counts = run(name, seed=self.seed, cases=self.cases, seconds=self.seconds)
            shown = [counts.outcomes[outcome] for outcome in GOOD] + [counts.bad]
            row = "".join(f"{count:>14,}" for count in shown)
            print(f"{name:<24}{counts.cases:>8,}{len(counts.kinds):>7}{row}", flush=True)
            for failure in counts.failures:
                print(name, json.dumps(failure), file=sys.stderr)
            total, bad = total + counts.cases, bad + counts.bad
        print(f"{total:,} cases, {bad} failures")
        return int(bad > 0)


if __name__ == "__main__":
    sys.exit(tyro.cli(Fuzz).run())
