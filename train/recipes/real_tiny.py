"""The true architecture, small, from scratch: the VAE, then the denoiser with its encoders.

    egosim-train real_tiny --metadata CLIPS/metadata.csv --out runs/real_tiny

runs on a CPU. Every stage resumes: run the same command again after an interruption.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from flax import nnx

from egosim_jax.command import DONE
from egosim_jax.diffusion.objective import Objective
from egosim_jax.train.autoencoder import Autoencoding, latent_statistics
from egosim_jax.train.denoiser import Denoising
from egosim_jax.train.optimizer import OptimizerConfig
from egosim_jax.train.script import Training, train

if TYPE_CHECKING:
    from egosim_jax.generator import ModelConfig, Networks
    from egosim_jax.models.wan_vae import WanVAE

CLIP_FRAMES = 61
"""Frames of a whole clip, of which windows are cut."""


@dataclass(frozen=True, kw_only=True)
class RealTiny:
    """Train `real_tiny` from scratch on the clips of a metadata file.

    Writes OUT/weights, and beside it the shards, logs and checkpoints of each stage.
    """

    metadata: Path
    """CSV or JSONL in EgoSim's columns, with video and split; clips of 61 frames."""
    out: Path
    """Folder of the run."""
    config: str = "real_tiny"
    """Name of the model; it must train its own encoders."""
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

    def run(self) -> int:
        """Frames, autoencoder, latents, denoiser, weights."""
        from egosim_jax import configs
        from egosim_jax.io.run import open_folder

        config = configs.get(self.config)
        open_folder(self.out, self)
        frames = {split: self._pack(split, config) for split in ("train", "test")}
        vae = self._autoencoder(config, frames)
        latents = {split: self._encode(split, config, vae, frames) for split in frames}
        networks = self._denoiser(config, vae, latents)
        networks.save(self.out / "weights")
        print(self.out / "weights")
        return DONE

    def _pack(self, split: str, config: ModelConfig) -> Path:
        """Decode the clips of a split at the model's size."""
        from egosim_jax.data.metadata import read_metadata, select
        from egosim_jax.data.pack import pack

        out = self.out / "frames" / split
        if not (out / "manifest.json").exists():
            items = select(read_metadata(self.metadata), where=f"split={split}")
            spec = dataclasses.replace(config.video, frames=CLIP_FRAMES)
            provenance = {"metadata": str(self.metadata)}
            progress = pack(items, out=out, spec=spec, provenance=provenance)
            for problem in _tell(f"packing {split}", progress):
                print(f"left out: {problem}", file=sys.stderr)
        return out

    def _autoencoder(self, config: ModelConfig, frames: dict[str, Path]) -> WanVAE:
        """Train the VAE, then give its latents mean 0 and deviation 1."""
        from egosim_jax.data.shards import ShardReader
        from egosim_jax.io import weights
        from egosim_jax.models.wan_vae import WanVAE, standardise_latents

        path = self.out / "weights" / "vae.safetensors"
        if path.exists():
            vae = nnx.eval_shape(lambda: WanVAE(config.vae, rngs=nnx.Rngs(0)))
            weights.load(path, vae)
            return vae
        # Pieces as long as the model's clips: a VAE that has only seen shorter ones drifts later.
        vae = train(
            Autoencoding(vae=config.vae, video=config.video, crop=(48, 64)),
            self.vae,
            data=frames["train"],
            validation=frames["test"],
            out=self.out / "vae",
        )
        videos = (record.arrays["truth"] for record in ShardReader(frames["train"]))
        standardise_latents(vae, *latent_statistics(vae, videos))
        weights.save(path, vae)
        return vae

    def _encode(
        self, split: str, config: ModelConfig, vae: WanVAE, frames: dict[str, Path]
    ) -> Path:
        """Cache the latents of every window of a split."""
        from egosim_jax.data.shards import ShardReader
        from egosim_jax.generator import Generator, Networks
        from egosim_jax.io.weights import hashes
        from egosim_jax.train.cache import cache

        out = self.out / "latents" / split
        if not (out / "manifest.json").exists():
            networks = Networks.random(config, seed=0)
            networks.vae = vae
            progress = cache(
                Generator(config, networks),
                source=ShardReader(frames[split]),
                out=out,
                stride=self.stride if split == "train" else CLIP_FRAMES - config.video.frames,
                batch_size=8,
                provenance={"config": config.name, "weights": hashes(self.out / "weights")},
            )
            _tell(f"encoding {split}", progress)
        return out

    def _denoiser(self, config: ModelConfig, vae: WanVAE, latents: dict[str, Path]) -> Networks:
        """Train the denoiser, and put the four networks together."""
        from egosim_jax.generator import Networks

        task = Denoising(model=config, objective=Objective(schedule=config.schedule))
        trained = train(
            task,
            self.denoiser,
            data=latents["train"],
            validation=latents["test"],
            out=self.out / "denoiser",
        )
        networks = Networks.random(config, seed=0)
        networks.dit, networks.text, networks.image = trained.dit, trained.text, trained.image
        networks.vae = vae
        return networks


def _tell(what: str, progress: Iterable[object]) -> list[object]:
    """Work through, with a line at the beginning and the end; whatever was not None."""
    print(f"{what} ...", file=sys.stderr, flush=True)
    answers = list(progress)
    print(f"{what}: done", file=sys.stderr, flush=True)
    return [answer for answer in answers if answer is not None]
