"""The true architecture, small, from scratch: the VAE, then the denoiser with its encoders.

    egosim-train real_tiny --metadata CLIPS/metadata.csv --out runs/real_tiny

runs on a CPU. Every stage resumes: run the same command again after an interruption.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from egosim_jax.command import DONE
from egosim_jax.train.config import OptimizerConfig, Recipe, Training, may_differ
from egosim_jax.train.distributed import check_alone
from egosim_jax.train.update import Stage

if TYPE_CHECKING:
    from egosim_jax.train.from_scratch import FromScratch


@dataclass(frozen=True, kw_only=True)
class RealTiny(Recipe):
    """Train `real_tiny` from scratch on the clips of a metadata file.

    Writes OUT/weights, and beside it the shards, logs and checkpoints of each stage.
    """

    metadata: Path
    """CSV or JSONL in EgoSim's columns, with video and split."""
    out: Path
    """Folder of the run."""
    config: str = "real_tiny"
    """Name of the model; it must train its own encoders."""
    clip_frames: int = 61
    """Frames of every clip, of which windows are cut."""
    stride: int = 2
    """Frames between the windows of a clip that the denoiser is trained on."""
    vae: Training = field(
        default_factory=lambda: Training(
            steps=2000,
            batch_size=2,
            optimizer=OptimizerConfig(rule="muon", learning_rate=1e-3, warmup=20, decay="cosine"),
            log_every=25,
            save_every=500,
            validate_every=250,
        )
    )
    """Training of the autoencoder."""
    denoiser: Training = field(
        default_factory=lambda: Training(
            steps=2500,
            batch_size=4,
            optimizer=OptimizerConfig(rule="muon", learning_rate=2e-3, warmup=50, decay="cosine"),
            log_every=25,
            save_every=250,
            validate_every=500,
        )
    )
    """Training of the denoiser and its encoders."""
    weights: Path | None = None
    """Weights folder to start from: its autoencoder stays, its denoiser is trained further."""

    def stages(self) -> Mapping[str, Stage]:
        """The autoencoder's and the denoiser's."""
        return self._from_scratch({}).stages()

    def train(self) -> int:
        """Frames, autoencoder, latents, denoiser, weights."""
        from egosim_jax.io.run import open_folder

        check_alone("real_tiny")
        open_folder(self.out, self, may_differ=[*may_differ("vae", "denoiser"), "json"])
        frames = {split: self._pack(split) for split in ("train", "test")}
        print(self._from_scratch(frames).run())
        return DONE

    def _from_scratch(self, frames: Mapping[str, Path]) -> FromScratch:
        from egosim_jax import configs
        from egosim_jax.train.from_scratch import FromScratch

        return FromScratch(
            config=configs.get(self.config),
            frames=frames,
            out=self.out,
            vae=self.vae,
            denoiser=self.denoiser,
            weights=self.weights,
            stride=self.stride,
        )

    def _pack(self, split: str) -> Path:
        """Decode the clips of a split at the model's size."""
        from egosim_jax import configs
        from egosim_jax.data.manifest import MANIFEST
        from egosim_jax.data.metadata import read_metadata, select
        from egosim_jax.data.pack import pack
        from egosim_jax.progress import track

        out = self.out / "frames" / split
        if not (out / MANIFEST).exists():
            items = select(read_metadata(self.metadata), where=f"split={split}")
            spec = dataclasses.replace(configs.get(self.config).video, frames=self.clip_frames)
            provenance = {"metadata": str(self.metadata)}
            progress = pack(items, out=out, spec=spec, provenance=provenance)
            for problem in track(progress, f"packing {split}", total=len(items)):
                if problem:
                    print(f"left out: {problem}", file=sys.stderr)
        return out
