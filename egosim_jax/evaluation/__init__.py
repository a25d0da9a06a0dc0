"""Evaluation of generated clips: scores against the ground truth by method, and their tables.

Every {id}.mp4 of one or several folders is compared with the recorded video of its metadata row
over the same frames, all at one size; so are baselines: the prior, the prior with a least-squares
color fit, and the first frame of the ground truth repeated. Frame 0 is excluded unless the protocol
says otherwise, because there the repeated frame is the ground truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from egosim_jax.data.clip_files import ClipFiles
from egosim_jax.evaluation.files import write_files
from egosim_jax.evaluation.measures import standard
from egosim_jax.evaluation.methods import BASELINES, Folder
from egosim_jax.evaluation.result import Evaluation
from egosim_jax.evaluation.scoring import CACHE, Protocol, ScoreCache, Scoring

__all__ = ["Evaluation", "Protocol", "Scoring", "evaluate"]


def evaluate(
    generated: Path,
    clips: Sequence[ClipFiles],
    *,
    size: Literal["output", "target"] = "output",
    out: Path | None = None,
) -> Evaluation:
    """Compare the clips of a folder with their ground truth, along with the baselines.

    The folder's {id}_vae.mp4, the ground truth through the autoencoder, are compared where they
    exist. Writes the files of `write_files` to `out`, by default the folder of the clips. A clip
    that cannot be compared is skipped. Raises `InputError` if all are.
    """
    out = out or generated
    methods = [
        Folder(path=generated, name="generated", title="generated"),
        *BASELINES.values(),
        Folder(
            path=generated,
            name="vae",
            title="ground truth through the autoencoder",
            suffix="_vae",
            optional=True,
        ),
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
