r"""EgoSim's cross-embodiment training: the model of people's hands goes on with a robot's gripper.

    egosim-train egosim_14b_robot --weights weights/egosim_14b --latents latents/agibot \
        --out runs/robot

200 updates of 32 clips after the main training, as in the paper (section 4.1); hardware and memory
as in `egosim_14b`, two hours at 45 % of the peak. Estimated, not measured.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from egosim_jax.train.config import OptimizerConfig, Training
from egosim_jax.train.fine_tuning import FineTuning


@dataclass(frozen=True, kw_only=True)
class Egosim14BRobot(FineTuning):
    """Train EgoSim's 14B transformer on clips of a robot, after the people's."""

    config: str = "egosim_14b"
    """Name of the model."""
    training: Training = field(
        default_factory=lambda: Training(
            steps=200,
            batch_size=32,
            accumulate=4,
            optimizer=OptimizerConfig(learning_rate=1e-5, weight_decay=0.01),
            log_every=5,
            save_every=50,
            validate_every=50,
            sample_every=100,
        )
    )
    """How long, how fast and how often."""
