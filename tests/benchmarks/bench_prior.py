"""PSNR of priors that are made from real videos without network weights of depth or masks.

    python -m tests.benchmarks.bench_prior FOLDER [--clips NAME ...] [--sheets DIR]

FOLDER has dwm_triplets and real_clips. Each clip goes through the parts that annotation is made of:
hands, silhouettes, cameras, depth, scale, first frame without hands, state of the first frame, and
the prior along the cameras. The state has no colors of later frames but those under the hands of
the first. The prior is compared with the recorded video in frames 1 to n-1 at the pixels where a
point is drawn and the published video of hands, widened and prolonged to the lower border, shows no
hand; objects that were moved count as errors. PSNR is the mean over frames. Next to it: the first
frame repeated, at the same pixels. With `--estimates`, cameras of an earlier run are read from the
folder or written to it. Sheets show prior, video and three times their difference.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from egosim_jax import rendering
from egosim_jax.data.sheet import SheetClip, draw_sheet
from egosim_jax.evaluation.metrics.image import decibels
from egosim_jax.perception.cameras import CameraLadder, undistort, undistort_pixels
from egosim_jax.perception.depth import SweptDepth, points_per_pixel
from egosim_jax.perception.hands import LandmarkHands, lift
from egosim_jax.perception.plate import clean_plate
from egosim_jax.perception.scale import estimate_scale, scale_cameras, scale_depth
from egosim_jax.perception.silhouettes import track_silhouettes
from egosim_jax.state.depth import state_from_depth
from tests.benchmarks.bench_cameras import CLIPS, load


@dataclass(frozen=True)
class Goal:
    """Least PSNR and seen share of a clip's prior."""

    psnr: float
    seen: float


GOALS = {"declutter": Goal(29, 0.85), "00017": Goal(23, 0.90), "00039": Goal(22, 0.70)}


def main(
    folder: tyro.conf.Positional[Path],
    clips: tuple[str, ...] = tuple(GOALS),
    sheets: Annotated[Path | None, tyro.conf.arg(help="Folder for contact sheets.")] = None,
) -> None:
    """Make the prior of each clip and compare it with the video.

    Args:
        folder: With the real clips.
        clips: Names of those to run.
    """
    for name in clips:
        frames, hands = load(folder, CLIPS[name])
        measure(name, frames, hands, sheets)


def measure(name: str, frames: np.ndarray, hands: np.ndarray, sheets: Path | None) -> None:
    """Print a clip's figures. `hands` are the pixels that are not compared."""
    times = [time.monotonic()]
    tracks = LandmarkHands()(frames)
    moving = track_silhouettes(frames, tracks)
    times.append(time.monotonic())
    estimate = CameraLadder()(frames, moving)
    if estimate.cameras is None:
        print(f"{name}: cameras refused: {estimate.verdict.reason}")
        return
    frames, moving, hands = (undistort(x, estimate) for x in (frames, moving, hands))
    tracks = replace(tracks, joints_px=undistort_pixels(tracks.joints_px, estimate))
    times.append(time.monotonic())
    depth = SweptDepth()(frames, moving, estimate, [0])
    times.append(time.monotonic())
    joints = lift(tracks, estimate.cameras.intrinsics_px)
    scale = estimate_scale(estimate, depth, joints, moving)
    cameras = scale_cameras(estimate, scale).cameras
    depth_m = scale_depth(depth, scale).depth_m[0]
    plate = clean_plate(frames, moving, cameras, depth_m)
    state = state_from_depth(
        plate.image,
        depth_m,
        cameras.intrinsics_px,
        cameras.world_from_camera[0],
        points_per_pixel=points_per_pixel(depth_m, cameras),
    )
    view = rendering.get("jax").render(state, cameras, point_px=2)
    times.append(time.monotonic())
    compared = np.isfinite(view.depth_m) & ~hands
    repeated = np.broadcast_to(frames[0], frames.shape)
    prior, first = (masked_psnr(video, frames, compared) for video in (view.frames, repeated))
    goal, seen = GOALS[name], float((view.mask[1:] == 0).mean())
    reached = prior >= goal.psnr and seen >= goal.seen
    spent = ", ".join(f"{s:.0f}" for s in np.diff(times))
    print(
        f"{name} ({estimate.verdict.rung}): prior {prior:.2f} dB, first frame repeated "
        f"{first:.2f} dB, seen {seen:.3f}, {'reached' if reached else 'NOT REACHED'}\n"
        f"  measured {depth.confident.mean():.1%} of the depth; median {np.median(depth_m):.2f} m "
        f"+- {scale.uncertainty:.0%} by {scale.source}: {scale.reason}\n"
        f"  {moving[0].sum()} pixels of hands in the first frame, {plate.seen.sum()} seen later\n"
        f"  seconds for hands, cameras, depth, scale to prior: {spent}",
        flush=True,
    )
    if sheets is not None:
        error = 3 * np.abs(view.frames.astype(int) - frames) * compared[..., None]
        videos = [view.frames, frames, np.minimum(error, 255).astype(np.uint8)]
        moments = np.linspace(1, len(frames) - 1, 5).astype(int).tolist()
        draw_sheet([SheetClip(name, videos)], sheets / f"{name}.png", moments=moments, width=400)


def masked_psnr(video: np.ndarray, reference: np.ndarray, compared: np.ndarray) -> float:
    """Return the mean PSNR in dB of frames 1 to n-1 that have any of some pixels, at those."""
    errors = [
        np.square(a[kept].astype(np.float32) - b[kept]).mean()
        for a, b, kept in zip(video[1:], reference[1:], compared[1:], strict=True)
        if kept.any()
    ]
    return float(decibels(np.array(errors)).mean())


if __name__ == "__main__":
    tyro.cli(main)
