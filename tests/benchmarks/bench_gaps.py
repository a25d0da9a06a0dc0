"""PSNR of the tabletop world's priors with and without gaps, in observed places away from hands.

    python -m tests.benchmarks.bench_gaps [--seeds 12] [--first-seed 700] [--sheet FILE]

The state of the first clip is carried on in two ways: its objects move by their ground-truth motion
and no points are added, as in training; or each clip is fused by the oracle, as in simulation. Each
clip's prior is compared with its ground truth where the closed view of 1-pixel points sees a point
and no hand is within four pixels. PSNR is the mean over frames 1 to n-1, then over sequences.
The share of pixels that are gaps is printed next to it. The sheet shows the later clips of the
first sequence: 1-pixel points with gaps, without, 2-pixel points, ground truth.

Times are processor time in milliseconds for the 17 frames of a clip; the programs take turns.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import Annotated

import cv2
import numpy as np
import tyro

from egosim_jax import configs
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.perception import registry
from egosim_jax.rendering import jitted, reference
from egosim_jax.state.fuse import fuse
from egosim_jax.types import Cameras, Clip, SceneState
from egosim_jax.worlds.tabletop import (
    TabletopClip,
    make_sequence,
    state_after,
    to_action,
    to_ground_truth,
)
from egosim_jax.worlds.tabletop.scene import FIRST_HAND
from tests.benchmarks.bench_prior import masked_psnr

CLIPS = 3
VIDEO = configs.get("tabletop").video
NEAR_HAND = np.ones((9, 9), np.uint8)
ROUNDS = 9


def main(
    seeds: int = 12,
    first_seed: int = 700,
    sheet: Annotated[Path | None, tyro.conf.arg(help="File for the views.")] = None,
) -> None:
    """Measure priors and time their rendering.

    Args:
        seeds: Number of sequences.
        first_seed: Seed of the first sequence.
    """
    rows: dict[tuple[str, int], list[tuple[float, ...]]] = {}
    shown: list[SheetClip] = []
    for seed in range(first_seed, first_seed + seeds):
        for clip, states in carry_on(seed):
            for name, state in states.items():
                views = draw(state, clip.cameras)
                rows.setdefault((name, clip.number + 1), []).append(score(views, clip))
                if seed == first_seed and clip.number:
                    videos = [views["gaps"], views["closed"], views["2 pixels"], clip.frames]
                    shown.append(SheetClip(f"clip {clip.number + 1}, {name}", videos))
    print("state, clip: gaps %, PSNR dB with gaps, closed, of 2-pixel points, lowest gain")
    for (name, number), scores in rows.items():
        share, gaps, closed, large = np.mean(scores, axis=0)
        lowest = min(after - before for _, before, after, _ in scores)
        print(
            f"{name:8s} {number}: {share:.2f} {gaps:.2f} {closed:.2f} {large:.2f} {lowest:+.2f}",
            flush=True,
        )
    if sheet is not None:
        draw_sheet(shown, sheet, moments=(0, 8, 16), width=480)
    *_, (clip, states) = carry_on(first_seed)
    measure_time(states["fused"], clip.cameras)


def carry_on(seed: int) -> Iterator[tuple[TabletopClip, dict[str, SceneState]]]:
    """Yield each clip of a sequence with the states that the clips before lead to."""
    clips = list(make_sequence(seed, spec=VIDEO, clips=CLIPS))
    truths = {clip.number: to_ground_truth(clip) for clip in clips}
    perceive = registry.parse("oracle").build(truths)
    moved = fused = clips[0].state
    for clip in clips:
        yield clip, {"moved": moved, "fused": fused}
        moved = state_after(clip, moved)
        found = perceive(Clip(frames=clip.frames, fps=VIDEO.fps), to_action(clip), fused)
        fused = fuse(fused, found)


def draw(state: SceneState, cameras: Cameras) -> dict[str, np.ndarray]:
    """Return the views and where the closed one sees a point."""
    _, index = jitted.splat(state.points_m, cameras, point_px=1)
    closed = jitted.render(state, cameras, point_px=1)
    return {
        "gaps": np.asarray(jitted.paint(index, state.colors, gamma=False)),
        "closed": closed.frames,
        "2 pixels": jitted.render(state, cameras, point_px=2).frames,
        "observed": np.isfinite(closed.depth_m),
        "gap": np.isfinite(closed.depth_m) & (np.asarray(index) < 0),
    }


def score(views: dict[str, np.ndarray], clip: TabletopClip) -> tuple[float, ...]:
    """Return the share of gaps in percent, and the PSNR of the three views."""
    hands = np.stack([cv2.dilate(h.astype(np.uint8), NEAR_HAND) for h in clip.ids >= FIRST_HAND])
    compared = views["observed"] & (hands == 0)
    names = ("gaps", "closed", "2 pixels")
    found = [masked_psnr(clip.frames, views[name], compared) for name in names]
    return (100 * float(views["gap"].mean()), *found)


def measure_time(state: SceneState, cameras: Cameras) -> None:
    """Print the time of a view with gaps and without, in both renderers."""
    for renderer in (reference, jitted):
        programs = {
            "points alone": lambda r=renderer: np.asarray(
                r.splat(state.points_m, cameras, point_px=1)[1]
            ),
            "closed": lambda r=renderer: np.asarray(
                r.close_gaps(*r.splat(state.points_m, reference.add_margin(cameras), point_px=1))[1]
            ),
        }
        times: dict[str, list[float]] = {name: [] for name in programs}
        for _ in range(ROUNDS + 1):  # the first compiles
            for name, program in programs.items():
                start = time.process_time()
                program()
                times[name].append(1000 * (time.process_time() - start))
        name = renderer.__name__.rpartition(".")[-1]
        figures = ", ".join(f"{key} {median(took[1:]):.1f}" for key, took in times.items())
        print(f"{name}, {len(state.points_m)} points: {figures} ms")


if __name__ == "__main__":
    tyro.cli(main)
