"""Seconds of `egosim simulate` to its first line, its first clip and its end, cold and warm.

    python -m tests.benchmarks.bench_start [--pairs 3] [--against CHECKOUT]

The first start has an empty cache and compiles; the second finds its programs. Both simulate three
clips of the tabletop world. `--against` runs another checkout in turn, with a separate cache.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parents[2]
MAIN = "import sys; from egosim_jax.cli.__main__ import main; sys.exit(main())"
COLUMNS = ("first line", "first clip", "end")


def start(checkout: Path, cache: Path, out: Path) -> tuple[float, float, float]:
    """Seconds of one run of a checkout until each of `COLUMNS`."""
    environment = {
        **os.environ,
        "PYTHONPATH": str(checkout),
        "PYTHONUNBUFFERED": "1",
        "XDG_CACHE_HOME": str(cache),
    }
    begun, seconds = time.perf_counter(), []
    with subprocess.Popen(
        [sys.executable, "-P", "-c", MAIN, "simulate", "--out", str(out)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as program:
        assert program.stdout is not None
        for line in program.stdout:
            now = time.perf_counter() - begun
            if not seconds:
                seconds.append(now)
            if len(seconds) == 1 and ("clip_1.mp4" in line or "clip 1/" in line):
                seconds.append(now)
    assert program.returncode == 0, f"simulate of {checkout} failed"
    first, clip = seconds
    return first, clip, time.perf_counter() - begun


def main() -> None:
    """Print each run and the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=3)
    parser.add_argument("--against", type=Path, help="Another checkout of this package.")
    given = parser.parse_args()
    checkouts = [HERE, *([given.against.resolve()] if given.against else [])]
    runs: dict[tuple[str, str], list[tuple[float, float, float]]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for number in range(given.pairs):
            for index, checkout in enumerate(checkouts):
                cache = Path(folder) / f"cache_{number}_{index}"
                for kind in ("cold", "warm"):
                    out = Path(folder) / f"{kind}_{number}_{index}"
                    run = start(checkout, cache, out)
                    runs.setdefault((checkout.name, kind), []).append(run)
                    print(checkout.name, kind, *(f"{seconds:.2f}" for seconds in run), flush=True)
    print(f"medians of {given.pairs}, in seconds: {', '.join(COLUMNS)}")
    for (name, kind), measured in runs.items():
        medians = (statistics.median(column) for column in zip(*measured, strict=True))
        print(f"{name}, {kind}: {', '.join(f'{median:.2f}' for median in medians)}")


if __name__ == "__main__":
    main()
