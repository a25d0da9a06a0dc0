"""Seconds from the command to the first clip of `tabletop`, the first time and the second.

    python -m tests.benchmarks.bench_start [--pairs 3]

The first start has an empty cache and compiles; the second finds its programs. Both make the same
scene, draw it, read weights, generate and write the clip, which is what the seconds end with.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def start(cache: Path, out: Path) -> tuple[float, int]:
    """Seconds until the first clip is named, and how many programs were compiled."""
    command = [sys.executable, "-m", "egosim_jax.cli", "generate", "--config", "tabletop"]
    env = {**os.environ, "XDG_CACHE_HOME": str(cache), "JAX_LOG_COMPILES": "1"}
    errors = out.with_suffix(".log")
    begun = time.perf_counter()
    with errors.open("w") as log:
        program = subprocess.Popen(
            [*command, "--out", str(out)], env=env, stdout=subprocess.PIPE, stderr=log, text=True
        )
        assert program.stdout is not None
        clip = next(line for line in program.stdout if line.strip().endswith(".mp4"))
        seconds = time.perf_counter() - begun
        program.stdout.read()
        program.wait()
    assert Path(clip.strip()).exists()
    return seconds, errors.read_text("utf-8").count("Finished XLA compilation")


def main() -> None:
    """Print each pair and the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=3)
    pairs = []
    for number in range(parser.parse_args().pairs):
        with tempfile.TemporaryDirectory() as folder:
            cache = Path(folder) / "cache"
            pair = [start(cache, Path(folder) / name) for name in ("cold", "warm")]
        pairs.append(pair)
        (cold, made), (warm, again) = pair
        print(
            f"pair {number + 1}: cold {cold:.1f} s, {made} programs compiled; warm {warm:.1f} s, "
            f"{again} compiled",
            flush=True,
        )
    cold, warm = (statistics.median(pair[i][0] for pair in pairs) for i in (0, 1))
    print(f"median: cold {cold:.1f} s, warm {warm:.1f} s, ratio {warm / cold:.2f}")


if __name__ == "__main__":
    main()
