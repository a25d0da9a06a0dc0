r"""EgoSim's conditioning on the 1.3B transformer, from Wan 2.1 Fun InP 1.3B widened to 52 channels.

    egosim-convert weights Wan2.1-Fun-1.3B-InP --config egosim_1_3b --widen polarity \
        --out weights/base
    egosim data encode --config egosim_1_3b --weights weights/base --shards shards/train \
        --out latents/train
    egosim-train egosim_1_3b --weights weights/base --latents latents/train --out runs/egosim_1_3b

Weights and moments of 1.6 billion parameters take 19 GB, so that one H200 is enough; eight share
them. A tenth of the FLOPs of the 14B. Estimated, not measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from egosim_jax.train.config import OptimizerConfig, Training
from egosim_jax.train.fine_tuning import FineTuning


@dataclass(frozen=True, kw_only=True)
class Egosim1B(FineTuning):
    """Train all of the 1.3B transformer with EgoSim's conditioning."""

    config: str = "egosim_1_3b"
    """Name of the model."""
    training: Training = field(
        default_factory=lambda: Training(
            steps=4000,
            batch_size=32,
            accumulate=4,
            optimizer=OptimizerConfig(learning_rate=1e-5, weight_decay=0.01),
            save_every=200,
            keep_every=1000,
            validate_every=200,
            sample_every=500,
        )
    )
    """How long, how fast and how often."""
