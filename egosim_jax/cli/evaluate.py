"""`egosim evaluate`: scores of generated clips against the recorded ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from egosim_jax.cli.comparison import Options
from egosim_jax.runtime.command import ExitCode


@dataclass(frozen=True, kw_only=True)
class Evaluate(Options):
    """Compare generated clips with the recorded ones by PSNR, SSIM, LPIPS and other measures.

    Every {id}.mp4 is compared with the ground truth of its metadata row over the same frames, all
    at one size; so are the baselines and, if there is an {id}_vae.mp4, the ground truth through the
    autoencoder. Frame 0 is excluded, because there the repeated frame is the ground truth. A clip
    of another length than most is skipped (exit code 3). Prints a table for each split with spreads
    and paired differences; writes report.json (with the protocol), metrics.jsonl, scores.csv,
    table.tex, scores.png and index.html. Scores are cached by content: the same command computes
    what is new.
    """

    size: Literal["output", "target"] = "output"
    """Size of the comparison: of the first folder's clips, or of the recorded video.

    That of the output flatters small ones: compare methods whose outputs differ in size at that of
    the target."""
    out: Path | None = None
    """Folder of the report, by default that of the first folder's clips."""

    def run(self) -> int:
        """Compare clip after clip, then summarize."""
        from egosim_jax.evaluation.methods import Folder
        from egosim_jax.evaluation.result import SHOWN
        from egosim_jax.evaluation.scoring import Protocol

        folders = [Folder.parse(text) for text in self.generated]
        first = folders[0]
        if len(folders) == 1 and "=" not in self.generated[0]:
            folders = [replace(first, name="generated", title="generated")]
        title = "ground truth through the autoencoder"
        vae = Folder(path=first.path, name="vae", title=title, suffix="_vae", optional=True)
        evaluation = self.compare(
            [*folders, vae],
            self.read_clips(),
            protocol=Protocol(size=self.size),
            out=self.out or first.path,
            title="Evaluation",
            networks=self.lpips,
            shown=SHOWN,
        )
        return ExitCode.PARTIAL if evaluation.skipped else ExitCode.DONE
