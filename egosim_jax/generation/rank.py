"""Ranking of candidate actions by the goal that their generated videos reach.

Each candidate is generated with several seeds. Its score is a mean over them: the negative LPIPS of
the last frame to an image of the goal, or the similarity of the video to a text, by X-CLIP. The
best candidate has the highest score. (Kim et al. 2026, Dexterous World Models, action evaluation.)
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from egosim_jax.data.transforms import resize_image
from egosim_jax.data.windows import Window
from egosim_jax.evaluation.metrics.lpips import Lpips, frame_distances
from egosim_jax.evaluation.metrics.report import mean_and_spread, print_table
from egosim_jax.generation.batch import BatchJob
from egosim_jax.io.bounded import listing
from egosim_jax.io.run import write_json
from egosim_jax.io.video import read_video
from egosim_jax.perception.networks.xclip import XClip
from egosim_jax.types import InputError

Score = Callable[[UInt8[np.ndarray, "f h w 3"]], float]
"""Function that scores a video; higher is better."""
STRETCH = 0.02
"""Maximum relative difference between the aspect ratios of a goal image and the clips."""
MEASURES = {"score": ("score", "{:.4f}"), "rank": ("rank", "{:.0f}")}


@dataclass(frozen=True, kw_only=True)
class Ranked:
    """A candidate and its scores."""

    name: str
    """Id of the candidate's clip."""
    scores: tuple[float, ...]
    """Score of each seed's video; higher is better."""
    rank: int
    """Place of the candidate, from 1."""

    @property
    def score(self) -> float:
        """Mean score over the seeds."""
        return float(np.mean(self.scores))


def by_image(goal: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> Score:
    """Return the score of a video whose last frame shall look like an image (LPIPS of AlexNet).

    The image is resized to `size`, rows and columns of the videos. Raises `InputError` if it has
    another shape than they, so that resizing would stretch it, or LPIPS is not installed.
    """
    (rows, columns), (height, width) = goal.shape[:2], size
    if abs(columns * height / (rows * width) - 1) > STRETCH:
        raise InputError(
            f"The image of the goal has {columns}x{rows} pixels and would be stretched to the "
            f"{width}x{height} of the clips: crop it to their shape. (--goal-image)"
        )
    network, image = Lpips.load("alex"), resize_image(goal, height, width)[None]

    def score(video: UInt8[np.ndarray, "f h w 3"]) -> float:
        return -float(frame_distances(network, video[-1:], image)[0])

    return score


def by_text(goal: str, folder: Path | None) -> Score:
    """Return the score of a video that a text shall describe, by the X-CLIP model of a folder."""
    if folder is None:
        raise InputError(
            f"Videos cannot be compared with the text {goal!r} without a network: that takes a "
            "folder of an X-CLIP model. Download microsoft/xclip-base-patch32 and name its folder, "
            "or give an image of the goal (--goal-image). (--xclip)"
        )
    network = XClip(folder)
    network.check_installed()
    return lambda video: network(video, goal)


def order(scores: Mapping[str, Sequence[float]]) -> list[Ranked]:
    """Return the candidates, best first, from their scores by name."""
    means = {name: float(np.mean(values)) for name, values in scores.items()}
    best = sorted(means, key=lambda name: -means[name])
    return [
        Ranked(name=name, scores=tuple(scores[name]), rank=place)
        for place, name in enumerate(best, start=1)
    ]


def rank(jobs: Sequence[BatchJob], windows: Sequence[Window], score: Score) -> list[Ranked]:
    """Generate every candidate by each job, which differ in their seed, and rank them.

    Finished clips are not generated again, and the weights of the first job are loaded once. Raises
    `InputError` if a candidate is invalid, has no clip, or one of other conditions.
    """
    _, rejected = jobs[0].check(windows)
    if rejected:
        reasons = listing([f"{window.output_id}: {problem}" for window, problem in rejected])
        raise InputError(f"All candidates must be valid to be ranked. {reasons} (--actions)")
    load = functools.cache(jobs[0].load)
    scores: dict[str, list[float]] = {window.output_id: [] for window in windows}
    for job in jobs:
        job.open()
        job.generate(windows, load=load)
        for name, found in scores.items():
            path = job.out / f"{name}.mp4"
            if not path.exists():
                raise InputError(
                    f"The candidate {name} has no clip in {job.out}, whose results.jsonl says why: "
                    "all candidates must be generated to be ranked. (--actions)"
                )
            found.append(score(read_video(path).frames))
    return order(scores)


def report(ranked: Sequence[Ranked], out: Path, *, goal: str, measure: str) -> None:
    """Write ranking.json and print the ranking."""
    rows = [{"name": r.name, "rank": r.rank, "score": r.score, "scores": r.scores} for r in ranked]
    content = {"goal": goal, "measure": measure, "best": ranked[0].name, "candidates": rows}
    write_json(out / "ranking.json", content)
    table = {}
    for one in ranked:
        mean, spread = mean_and_spread(one.scores)
        place = {"mean": float(one.rank)}
        table[one.name] = {"score": {"mean": mean, "spread": spread}, "rank": place}
    print_table("candidate", table, MEASURES, title=f"{measure}: {goal}")
