"""Worst clips of an experiment: which they are, and what each lacks.

A clip lacks the goals (`GOALS`) that its measures miss. Each comes with what the ground truth
reaches through the autoencoder: where that misses the goal too, no denoiser could reach it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

GOALS: Mapping[str, tuple[float, str]] = {
    "object_lost": (1.0, "object lost in {:.0f} % ({:.0f} %)"),
    "object_error": (5.0, "object {:.0f} % off ({:.0f} %)"),
    "hand_iou": (-0.70, "hand IoU {:.2f} ({:.2f})"),
    "region_psnr": (-21.5, "region {:.1f} dB ({:.1f})"),
    "lpips_alex": (0.17, "LPIPS {:.2f} ({:.2f})"),
}
"""Most of each measure that a clip may have, and the text where it has more.

A negative number is the least. The text has the clip's value and, in parentheses, that of the
ground truth through the autoencoder."""


def lacks(scores: Mapping[str, float], ceiling: Mapping[str, float]) -> list[str]:
    """Return a text for each goal that a clip misses; a measure that is NaN or absent is none."""
    return [
        text.format(scores[name], ceiling[name])
        for name, (goal, text) in GOALS.items()
        if name in scores and scores[name] * np.sign(goal) > goal
    ]


def worst(
    scores: Sequence[Mapping[str, float]], ceilings: Sequence[Mapping[str, float]], count: int
) -> dict[int, list[str]]:
    """Return what the worst clips lack, by their places: first those that miss most goals.

    Among equals, the one whose region of hands and object is worst comes first.
    """
    missed = [lacks(*pair) for pair in zip(scores, ceilings, strict=True)]
    order = sorted(range(len(scores)), key=lambda n: (-len(missed[n]), scores[n]["region_psnr"]))
    return {n: missed[n] for n in order[:count]}
