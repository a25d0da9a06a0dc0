"""Agreement of executed scripts with the scripts, and time of a frame without its picture.

python -m tests.benchmarks.bench_world --scenes 100
"""

from __future__ import annotations

import time

import numpy as np
import tyro

from tests.unit.worlds.test_world import differences

QUANTILES = (0.5, 0.9, 0.95)


def main(scenes: int = 100) -> None:
    """Execute the first script of scenes, of human hands and of the robot.

    Args:
        scenes: Number of scenes of each, from seed 0.
    """
    begin = time.process_time()
    found = np.concatenate([differences(range(scenes), kind) for kind in ("human", "robot")])
    seconds = time.process_time() - begin
    largest, last, others = found.T
    as_scripted = (largest < 0.015) & (last < 0.01) & (others < 1e-3)
    print(f"as scripted: {as_scripted.sum()} of {len(found)}")
    for name, values in (("largest", largest), ("last", last)):
        print(f"{name} distance, mm, quantiles {QUANTILES}:", 1000 * np.quantile(values, QUANTILES))
    print(f"seconds a clip, scene included: {seconds / len(found):.2f} of one core")
    for number in np.flatnonzero(~as_scripted):
        kind = "human" if number < scenes else "robot"
        print(f"{kind} {number % scenes}:", 1000 * found[number], "mm (largest, last, others)")


if __name__ == "__main__":
    tyro.cli(main)
