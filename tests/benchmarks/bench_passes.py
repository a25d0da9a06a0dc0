"""Forward passes of sampling and what leaving some out costs, on the shipped model.

    python -m tests.benchmarks.bench_passes [--clips 3] [--steps 50] [--scale 2] [--only TEXT]

samples clips of held-out scenes with guidance, with all steps and both passes of each. Then it
reuses predictions below several thresholds, guides in an interval only, takes the first steps on
half the grid, and takes fewer steps. It prints the forward passes of a clip, how many of them were
on half the grid, and the distance to the first sampling: of the latents (relative L2) and of the
frames (PSNR and LPIPS). `--only TEXT` samples only the variants whose name has the text, and the
first one.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np

import egosim_jax as egosim
from egosim_jax import configs
from egosim_jax.configs.model import ModelConfig
from egosim_jax.diffusion import Guidance, Progressive, StepCache
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.generation.denoising import denoise
from egosim_jax.generation.encoding import pack
from egosim_jax.types import Triplet
from egosim_jax.worlds.tabletop import make_sequence
from egosim_jax.worlds.tabletop.clips import to_triplet
from egosim_jax.worlds.tabletop.dataset import conditions_of

NAME, FIRST_SEED = "tabletop", 700
THRESHOLDS = (0.02, 0.05, 0.1, 0.2)
INTERVAL = (200.0, 900.0)
SHARES = (0.1, 0.2, 0.3, 0.5, 0.66)
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
    for share in SHARES:
        progressive = replace(full, progressive=Progressive(share=share))
        yield f"`--progressive {share:g}`", progressive
        if share in SHARES[1:3]:
            both = replace(progressive, cache=StepCache(threshold=THRESHOLDS[1]))
            yield f"`--progressive {share:g}`, `--cache {THRESHOLDS[1]:g}`", both
    for count in (steps // 2, steps // 4):
        yield f"`--steps {count}`", replace(full, steps=count)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=3)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--scale", type=float, default=2.0)
    parser.add_argument("--only", default="")
    options = parser.parse_args()
    model = configs.get(NAME)
    full = replace(model, steps=options.steps, guidance=Guidance(scale=options.scale))
    triplets = held_out(model, options.clips)
    metric = lpips.Lpips.load("alex")
    print("| sampling | passes | on half the grid | latents | PSNR | LPIPS |")
    print("| --- | --- | --- | --- | --- | --- |")
    whole = None
    for name, config in variants(full, options.steps, options.scale):
        if whole is not None and options.only not in name:
            continue
        passes, halves, latents, frames = sampled(config, triplets)
        whole = whole or (latents, frames)
        shown = distances(metric, (latents, frames), whole)
        print(f"| {name} | {passes:.1f} | {halves:.1f} | {shown}", flush=True)


class Counted:
    """A denoiser whose forward passes are counted, each by the rows of its latents."""

    def __init__(self, network: Any, rows: list[int]):
        self.network, self.rows = network, rows
        self.prepare, self.prepare_half = network.prepare, network.prepare_half

    def denoise(self, noisy: jax.Array, t: jax.Array, context: Any) -> jax.Array:
        """Denoise, and note the rows when the program does."""
        jax.debug.callback(lambda _: self.rows.append(noisy.shape[2]), t[0])
        return self.network.denoise(noisy, t, context)


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
) -> tuple[float, float, np.ndarray, np.ndarray]:
    """Return the forward passes of a clip, those on half the grid, the latents and the frames."""
    sampler = egosim.Generator.load(config, weights or configs.shipped_weights(NAME))
    network, rows = sampler.networks.dit, []
    sample = jax.jit(lambda c, n: denoise(Counted(network, rows), c, n, config))
    latents = []
    for seed, triplet in enumerate(triplets):  # one after the other: each has its own passes
        seeds = np.array([seed], np.uint32)
        condition = sampler.encode(pack([triplet], config, seeds))
        latents.append(sample(condition, sampler.noise(seeds)))
    jax.effects_barrier()
    together = np.concatenate([np.asarray(latent) for latent in latents])
    halves = sum(count < together.shape[2] for count in rows)
    frames = np.asarray(sampler.decode(together))
    return len(rows) / len(triplets), halves / len(triplets), together, frames


if __name__ == "__main__":
    main()
