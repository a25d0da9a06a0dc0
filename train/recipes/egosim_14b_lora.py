"""A LoRA on EgoSim's 14B transformer, which one GPU can train.

    egosim-train egosim_14b_lora --weights weights/egosim_14b --latents latents/mine --out runs/lora
    egosim-convert lora runs/lora/lora.safetensors --config egosim_14b --out mine.safetensors

The weights stay as they are, in bfloat16: 33 GB; a LoRA of rank 64 has 337 million weights, which
are float32 with their moments: 4 GB. With what the one clip keeps that an update of 8 takes at a
time, 65 GiB: one H200 or H100, a minute an update. Estimated, not measured. The second command
writes the names that ComfyUI and diffusers read.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from egosim_jax.train.config import OptimizerConfig, Training
from egosim_jax.train.fine_tuning import FineTuning


@dataclass(frozen=True, kw_only=True)
class Egosim14BLora(FineTuning):
    """Train a LoRA on EgoSim's 14B transformer."""

    config: str = "egosim_14b"
    """Name of the model."""
    rank: int | None = 64
    """Rank of the LoRA."""
    training: Training = field(
        default_factory=lambda: Training(
            steps=1000,
            batch_size=8,
            accumulate=8,
            optimizer=OptimizerConfig(learning_rate=1e-4, warmup=20),
            save_every=100,
            validate_every=100,
            sample_every=250,
        )
    )
    """How long, how fast and how often."""
