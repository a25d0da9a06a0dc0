"""A small model from nothing: the autoencoder, then the denoiser with its encoders on its latents.

Or from weights: then the autoencoder is theirs. Every stage lies in a folder of its own under the
run's and resumes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from egosim_jax.conditioning.dropout import ConditionDropout
from egosim_jax.data.manifest import MANIFEST
from egosim_jax.data.shards import ShardReader
from egosim_jax.data.transforms import record_length
from egosim_jax.diffusion.objective import Objective
from egosim_jax.io import weights
from egosim_jax.models import abstract
from egosim_jax.models.wan.vae import WanVAE, standardise_latents
from egosim_jax.networks import ModelConfig, Networks
from egosim_jax.train.config import Training
from egosim_jax.train.encode import cache
from egosim_jax.train.loop import train
from egosim_jax.train.tasks.autoencoding import Autoencoding, latent_statistics
from egosim_jax.train.tasks.denoising import Denoising
from egosim_jax.train.update import Stage

BATCH = 8
"""Clips that are encoded together."""


@dataclass(frozen=True, kw_only=True)
class FromScratch:
    """The stages of a model that trains its own encoders."""

    config: ModelConfig
    """The model."""
    frames: Mapping[str, Path]
    """Folders of decoded clips: those to train on, `train`, and those to validate on, `test`."""
    out: Path
    """Folder of the run; the networks go to OUT/weights."""
    vae: Training
    """Training of the autoencoder."""
    denoiser: Training
    """Training of the denoiser and its encoders."""
    crop: tuple[int, int] = (48, 64)
    """Rows and columns of the pieces that the autoencoder is trained on."""
    stride: int = 1
    """Frames between the windows of a clip that the denoiser is trained on."""
    dtype: str = "float32"
    """Of the weights that are written."""
    dropout: ConditionDropout = field(default_factory=ConditionDropout)
    """How often each condition is hidden from the denoiser."""
    change: float = 0.0
    """How much more a place counts for the denoiser where the clip is unlike its prior."""
    weights: Path | None = None
    """Weights folder to start from: its autoencoder stays, its denoiser is trained further."""

    def stages(self) -> Mapping[str, Stage]:
        """The autoencoder's, unless it comes with the weights, and the denoiser's."""
        # Pieces as long as the model's clips: a VAE that has only seen shorter ones drifts later.
        vae = Autoencoding(vae=self.config.vae, video=self.config.video, crop=self.crop)
        denoiser = Denoising(
            model=self.config,
            objective=Objective(schedule=self.config.schedule),
            dropout=self.dropout,
            change=self.change,
        )
        stages = {"vae": Stage(vae, self.vae), "denoiser": Stage(denoiser, self.denoiser)}
        return {name: stages[name] for name in stages if name == "denoiser" or not self.weights}

    def run(self) -> Path:
        """Autoencoder, latents, denoiser; the folder of the weights."""
        networks = Networks.random(self.config, seed=0)
        networks.vae = self._autoencoder()
        latents = {split: self._encode(split) for split in self.frames}
        trained = train(
            *self.stages()["denoiser"],
            data=latents["train"],
            validation=latents["test"],
            out=self.out / "denoiser",
            weights=self.weights,
        )
        networks.dit, networks.text, networks.image = trained.dit, trained.text, trained.image
        networks.save(self.out / "weights", dtype=self.dtype)
        return self.out / "weights"

    def _autoencoder(self) -> WanVAE:
        """The VAE, trained, with latents of mean 0 and deviation 1."""
        path = self.out / "weights" / "vae.safetensors"
        vae = abstract(self.config.vae)
        if not path.exists() and self.weights is not None:
            weights.load(self.weights / path.name, vae)
            weights.save(path, vae)
        elif not path.exists():
            weights.save(path, self._train_autoencoder(), dtype=self.dtype)
        # What was written is what encodes, in a run that was interrupted and in one that was not.
        weights.load(path, vae)
        return vae

    def _train_autoencoder(self) -> WanVAE:
        vae = train(
            *self.stages()["vae"],
            data=self.frames["train"],
            validation=self.frames["test"],
            out=self.out / "vae",
        )
        videos = (record.arrays["target"] for record in ShardReader(self.frames["train"]))
        standardise_latents(vae, *latent_statistics(vae, videos))
        return vae

    def _encode(self, split: str) -> Path:
        """Cache the latents of every window of a split."""
        out = self.out / "latents" / split
        if not (out / MANIFEST).exists():
            source = ShardReader(self.frames[split])
            # To validate, a clip's first window and, if it is longer, its last.
            last = record_length(source[0].arrays) - self.config.video.frames
            every = self.stride if split == "train" else max(1, last)
            cache(
                self.config,
                self.out / "weights",
                source=source,
                out=out,
                stride=every,
                batch_size=BATCH,
                verb=f"encoding {split}",
            )
        return out
