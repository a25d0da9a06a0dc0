"""`egosim experiment debug`: training and comparison in a few minutes, on synthetic clips."""

from __future__ import annotations

from dataclasses import replace

from egosim_jax.experiments.config import Debug
from egosim_jax.experiments.real_tiny import compare
from egosim_jax.train.from_scratch import SYNTHETIC_CLIPS
from egosim_jax.train.recipes import DEBUG


def run(settings: Debug) -> None:
    """Train, generate, compare and draw."""
    recipe = replace(
        DEBUG,
        out=settings.out,
        vae=replace(DEBUG.vae, steps=settings.steps),
        denoiser=replace(DEBUG.denoiser, steps=settings.steps),
    )
    recipe.run()
    metadata = settings.out / SYNTHETIC_CLIPS
    compare("debug", metadata, settings.out, starts=(0,), seed=settings.seed, batch_size=2)
