"""Kill writers at each change that they make, or commands at random times (`kills`, `stops`).

python -m tests.crash [--writer NAME ...] [--most N] [--seed S]
python -m tests.crash kills [--commands NAME ...] [--kills N] [--seed S]
python -m tests.crash stops [--commands NAME ...] [--stops N] [--seed S]
"""

import argparse
import os
import sys
from pathlib import Path
from tempfile import gettempdir

for library in ("OPENBLAS", "OMP"):  # a fork has none of its parent's threads
    os.environ[f"{library}_NUM_THREADS"] = "1"


def points(given: argparse.Namespace) -> int:
    """Kill writers at every change; the exit code."""
    from tests.crash.oracle import check
    from tests.crash.writers import WRITERS

    unknown = {*given.writer} - WRITERS.keys()
    assert not unknown, f"unknown: {unknown}; known: {', '.join(WRITERS)}"
    reports = []
    for name in given.writer or WRITERS:
        reports.append(check(name, given.folder, seed=given.seed, most=given.most))
        print("\n  ".join([str(reports[-1]), *reports[-1].failures]), flush=True)
    print(f"{sum(report.points for report in reports)} points in all")
    return int(any(report.failures for report in reports))


def kills(given: argparse.Namespace) -> int:
    """Kill commands at random times; the exit code."""
    from tests.crash import kills

    names = given.commands or [*kills.COMMANDS]
    return kills.main(names, given.folder, kills=given.kills, seed=given.seed)


def stops(given: argparse.Namespace) -> int:
    """Send trainings SIGTERM at random times; the exit code."""
    from tests.crash import stops

    names = given.commands or [*stops.COMMANDS]
    return stops.main(names, given.folder, stops=given.stops, seed=given.seed)


def main() -> int:
    """Parse the command line and run."""
    parser = argparse.ArgumentParser(prog="python -m tests.crash", description=__doc__)
    parser.add_argument("what", nargs="?", choices=["points", "kills", "stops"], default="points")
    parser.add_argument("--writer", nargs="+", default=[], help="all, if none is named")
    parser.add_argument("--most", type=int, help="points of a writer; all, if not given")
    parser.add_argument("--commands", nargs="+", help="all, if none is named")
    parser.add_argument("--kills", type=int, default=100, help="of all commands together")
    parser.add_argument("--stops", type=int, default=20, help="of each training")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path(gettempdir()) / "egosim_crash")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    return {"points": points, "kills": kills, "stops": stops}[given.what](given)


if __name__ == "__main__":
    sys.exit(main())
