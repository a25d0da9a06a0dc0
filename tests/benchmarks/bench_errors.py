"""Squared error of `tabletop` by kind of pixel, through its VAE and generated.

    python -m tests.benchmarks.bench_errors --scenes 8

Held-out scenes of human hands from seed 100 on. Each pixel of frames 1 to 16 belongs to the hands
and arms, the moved object, the places that the prior does not show, or to all else, by the ground
truth. Shares of the mean squared error, 255 squared being 1, in 1e-5; they add up to it. Then, by
scene, the pixels of hands that a reconstruction has too many and lacks, in percent of the true
ones: the silhouettes are segmented by color, as in the ablation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Bool

from egosim_jax.evaluation.metrics import region
from egosim_jax.experiments import scenes
from egosim_jax.experiments.scenes import HeldOutClip
from egosim_jax.generation.generator import Generator
from egosim_jax.worlds.tabletop.scene import FIRST_HAND


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of the measurement."""

    config: str = "tabletop"
    """Name of the model."""
    weights: Path | None = None
    """Weights folder; None: those in the package."""
    scenes: int = 8
    """Number of scenes."""
    first: int = 100
    """Seed of the first scene."""


def kinds(scene: HeldOutClip) -> dict[str, Bool[np.ndarray, "f h w"]]:
    """Return the pixels of each kind in frames 1 to the last; each pixel has one."""
    ids = scene.clip.ids[1:]
    hands = ids >= FIRST_HAND
    moved = (ids == scene.clip.body_ids[scene.clip.target]) & ~hands
    hidden = (scene.triplet.mask[1:].reshape(ids.shape) > 0) & ~hands & ~moved
    return {
        "hands and arms": hands,
        "moved object": moved,
        "unobserved places": hidden,
        "all else": ~(hands | moved | hidden),
    }


def shares(found: Sequence[HeldOutClip], videos: Sequence[np.ndarray]) -> dict[str, float]:
    """Return the part of the mean squared error at each kind of pixel."""
    sums: dict[str, float] = {}
    for scene, video in zip(found, videos, strict=True):
        error = np.square(video[1:] / 255.0 - scene.clip.frames[1:] / 255.0).mean(axis=-1)
        for kind, where in kinds(scene).items():
            sums[kind] = sums.get(kind, 0.0) + float((error * where).mean()) / len(found)
    return sums


def silhouettes(scene: HeldOutClip, video: np.ndarray) -> Iterator[float]:
    """Yield the shares of pixels of hands too many, and missing."""
    truth = scene.clip.ids[1:] >= FIRST_HAND
    number = scene.clip.body_ids[scene.clip.target]
    paints = {n: c for n, c in scene.clip.paints.items() if n == number or n >= FIRST_HAND}
    seen = region.label(video[1:], scene.background[1:], paints)
    hands = region.open_mask(seen >= FIRST_HAND)
    yield (hands & ~truth).sum() / truth.sum()
    yield (truth & ~hands).sum() / truth.sum()


def main(settings: Settings) -> None:
    """Print both tables."""
    generator = Generator.load(settings.config, weights=settings.weights)
    seeds = range(settings.first, settings.first + settings.scenes)
    found = [HeldOutClip.make(seed, generator.config.video, "human") for seed in seeds]
    pixels = [kinds(scene) for scene in found]
    decoded = list(scenes.reconstruct(generator, found, batch_size=4))
    generated = list(scenes.generate(generator, found, batch_size=4))
    through, made = shares(found, decoded), shares(found, generated)
    print("| | pixels % | through the VAE | generated |\n|---|---|---|---|")
    for kind in through:
        part = 100 * np.mean([one[kind].mean() for one in pixels])
        print(f"| {kind} | {part:.0f} | {1e5 * through[kind]:.0f} | {1e5 * made[kind]:.0f} |")
    print(f"| sum | 100 | {1e5 * sum(through.values()):.0f} | {1e5 * sum(made.values()):.0f} |")
    for scene, video in zip(found, decoded, strict=True):
        many, few = silhouettes(scene, video)
        print(f"scene {scene.clip.seed}: {many:.0%} too many, {few:.0%} missing")


if __name__ == "__main__":
    main(tyro.cli(Settings))
