"""`egosim evaluate`: score generated clips against the recorded ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from egosim_jax.cli.comparison import Options
from egosim_jax.runtime.command import ExitCode


@dataclass(frozen=True, kw_only=True)
class Evaluate(Options):
    """Compare generated clips with the recorded ones by PSNR, SSIM, LPIPS and other measures.

    Every {id}.mp4 is compared with the ground truth of its metadata row, over the same frames and
    at one size. The baselines are compared, too, and {id}_vae.mp4 (the ground truth through the
    autoencoder) if there is one. Frame 0 is excluded, because it is given. A clip whose length
    differs from most clips is skipped (exit code 3). Prints a table for each split with spreads and
    paired differences. Writes report.json (with the protocol), metrics.jsonl, scores.csv,
    table.tex, scores.png and index.html. Scores are cached by content: a repeated command computes
    only new ones.
    """

    size: Literal["output", "target"] = "output"
    """Image size of the comparison: output, the first folder's clips; target, the recorded video.

    Small outputs score too well at their own size: choose target if methods differ in size."""
    out: Path | None = None
    """Folder of the report; by default the first folder of clips."""

    def run(self) -> int:
        """Compare all clips, then summarize."""
        from egosim_jax.evaluation.methods import Folder, autoencoded
        from egosim_jax.evaluation.result import SHOWN
        from egosim_jax.evaluation.scoring import Protocol

        folders = Folder.parse_all(self.generated)
        first = folders[0]
        if len(folders) == 1 and "=" not in self.generated[0]:
            folders = [replace(first, name="generated", title="generated")]
        evaluation = self.compare(
            [*folders, autoencoded(first.path)],
            self.read_clips(),
            protocol=Protocol(size=self.size),
            out=self.out or first.path,
            title="Evaluation",
            networks=self.lpips,
            shown=SHOWN,
        )
        return ExitCode.PARTIAL if evaluation.skipped else ExitCode.DONE
