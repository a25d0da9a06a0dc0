"""Ranking of candidate actions by how well their generated videos reach a goal.

Each candidate is generated with several seeds. Its score is the mean over them: the negative LPIPS
of the last frame to a goal image, or the X-CLIP similarity of the video to a text. The highest
score is best. (Kim et al. 2026, Dexterous World Models, action evaluation.)
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
MAX_STRETCH = 0.02
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
    """Rank of the candidate; 1 is the best."""

    @property
    def score(self) -> float:
        """Mean score over the seeds."""
        return float(np.mean(self.scores))


def by_image(goal: UInt8[np.ndarray, "h w 3"], size: tuple[int, int]) -> Score:
    """Return a score: the negative LPIPS (AlexNet) of a video's last frame to a goal image.

    The image is resized to `size`, height and width of the videos. Raises `InputError` if that
    would stretch it, or if LPIPS is not installed.
    """
    (rows, columns), (height, width) = goal.shape[:2], size
    if abs(columns * height / (rows * width) - 1) > MAX_STRETCH:
        raise InputError(
            f"The goal image has {columns}x{rows} pixels and would be stretched to the "
            f"{width}x{height} of the clips: crop it to their aspect ratio. (--goal-image)"
        )
    network, image = Lpips.load("alex"), resize_image(goal, height, width)[None]

    def score(video: UInt8[np.ndarray, "f h w 3"]) -> float:
        return -float(frame_distances(network, video[-1:], image)[0])

    return score


def by_text(goal: str, folder: Path | None) -> Score:
    """Return a score: the similarity of a video to a text, by the X-CLIP model in a folder."""
    if folder is None:
        raise InputError(
            f"Comparing videos with the text {goal!r} needs the folder of an X-CLIP model: "
            "download microsoft/xclip-base-patch32 and name its folder, or give a goal image "
            "(--goal-image). (--xclip)"
        )
    network = XClip(folder)
    network.check_installed()
    return lambda video: network(video, goal)


def order(scores: Mapping[str, Sequence[float]]) -> list[Ranked]:
    """Return the candidates, best first, from their scores by name.

    Equal means share a rank. Candidates whose mean is NaN are last.
    """
    means = {name: float(np.mean(values)) for name, values in scores.items()}
    keys = {name: np.inf if np.isnan(mean) else -mean for name, mean in means.items()}
    best = sorted(keys, key=lambda name: (keys[name], np.isnan(means[name])))
    return [
        Ranked(
            name=name,
            scores=tuple(scores[name]),
            rank=1 + sum(key < keys[name] for key in keys.values()),
        )
        for name in best
    ]


def rank(jobs: Sequence[BatchJob], windows: Sequence[Window], score: Score) -> list[Ranked]:
    """Generate every candidate with each job, one per seed, and rank the candidates.

    Finished clips are skipped, and the weights are loaded once, by the first job. Raises
    `InputError` if a candidate is invalid, has no clip, or has a clip of other conditions.
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
        for name, of_candidate in scores.items():
            path = job.out / f"{name}.mp4"
            if not path.exists():
                raise InputError(
                    f"The candidate {name} has no clip in {job.out}; its results.jsonl says why. "
                    "All candidates must be generated to be ranked. (--actions)"
                )
            of_candidate.append(score(read_video(path).frames))
    return order(scores)


def report(ranked: Sequence[Ranked], out: Path, *, goal: str, measure: str) -> None:
    """Write ranking.json and print the ranking."""
    rows = [{"name": r.name, "rank": r.rank, "score": r.score, "scores": r.scores} for r in ranked]
    best = None if np.isnan(ranked[0].score) else ranked[0].name
    content = {"goal": goal, "measure": measure, "best": best, "candidates": rows}
    write_json(out / "ranking.json", content)
    table = {}
    for one in ranked:
        mean, spread = mean_and_spread(one.scores)
        place = {"mean": float(one.rank)}
        table[one.name] = {"score": {"mean": mean, "spread": spread}, "rank": place}
    print_table("candidate", table, MEASURES, title=f"{measure}: {goal}")
