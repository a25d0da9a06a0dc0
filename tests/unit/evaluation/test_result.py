"""Notes of an evaluation."""

from pathlib import Path

import pytest

from egosim_jax.data.clip_files import ClipFiles
from egosim_jax.data.windows import Window
from egosim_jax.evaluation.measures import Column
from egosim_jax.evaluation.methods import Shape
from egosim_jax.evaluation.result import Evaluation
from egosim_jax.evaluation.scoring import Protocol, Row


def evaluation(clips: int, methods: tuple[str, ...]) -> Evaluation:
    """Scores of methods on clips, from nothing."""
    rows = []
    for number in range(clips):
        files = ClipFiles(
            video_id=f"clip_{number}",
            prompt="A hand.",
            prior=Path("prior.mp4"),
            mask=None,
            hands=Path("hands.mp4"),
            first_frame=Path("first.png"),
            target=Path("video.mp4"),
            extra={},
            row="metadata.csv:2",
        )
        window = Window(files=files, start=0, output_id=files.video_id)
        rows += [
            Row(
                window=window,
                method=name,
                shape=Shape(17, 96, 160),
                source="160x96, 17 frames",
                scores={"psnr": 20.0 + number + place},
            )
            for place, name in enumerate(methods)
        ]
    return Evaluation(
        rows=rows,
        titles={name: name for name in methods},
        columns={"psnr": Column("PSNR dB", "{:.2f}", "higher")},
        shown=("psnr",),
        definitions={},
        protocol=Protocol(),
    )


@pytest.mark.parametrize(
    ("clips", "methods", "said"),
    [
        (2, ("a", "b"), "2 clips"),
        (4, ("a", "b"), "4 clips"),
        (5, ("a", "b"), None),
        (2, ("a",), None),
    ],
)
def test_intervals_of_few_clips_are_named(clips, methods, said):
    lines = [line for line in evaluation(clips, methods).notes() if "are few" in line]
    assert len(lines) == (said is not None)
    assert said is None or said in lines[0]
