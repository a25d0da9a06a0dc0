"""Time PSNR, SSIM and LPIPS of clips of 61 frames at 832 x 480 against torch, and compare values.

    python -m tests.benchmarks.bench_metrics GENERATED TARGET [GENERATED TARGET ...] [--frames 61]

GENERATED and TARGET are video files. Ours: `psnr`, `ssim` and `frame_distances` with AlexNet.
Theirs: torchmetrics' PSNR and SSIM if it is installed, else scikit-image's; and LPIPS computed
eagerly in torch with the same weights (tests/unit/evaluation/metrics/test_lpips.py). Each clip is
measured by both in turn, after a warm-up of both on its first frame; printed are seconds a clip,
the ratio of each pair and their median, and the largest differences of all frames' values. Both
use all cores given to the process (taskset -c 0,1).
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from egosim_jax.evaluation.methods import Shape, read_at
from egosim_jax.evaluation.metrics.image import psnr, ssim
from egosim_jax.evaluation.metrics.lpips import Lpips, frame_distances
from tests.unit.evaluation.metrics.test_lpips import torch_lpips

Values = dict[str, np.ndarray]
"""Values of all frames by measure."""
TORCH_BATCH = 5
"""Frames that torch compares at once, as many as ours."""


def ours(alex: Lpips, video: np.ndarray, target: np.ndarray) -> Values:
    return {
        "psnr": psnr(video, target),
        "ssim": ssim(video, target),
        "lpips": frame_distances(alex, video, target),
    }


def theirs(video: np.ndarray, target: np.ndarray) -> Values:
    batches = range(0, len(video), TORCH_BATCH)
    with torch.no_grad():
        distances = [
            torch_lpips("alex", video[k : k + TORCH_BATCH], target[k : k + TORCH_BATCH])
            for k in batches
        ]
    return {**torchmetrics_values(video, target), "lpips": np.concatenate(distances)}


def torchmetrics_values(video: np.ndarray, target: np.ndarray) -> Values:
    """Return PSNR and SSIM of every frame by torchmetrics, or by scikit-image without it."""
    try:
        from torchmetrics.functional.image import (
            peak_signal_noise_ratio as torch_psnr,
        )
        from torchmetrics.functional.image import (
            structural_similarity_index_measure as torch_ssim,
        )
    except ImportError:
        return reference_values(video, target)
    found: dict[str, list[float]] = {"psnr": [], "ssim": []}
    for frame, other in zip(video, target, strict=True):
        a, b = (torch.from_numpy(x.copy()).movedim(-1, 0)[None].float() for x in (frame, other))
        found["psnr"].append(float(torch_psnr(a, b, data_range=255.0)))
        found["ssim"].append(float(torch_ssim(a, b, data_range=255.0)))
    return {name: np.array(values) for name, values in found.items()}


def reference_values(video: np.ndarray, target: np.ndarray) -> Values:
    """Return PSNR and SSIM of every frame by scikit-image."""
    similarity = partial(
        structural_similarity,
        channel_axis=-1,
        data_range=255,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    pairs = list(zip(video, target, strict=True))
    return {
        "psnr": np.array([peak_signal_noise_ratio(b, a, data_range=255) for a, b in pairs]),
        "ssim": np.array([similarity(b, a) for a, b in pairs]),
    }


def timed(compute: Callable[[], Values]) -> tuple[float, float, Values]:
    """Return seconds, seconds of the processor, and the values."""
    wall, cpu = time.perf_counter(), time.process_time()
    values = compute()
    return time.perf_counter() - wall, time.process_time() - cpu, values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("videos", type=Path, nargs="+")
    parser.add_argument("--frames", type=int, default=61)
    args = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    torch.set_num_threads(cores)
    alex = Lpips.load("alex")
    ratios, gaps = [], {"psnr": 0.0, "ssim": 0.0, "lpips": 0.0}
    for generated, target in zip(args.videos[::2], args.videos[1::2], strict=True):
        shape = Shape(args.frames, 480, 832)
        pair = read_at(generated, shape, 0, border=True), read_at(target, shape, 0)
        ours(alex, *(x[:TORCH_BATCH] for x in pair))
        theirs(*(x[:TORCH_BATCH] for x in pair))
        wall, cpu, values = timed(lambda pair=pair: ours(alex, *pair))
        other_wall, other_cpu, others = timed(lambda pair=pair: theirs(*pair))
        others |= reference_values(*pair)
        for name, gap in gaps.items():
            gaps[name] = max(gap, float(np.abs(values[name] - others[name]).max()))
        ratios.append((wall / other_wall, cpu / other_cpu))
        print(
            f"{generated.stem[:40]:40} {wall:6.1f} s, {cpu:6.1f} s of the processor; torch "
            f"{other_wall:6.1f} s, {other_cpu:6.1f} s; ratios {ratios[-1][0]:.2f}, "
            f"{ratios[-1][1]:.2f}",
            flush=True,
        )
    median = np.median(ratios, axis=0)
    print(f"{cores} cores, {len(ratios)} clips of {args.frames} frames: median ratio "
          f"{median[0]:.2f}, of the processor's time {median[1]:.2f}")  # fmt: skip
    print(
        "largest difference of a frame from scikit-image and eager torch: "
        f"PSNR {gaps['psnr']:.1e} dB, SSIM {gaps['ssim']:.1e}, LPIPS {gaps['lpips']:.1e}"
    )


if __name__ == "__main__":
    main()
