"""Comparison of a folder of generated clips, and of baselines, with their ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from egosim_jax.data.clip_files import ClipFiles
from egosim_jax.evaluation.cache import CACHE, ScoreCache
from egosim_jax.evaluation.files import write_files
from egosim_jax.evaluation.measures import standard
from egosim_jax.evaluation.methods import BASELINES, Folder, autoencoded
from egosim_jax.evaluation.result import Evaluation
from egosim_jax.evaluation.scoring import Protocol, Scoring


def evaluate(
    generated: Path,
    clips: Sequence[ClipFiles],
    *,
    size: Literal["output", "target"] = "output",
    out: Path | None = None,
) -> Evaluation:
    """Compare the clips in a folder, and the baselines, with their ground truth.

    {id}_vae.mp4 (the ground truth through the autoencoder) is compared, too, if it exists. Writes
    the files of `write_files` to `out`, by default the folder of the clips. Clips that cannot be
    compared are skipped. Raises `InputError` if no clip can be compared.
    """
    out = out or generated
    methods = [
        Folder(path=generated, name="generated", title="generated"),
        *BASELINES.values(),
        autoencoded(generated),
    ]
    scoring = Scoring(
        methods=methods,
        measures=standard(),
        protocol=Protocol(size=size),
        cache=ScoreCache(out / CACHE),
    )
    evaluation = Evaluation.of(scoring, scoring.run(clips))
    write_files(evaluation, out)
    return evaluation
