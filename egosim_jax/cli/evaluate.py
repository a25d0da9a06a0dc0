"""`egosim evaluate`: PSNR, SSIM and LPIPS of generated clips."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from egosim_jax.command import ExitCode


@dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Compare generated clips with the recorded ones by PSNR, SSIM and LPIPS.

    Every {id}.mp4 is compared with the ground truth of its metadata row over the same frames, both
    at one size; so are the prior, the prior with a least-squares color fit, the first frame of the
    ground truth repeated and, if there is an {id}_vae.mp4, the ground truth through the
    autoencoder. Frame 0 is excluded, because there the repeated frame is the ground truth. A clip
    of another length than most is skipped (exit code 3). LPIPS needs the extra `metrics`. Prints a
    table; writes metrics.jsonl (one line per clip) and report.json, which names the protocol.
    """

    generated: Path
    """Folder of {id}.mp4; its results.jsonl, if it has one, lists the clips and windows."""
    metadata: Path
    """CSV or JSONL in EgoSim's columns, with video."""
    where: str | None = None
    """Take rows whose column has this value, for instance split=test."""
    size: Literal["output", "target"] = "output"
    """Size of the comparison: of the output, or of the recorded video.

    That of the output flatters small ones: compare methods whose outputs differ in size at that of
    the target."""
    out: Path | None = None
    """Folder of the report, by default that of the clips."""

    def run(self) -> int:
        """Compare clip after clip, then summarize."""
        from egosim_jax.data.metadata import read_metadata, select
        from egosim_jax.evaluation import evaluate

        clips = select(read_metadata(self.metadata), where=self.where)
        evaluation = evaluate(self.generated, clips, size=self.size, out=self.out)
        evaluation.print()
        return ExitCode.PARTIAL if evaluation.skipped else ExitCode.DONE
