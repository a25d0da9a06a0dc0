"""Measures that need an estimate from both videos: depth, cameras, hands, and regions.

EgoSim has not published the formulas of its depth and camera errors: all definitions here are ours.
Estimates of the ground truth are made once and shared by all methods.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from egosim_jax.data.windows import Window
from egosim_jax.evaluation.measures import Column, GroundTruth, Measure, Scorer
from egosim_jax.evaluation.methods import Shape, read_at
from egosim_jax.evaluation.metrics.depth import depth_error
from egosim_jax.evaluation.metrics.hands import hand_iou, hand_recall, keypoint_errors
from egosim_jax.evaluation.metrics.region import region_psnr
from egosim_jax.evaluation.metrics.trajectory import MIN_EXTENT, path_errors
from egosim_jax.io.digest import sha256
from egosim_jax.perception.video.estimates import (
    CameraEstimate,
    CameraEstimator,
    DepthEstimator,
    HandEstimator,
    Verdict,
)

NAN = float("nan")
DEPTH_FRAMES = 8
"""Number of evenly spaced frames whose depth is compared."""
DRAWN_LEVEL = 32
"""Minimum level of a drawn pixel in the hand video; lower levels are compression noise."""
REGION_MARGIN = 0.03
"""Margin around the drawn hands as a fraction of the width."""
OBJECT_MASK = "object_mask_video.mp4"
"""Optional video next to the prior, white on the manipulated object."""
_UNKNOWN = CameraEstimate(
    cameras=None, metric=False, verdict=Verdict(rung="refused", reason="not estimated", figures={})
)


def hand_region(truth: GroundTruth) -> Bool[np.ndarray, "f h w"]:
    """Return the pixels near the hands drawn in the conditions."""
    import cv2

    drawn = read_at(truth.window.files.hands, _shape(truth), truth.window.start).max(axis=-1)
    size = 2 * round(REGION_MARGIN * drawn.shape[2]) + 1
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    near = [cv2.dilate((frame >= DRAWN_LEVEL).astype(np.uint8), disk) for frame in drawn]
    return np.stack(near) > 0


def _shape(truth: GroundTruth) -> Shape:
    frames, height, width = truth.frames.shape[:3]
    return Shape(frames, height, width, truth.crop)


def _object_mask(window: Window) -> Path:
    return window.files.prior.parent / OBJECT_MASK


def regions() -> Measure:
    """Return the PSNR near the hands and, if there is a mask, of the manipulated object."""

    def settings(window: Window) -> Any:
        files = [p for p in (window.files.hands, _object_mask(window)) if p.exists()]
        return DRAWN_LEVEL, REGION_MARGIN, [sha256(path) for path in files]

    def against(truth: GroundTruth) -> Scorer:
        masks = {"hand_psnr": hand_region(truth), "object_psnr": _object_region(truth)}
        first = truth.first
        return lambda video: {
            key: region_psnr(video[first:], truth.counted, mask[first:])
            for key, mask in masks.items()
        }

    columns = {
        "hand_psnr": Column(
            "PSNR near hands dB",
            "{:.2f}",
            "higher",
            "dB over the pixels within 3 % of the width of the drawn hands, all frames of a clip "
            "together",
        ),
        "object_psnr": Column(
            "PSNR of the object dB",
            "{:.2f}",
            "higher",
            f"dB over the white pixels of {OBJECT_MASK}, all frames of a clip together",
        ),
    }
    return Measure(name="Regions", columns=columns, against=against, settings=settings)


def _object_region(truth: GroundTruth) -> Bool[np.ndarray, "f h w"]:
    path = _object_mask(truth.window)
    if not path.exists():
        return np.zeros(truth.frames.shape[:3], bool)
    return read_at(path, _shape(truth), truth.window.start).min(axis=-1) > 127


def depth(estimator: DepthEstimator) -> Measure:
    """Return the depth error between estimates of both videos by a network."""

    def against(truth: GroundTruth) -> Scorer:
        count = len(truth.counted)
        wanted = np.unique(np.linspace(0, count - 1, min(DEPTH_FRAMES, count)).astype(int)).tolist()

        def estimate(frames: UInt8[np.ndarray, "f h w 3"]) -> Any:
            return estimator(frames, np.zeros(frames.shape[:3], bool), _UNKNOWN, wanted)

        target = estimate(truth.counted)
        valid = np.isfinite(target.depth_m)

        def score(video: np.ndarray) -> Mapping[str, float]:
            estimated = estimate(video[truth.first :])
            depth_m = estimated.depth_m
            both = valid & np.isfinite(depth_m)
            if not (estimated.metric and target.metric) and both.any():
                ratio = np.median(target.depth_m[both]) / np.median(depth_m[both])
                depth_m = (depth_m * ratio).astype(np.float32)
            return {"depth_error": depth_error(depth_m, target.depth_m, valid)}

        return score

    column = Column(
        "depth error % (ours)",
        "{:.2f}",
        "lower",
        "ours; mean |depth - ground truth| / ground truth in percent over "
        f"{DEPTH_FRAMES} frames, both estimated by the depth network; depth of unknown scale "
        "is first multiplied by the ratio of the medians",
    )
    return Measure(
        name="DepthError",
        columns={"depth_error": column},
        against=against,
        settings=lambda _: (estimator, DEPTH_FRAMES),
    )


def cameras(estimator: CameraEstimator) -> Measure:
    """Return the errors between the camera paths estimated from both videos; NaN if one fails."""
    columns = {
        "camera_rotation": Column(
            "camera rotation ° (ours)",
            "{:.3f}",
            "lower",
            "ours; RMS angle between rotations since the first frame, both paths estimated from "
            "the videos without the pixels near hands",
        ),
        "camera_error": Column(
            "camera error (ours)",
            "{:.4f}",
            "lower",
            "ours; RMS distance between positions relative to the first frame, each path divided "
            f"by its extent; not measured if the ground truth's is at most {MIN_EXTENT:g}",
        ),
        "camera_ate": Column(
            "camera ATE (ours)",
            "{:.4f}",
            "lower",
            "ours; RMS distance between positions since the first frame after the least-squares "
            "scale, divided by the extent of the ground truth's path; not measured where the "
            "camera error is not",
        ),
    }

    def against(truth: GroundTruth) -> Scorer:
        moving = hand_region(truth)
        true_cameras = estimator(truth.frames, moving).cameras

        def score(video: np.ndarray) -> Mapping[str, float]:
            estimated = None if true_cameras is None else estimator(video, moving).cameras
            if true_cameras is None or estimated is None:
                return dict.fromkeys(columns, NAN)
            target = true_cameras.world_from_camera.astype(float)
            errors = path_errors(estimated.world_from_camera.astype(float), target)
            extent = float(np.linalg.norm(target[:, :3, 3] - target[0, :3, 3], axis=1).max())
            return {
                "camera_rotation": errors.rotation_deg,
                "camera_error": errors.translation if extent > MIN_EXTENT else NAN,
                "camera_ate": errors.ate / extent if extent > MIN_EXTENT else NAN,
            }

        return score

    def settings(window: Window) -> Any:
        return estimator, DRAWN_LEVEL, REGION_MARGIN, sha256(window.files.hands)

    return Measure(name="CameraError", columns=columns, against=against, settings=settings)


def hands(estimator: HandEstimator) -> Measure:
    """Return the agreement of the hands detected in both videos."""

    def against(truth: GroundTruth) -> Scorer:
        target = estimator(truth.counted).joints_px
        _, height, width, _ = truth.frames.shape

        def score(video: np.ndarray) -> Mapping[str, float]:
            joints_px = estimator(video[truth.first :]).joints_px
            errors = keypoint_errors(joints_px, target)
            return {
                "hand_iou": hand_iou(joints_px, target, height=height, width=width),
                "keypoint_error": 100 * float(errors.mean()) / width if len(errors) else NAN,
                "hand_recall": hand_recall(joints_px, target),
            }

        return score

    columns = {
        "hand_iou": Column(
            "hand IoU",
            "{:.3f}",
            "higher",
            "ours; IoU of the convex hulls of the keypoints detected in both videos, mean over "
            "frames with a hand in the ground truth",
        ),
        "keypoint_error": Column(
            "keypoint error %",
            "{:.2f}",
            "lower",
            "ours; mean distance of the keypoints of hands detected in both videos, in percent of "
            "the width",
        ),
        "hand_recall": Column(
            "hand recall",
            "{:.3f}",
            "higher",
            "ours; share of the hands detected in the ground truth that are detected in the video",
        ),
    }
    return Measure(
        name="HandScores", columns=columns, against=against, settings=lambda _: estimator
    )
