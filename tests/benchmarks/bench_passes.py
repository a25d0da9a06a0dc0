"""Forward passes of sampling and what leaving some out costs, on the shipped model.

    python -m tests.benchmarks.bench_passes [--clips 3] [--steps 50] [--scale 2]

samples clips of held-out scenes with guidance, with all steps and both passes of each. Then it
reuses predictions below several thresholds, guides in an interval only, and takes fewer steps, and
prints the forward passes of a clip and the distance to the first sampling: of the latents
(relative L2) and of the frames (PSNR and LPIPS).
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

import egosim_jax as egosim
from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion import Guidance, StepCache
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.generation import generator
from egosim_jax.generation.encoding import pack
from egosim_jax.types import Triplet
from egosim_jax.worlds.tabletop import make_sequence
from egosim_jax.worlds.tabletop.clips import to_triplet
from egosim_jax.worlds.tabletop.dataset import conditions_of

NAME, FIRST_SEED = "tabletop", 700
THRESHOLDS = (0.02, 0.05, 0.1, 0.2)
INTERVAL = (200.0, 900.0)
Sample = tuple[np.ndarray, np.ndarray]
"""Latents and frames of clips."""


def variants(full: ModelConfig, steps: int, scale: float) -> Iterator[tuple[str, ModelConfig]]:
    """Yield the samplings by the options that choose them."""
    yield "every pass", full
    for threshold in THRESHOLDS:
        yield f"`--cache {threshold:g}`", replace(full, cache=StepCache(threshold=threshold))
    limited = replace(full, guidance=Guidance(scale=scale, interval=INTERVAL))
    yield "`--guidance-interval {:g} {:g}`".format(*INTERVAL), limited
    both = replace(limited, cache=StepCache(threshold=THRESHOLDS[1]))
    yield f"both, `--cache {THRESHOLDS[1]:g}`", both
    for count in (steps // 2, steps // 4):
        yield f"`--steps {count}`", replace(full, steps=count)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=3)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--scale", type=float, default=2.0)
    options = parser.parse_args()
    model = configs.get(NAME)
    full = replace(model, steps=options.steps, guidance=Guidance(scale=options.scale))
    triplets = held_out(model, options.clips)
    metric = lpips.Lpips.load("alex")
    print("| sampling | passes | latents | PSNR | LPIPS |\n| --- | --- | --- | --- | --- |")
    whole = None
    for name, config in variants(full, options.steps, options.scale):
        passes, latents, frames = sampled(config, triplets)
        whole = whole or (latents, frames)
        shown = distances(metric, (latents, frames), whole)
        print(f"| {name} | {passes:.1f} | {shown}", flush=True)


def held_out(model: ModelConfig, clips: int) -> list[Triplet]:
    """Return the conditions of clips of held-out scenes."""
    prior, hands = conditions_of(model)
    scenes = (
        next(make_sequence(FIRST_SEED + n, spec=model.video, kind="human")) for n in range(clips)
    )
    return [to_triplet(c, prior=prior, hands=hands, point_px=model.point_px) for c in scenes]


def distances(metric: lpips.Lpips, sample: Sample, whole: Sample) -> str:
    """Return the cells of the distance of latents and frames to the full sampling."""
    (latents, frames), (all_latents, all_frames) = sample, whole
    error = np.linalg.norm(latents - all_latents) / np.linalg.norm(all_latents)
    mse = np.square(frames.astype(float) - all_frames).mean(axis=(1, 2, 3, 4))
    far = np.mean(
        [
            lpips.frame_distances(metric, a[1::4], b[1::4]).mean()
            for a, b in zip(frames, all_frames, strict=True)
        ]
    )
    psnr = np.mean(10 * np.log10(255**2 / np.maximum(mse, 1e-9)))
    return "| | |" if not error else f"{error:.3f} | {psnr:.1f} | {far:.4f} |"


def sampled(
    config: ModelConfig, triplets: list[Triplet], weights: Path | None = None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the mean number of forward passes of a clip, the latents and the frames."""
    sampler = egosim.Generator.load(config, weights or configs.shipped_weights(NAME))
    network, passes = sampler.networks.dit, 0

    class Counted:
        """The denoiser, whose forward passes are counted."""

        prepare = staticmethod(network.prepare)

        @staticmethod
        def denoise(x: jax.Array, t: jax.Array, context: object) -> jax.Array:
            def count(_: object) -> None:
                nonlocal passes
                passes += 1

            jax.debug.callback(count, t[0])
            return network.denoise(x, t, context)

    sample = jax.jit(lambda c, n: generator.denoise(Counted, c, n, config))
    latents = []
    for seed, triplet in enumerate(triplets):  # one after the other: each has its own passes
        seeds = np.array([seed], np.uint32)
        condition = sampler.encode(pack([triplet], config, seeds))
        latents.append(sample(condition, sampler.noise(seeds)))
    jax.effects_barrier()
    together = np.concatenate([np.asarray(latent) for latent in latents])
    return passes / len(triplets), together, np.asarray(sampler.decode(together))


if __name__ == "__main__":
    main()
