"""Scores of one simulator step against ground truth."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from egosim_jax.evaluation.metrics.depth import coverage, depth_error
from egosim_jax.evaluation.metrics.region import region_psnr
from egosim_jax.evaluation.metrics.report import score
from egosim_jax.evaluation.metrics.trajectory import camera_errors, estimate_cameras
from egosim_jax.types import Cameras, GroundTruth, View

MEASURES = {
    "psnr": ("PSNR dB", "{:.2f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "region_psnr": ("region PSNR dB", "{:.2f}"),
    "prior_psnr": ("PSNR of the view dB", "{:.2f}"),
    "depth_error": ("depth error %", "{:.2f}"),
    "camera_error": ("camera error mm", "{:.1f}"),
}
"""Heading and format of each measure."""
DEFINITIONS = {
    "psnr, ssim": "generated clip versus ground truth, without frame 0, as in evaluate",
    "region_psnr": "the same over the pixels where the ground truth shows a hand or the object "
    "acted on",
    "prior_psnr": "view of the state, copied, versus ground truth",
    "depth_error": "mean |depth - ground truth| / ground truth in percent: the state after the "
    "clip, seen from the clip's last camera, versus the ground-truth depth there, without hands",
    "depth_known": "share in percent of those pixels where the state after the clip has a point",
    "camera_error": "root mean square distance in mm between the cameras estimated from the "
    "generated frames (flow from the ground-truth frames, PnP with their depth) and the true ones",
    "camera_known": "share in percent of the frames whose camera was found, which camera_error "
    "averages",
}
"""Definition of each measure, for reports."""


def score_step(
    frames: UInt8[np.ndarray, "f h w 3"],
    ground_truth: GroundTruth,
    *,
    cameras: Cameras,
    before: View,
    after: View,
) -> dict[str, float]:
    """Return all measures that the ground truth allows: frames alone allow only PSNR and SSIM.

    `before` and `after` are views of the state before and after the step, along the clip's cameras.
    """
    video, target = frames[1:], ground_truth.frames[1:]
    scores = dict(score(video, target))
    ids, depth_m = ground_truth.object_ids, ground_truth.depth_m
    hands = np.zeros(frames.shape[:3], bool) if ids is None else ids < 0
    acted = hands if ids is None else hands | (ids == ground_truth.target_id)
    if ids is not None:
        scores["region_psnr"] = region_psnr(video, target, acted[1:])
    scores["prior_psnr"] = score(before.frames[1:], target)["psnr"]
    if depth_m is not None:
        last = np.zeros_like(hands)
        last[-1] = ~hands[-1]  # the state after the clip is compared with its last frame only
        path = estimate_cameras(frames, ground_truth.frames, depth_m, ~acted, cameras)
        scores["depth_error"] = depth_error(after.depth_m, depth_m, last)
        scores["depth_known"] = coverage(after.depth_m, last)
        located = np.isfinite(path).all(axis=(1, 2))
        scores["camera_known"] = 100 * float(located.mean())
        scores["camera_error"] = 1000 * camera_errors(path, cameras.world_from_camera)[0]
    return scores
