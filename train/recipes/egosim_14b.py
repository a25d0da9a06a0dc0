r"""EgoSim's main training: all of the 14B transformer, from Wan 2.1 Fun InP 14B widened to 52.

    egosim-convert weights Wan2.1-Fun-14B-InP --config egosim_14b --widen polarity \
        --out weights/base
    egosim data encode --config egosim_14b --weights weights/base --shards shards/train \
        --out latents/train
    egosim-train egosim_14b --weights weights/base --latents latents/train --out runs/egosim_14b

AdamW at 1e-5, 32 clips of 61 frames of 832 x 480 an update, 4000 updates, as in the paper (section
4.1). Weights and moments take 197 GB, so 8 x H200 share them by FSDP: some 31 GiB each, some 70 GiB
with what a clip keeps; `--remat projections` is 5 % faster and takes 125 GiB. 4.3e20 model FLOPs:
34 hours at 45 % of the devices' peak, which one H200 reached with 16 of the 40 blocks
(docs/gpu.md). Estimated, not measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from egosim_jax.train.config import OptimizerConfig, Training
from egosim_jax.train.fine_tuning import FineTuning


@dataclass(frozen=True, kw_only=True)
class Egosim14B(FineTuning):
    """Train all of EgoSim's 14B transformer, from Wan 2.1 Fun InP widened to 52 channels."""

    config: str = "egosim_14b"
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
