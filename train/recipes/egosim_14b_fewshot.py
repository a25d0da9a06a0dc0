r"""EgoSim's adaption to a new wearer or place, from a few dozen clips.

    egosim-train egosim_14b_fewshot --weights weights/egosim_14b --latents latents/mine \
        --out runs/mine

50 updates of one clip a device, as in the paper (section 4.1), which had 30 clips. 8 x H200 with
some 62 GiB each, a few minutes; on other numbers of devices set `--training.batch-size` to theirs.
Estimated, not measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from egosim_jax.train.config import OptimizerConfig, Training
from egosim_jax.train.fine_tuning import FineTuning


@dataclass(frozen=True, kw_only=True)
class Egosim14BFewshot(FineTuning):
    """Adapt EgoSim's 14B transformer to a few clips."""

    config: str = "egosim_14b"
    """Name of the model."""
    training: Training = field(
        default_factory=lambda: Training(
            steps=50,
            batch_size=8,
            optimizer=OptimizerConfig(learning_rate=1e-5, weight_decay=0.01),
            log_every=5,
            save_every=25,
            validate_every=25,
            sample_every=25,
        )
    )
    """How long, how fast and how often."""
