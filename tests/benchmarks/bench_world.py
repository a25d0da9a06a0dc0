"""Agreement of executed scripts with the scripts, and time of a frame without its image.

python -m tests.benchmarks.bench_world --scenes 100
"""

from __future__ import annotations

import time

import numpy as np
import tyro

from tests.unit.worlds.test_world import differences

QUANTILES = (0.5, 0.9, 0.95)


def main(scenes: int = 100, first_seed: int = 700) -> None:
    """Execute the first script of scenes, of human hands and of the robot.

    Args:
        scenes: Number of scenes of each.
        first_seed: Seed of the first scene; those from 700 on were not looked at before.
    """
    begin, seeds = time.process_time(), range(first_seed, first_seed + scenes)
    found = np.concatenate([differences(seeds, kind) for kind in ("human", "robot")])
    seconds = time.process_time() - begin
    largest, last, others = found.T
    as_scripted = (largest < 0.015) & (last < 0.01) & (others < 1e-3)
    print(f"as scripted: {as_scripted.sum()} of {len(found)}")
    for name, values in (("largest", largest), ("last", last)):
        print(f"{name} distance, mm, quantiles {QUANTILES}:", 1000 * np.quantile(values, QUANTILES))
    print(f"seconds a clip, scene included: {seconds / len(found):.2f} of one core")
    for number in np.flatnonzero(~as_scripted):
        kind = "human" if number < scenes else "robot"
        seed = seeds[number % scenes]
        print(f"{kind} {seed}:", 1000 * found[number], "mm (largest, last, others)")


if __name__ == "__main__":
    tyro.cli(main)
