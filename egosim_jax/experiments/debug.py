"""`egosim experiment debug`: the whole training and comparison in a few minutes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from egosim_jax.experiments.real_tiny import Comparison


@dataclass(frozen=True, kw_only=True)
class Debug:
    """The same with `debug` on sample clips, in a few minutes: to see that everything runs."""

    out: Path
    """Folder of the run."""
    steps: int = 20
    """Updates of the autoencoder, and as many of the denoiser."""
    seed: int = 0
    """Seed of the generated clips."""

    def run(self) -> int:
        """Train, generate, compare, draw."""
        from egosim_jax.train.from_scratch import SYNTHETIC_CLIPS
        from egosim_jax.train.recipes import DEBUG

        recipe = replace(
            DEBUG,
            out=self.out,
            vae=replace(DEBUG.vae, steps=self.steps),
            denoiser=replace(DEBUG.denoiser, steps=self.steps),
        )
        recipe.run()
        return Comparison(
            config="debug",
            metadata=self.out / SYNTHETIC_CLIPS,
            out=self.out,
            start=(0,),
            seed=self.seed,
            batch_size=2,
        ).run()
