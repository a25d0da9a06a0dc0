"""Comparison of folders of generated clips, and of baselines, with their ground truth."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from egosim_jax.data.clip_files import ClipFiles
from egosim_jax.evaluation.cache import CACHE, ScoreCache
from egosim_jax.evaluation.files import write_files
from egosim_jax.evaluation.measures import Measure, standard
from egosim_jax.evaluation.methods import BASELINES, Folder, Method, autoencoded
from egosim_jax.evaluation.result import Evaluation
from egosim_jax.evaluation.scoring import Protocol, Scoring


def evaluate(generated: Path, clips: Sequence[ClipFiles]) -> Evaluation:
    """Compare the clips in a folder, and the baselines, with their ground truth.

    {id}_vae.mp4 (the ground truth through the autoencoder) is compared, too, if it exists. Clips
    that cannot be compared are skipped. Raises `InputError` if no clip can be compared.
    """
    folder = Folder(path=generated, name="generated", title="generated")
    methods = [folder, *BASELINES.values(), autoencoded(generated)]
    return compare(methods, clips, standard(), protocol=Protocol(), out=generated)


def compare(
    methods: Sequence[Method],
    clips: Sequence[ClipFiles],
    measures: Sequence[Measure],
    *,
    protocol: Protocol,
    out: Path,
    **result: Any,
) -> Evaluation:
    """Compare methods with the ground truth, and write the files of `write_files` to a folder.

    `result` has fields of the `Evaluation`. Raises `InputError` if no clip can be compared.
    """
    cache = ScoreCache(out / CACHE)
    scoring = Scoring(methods=methods, measures=measures, protocol=protocol, cache=cache)
    evaluation = Evaluation.of(scoring, scoring.run(clips), **result)
    write_files(evaluation, out)
    return evaluation
