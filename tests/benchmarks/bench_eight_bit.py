"""Quality of samples with weights in 8 bits, on the shipped model.

    python -m tests.benchmarks.bench_eight_bit [--clips 2] [--steps 50] [--scale 2]

converts the weights to int8 and float8, samples clips of held-out scenes with guidance, and prints
the size of the denoiser's file and the distance to the sampling with the weights as they are: of
the latents (relative L2) and of the frames (PSNR and LPIPS).
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

from egosim_jax import configs
from egosim_jax.convert.__main__ import main as convert
from egosim_jax.diffusion import Guidance
from egosim_jax.evaluation.metrics import lpips
from egosim_jax.models.eight_bit import DTYPES
from tests.benchmarks.bench_passes import NAME, distances, held_out, sampled


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--clips", type=int, default=2)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--scale", type=float, default=2.0)
    options = parser.parse_args()
    full = replace(configs.get(NAME), steps=options.steps, guidance=Guidance(scale=options.scale))
    with_activations = replace(full, activations="8bit")
    shipped = configs.weights_of(NAME, None)
    triplets, metric = held_out(full, options.clips), lpips.Lpips.load("alex")
    print("| weights | activations | MB | latents | PSNR | LPIPS |")
    print("| --- | --- | --- | --- | --- | --- |")
    _, _, *whole = sampled(full, triplets, shipped)
    print(f"| float16 | float32 | {_megabytes(shipped)} | | | |", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        for kind in DTYPES:
            folder = Path(temporary) / kind
            if convert(["quantize", str(shipped), "--out", str(folder), "--kind", kind]):
                raise SystemExit(1)
            for name, config in {"float32": full, kind: with_activations}.items():
                _, _, *sample = sampled(config, triplets, folder)
                shown = distances(metric, tuple(sample), tuple(whole))
                print(f"| {kind} | {name} | {_megabytes(folder)} | {shown}", flush=True)


def _megabytes(folder: Path) -> str:
    return f"{(folder / 'dit.safetensors').stat().st_size / 1e6:.1f}"


if __name__ == "__main__":
    main()
