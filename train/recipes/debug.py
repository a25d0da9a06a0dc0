"""The smallest training there is, on clips made by formula: to see that everything runs.

    egosim-train debug --out runs/debug

takes about two minutes on 2 CPU cores.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from egosim_jax.train.optimizer import OptimizerConfig
from egosim_jax.train.recipes.real_tiny import CLIP_FRAMES, RealTiny
from egosim_jax.train.script import Training


def _training(steps: int) -> Training:
    return Training(
        steps=steps,
        batch_size=2,
        optimizer=OptimizerConfig(rule="muon", learning_rate=3e-3, warmup=5),
        log_every=5,
        save_every=10,
        validate_every=20,
    )


@dataclass(frozen=True, kw_only=True)
class Debug:
    """Train `debug` for a few steps on sample clips."""

    out: Path
    """Folder of the run."""
    clips: int = 8
    """Sample clips to make; every fourth is for testing."""
    vae: Training = field(default_factory=lambda: _training(20))
    """Training of the autoencoder."""
    denoiser: Training = field(default_factory=lambda: _training(20))
    """Training of the denoiser and its encoders."""

    @property
    def metadata(self) -> Path:
        """The sample clips."""
        return self.out / "clips" / "metadata.csv"

    def run(self) -> int:
        """Make the clips, then do as `real_tiny` does."""
        from egosim_jax import configs
        from egosim_jax.testing.sample import write_sample

        video = configs.get("debug").video
        spec = type(video)(frames=CLIP_FRAMES, height=video.height, width=video.width)
        write_sample(self.metadata.parent, spec=spec, clips=self.clips)
        return RealTiny(
            metadata=self.metadata,
            out=self.out,
            config="debug",
            stride=8,
            vae=self.vae,
            denoiser=self.denoiser,
        ).run()
