"""`egosim experiment debug`: the whole training and comparison in a few minutes."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
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
        from egosim_jax.train.recipes import Debug as Recipe

        plan = Recipe(out=self.out)
        recipe = dataclasses.replace(
            plan,
            vae=dataclasses.replace(plan.vae, steps=self.steps),
            denoiser=dataclasses.replace(plan.denoiser, steps=self.steps),
        )
        recipe.run()
        return Comparison(
            config="debug",
            metadata=recipe.metadata,
            out=self.out,
            start=(0,),
            seed=self.seed,
            batch_size=2,
        ).run()
