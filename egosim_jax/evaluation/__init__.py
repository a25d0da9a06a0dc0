"""Evaluation of generated clips: scores against the ground truth by method, and their tables.

Every {id}.mp4 in one or several folders is compared with the recorded video of its metadata row,
over the same frames and at one size. Baselines are compared, too: the prior, the prior with a
least-squares color fit, and the first frame of the ground truth repeated. Frame 0 is excluded
unless the protocol says otherwise, because it is given. Experiments (`experiments`) do not belong
here.

    evaluate     compare a folder of clips with their ground truth
    methods      rows of a table: folders of clips, and baselines
    measures     columns of a table: pixels, LPIPS, DreamSim
    estimated    columns that need estimates: regions, depth, cameras, hands
    fvd          Fréchet video distance
    scoring      Protocol, Scoring: score methods on clips
    registration, crops, cache   crops that images show; scores by content
    result       Evaluation: summaries, paired differences, report
    tables       the papers' tables
    files        report.json, metrics.jsonl, scores.csv, table.tex, scores.png
    pages        index.html
    metrics      the formulas, on arrays
"""

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

__all__ = ["Evaluation", "Protocol", "Scoring", "evaluate"]


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
