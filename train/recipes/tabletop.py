"""The model that ships: everything from scratch, on clips of the tabletop world.

    egosim-train tabletop --out runs/tabletop

makes the clips, trains the VAE, caches latents and trains the denoiser, on a CPU. Every stage
resumes: run the same command again after an interruption.
"""

from __future__ import annotations

import os
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

FIRST_TRAINED = 1000
"""Seed of the first scene that is trained on; those below are held out."""


@dataclass(frozen=True, kw_only=True)
class Tabletop(Recipe):
    """Train `tabletop` from scratch on scenes of the tabletop world, a quarter of them a robot's.

    Writes OUT/weights, and beside it the shards, logs and checkpoints of each stage.
    """

    out: Path
    """Folder of the run."""
    config: str = "tabletop"
    """Name of the model; it must train its own encoders."""
    scenes: int = 1000
    """Scenes to train on, two clips of each."""
    held_out: int = 48
    """Scenes to validate on, one clip of each."""
    vae: Training = field(
        default_factory=lambda: Training(
            steps=4000,
            batch_size=2,
            # With a short warm-up the first steps close the channel that tells green from purple,
            # and it stays closed.
            optimizer=OptimizerConfig(rule="muon", learning_rate=1e-3, warmup=300, decay="cosine"),
            log_every=25,
            save_every=250,
            validate_every=500,
        )
    )
    """Training of the autoencoder."""
    denoiser: Training = field(
        default_factory=lambda: Training(
            steps=8000,
            batch_size=8,
            optimizer=OptimizerConfig(rule="muon", learning_rate=2e-3, warmup=200, decay="cosine"),
            log_every=25,
            save_every=250,
            validate_every=500,
        )
    )
    """Training of the denoiser and its encoders."""
    change: float = 0.0
    """How much more a place counts for the denoiser where the clip is unlike its prior: at hands
    and at what they move."""
    weights: Path | None = None
    """Weights folder to start from: its autoencoder stays, its denoiser is trained further."""

    def stages(self) -> Mapping[str, Stage]:
        """The autoencoder's and the denoiser's."""
        return self._from_scratch({}).stages()

    def train(self) -> int:
        """Clips, autoencoder, latents, denoiser, weights."""
        from egosim_jax.io.run import open_folder

        check_alone("tabletop")
        open_folder(self.out, self, may_differ=[*may_differ("vae", "denoiser"), "json"])
        frames = {
            "train": self._make("train", range(FIRST_TRAINED, FIRST_TRAINED + self.scenes), 2),
            "test": self._make("test", range(self.held_out), 1),
        }
        print(self._from_scratch(frames).run())
        return DONE

    def _from_scratch(self, frames: Mapping[str, Path]) -> FromScratch:
        from egosim_jax import configs
        from egosim_jax.conditioning.dropout import ConditionDropout
        from egosim_jax.train.from_scratch import FromScratch

        return FromScratch(
            config=configs.get(self.config),
            frames=frames,
            out=self.out,
            vae=self.vae,
            denoiser=self.denoiser,
            weights=self.weights,
            dtype="float16",
            change=self.change,
            dropout=ConditionDropout(prior=0.15, mask=0.15, hands=0.15, text=0.15),
        )

    def _make(self, split: str, seeds: range, clips: int) -> Path:
        """The clips of a split, decoded."""
        from egosim_jax import configs
        from egosim_jax.progress import track
        from egosim_jax.worlds.tabletop.dataset import DatasetConfig, make_shards

        spec = configs.get(self.config).video
        plan = DatasetConfig(seeds=tuple(seeds), clips=clips, spec=spec, kind="mixed")
        out = self.out / "frames" / split
        scenes = make_shards(plan, out=out, workers=os.cpu_count() or 1)
        for _ in track(scenes, f"making {split}", total=len(seeds)):
            pass
        return out
