"""Measures that need an estimate from both videos: depth, cameras, hands, and regions.

EgoSim has not published the formulas of its depth and camera errors: all definitions here are ours.
Estimates of the ground truth are made once and shared by all methods.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from egosim_jax.data.windows import Window
from egosim_jax.evaluation.measures import Column, GroundTruth, Scorer
from egosim_jax.evaluation.methods import Shape, read_at
from egosim_jax.evaluation.metrics.depth import depth_error
from egosim_jax.evaluation.metrics.hands import hand_iou, hand_recall, keypoint_errors
from egosim_jax.evaluation.metrics.region import region_psnr
from egosim_jax.evaluation.metrics.trajectory import MIN_EXTENT, path_errors
from egosim_jax.io.digest import sha256
from egosim_jax.perception.estimates import (
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


@dataclass(frozen=True)
class Regions:
    """PSNR near the hands and, if there is a mask, of the manipulated object."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Headings by key."""
        return {
            "hand_psnr": Column("PSNR near hands dB", "{:.2f}", "higher"),
            "object_psnr": Column("PSNR of the object dB", "{:.2f}", "higher"),
        }

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definitions by key."""
        return {
            "hand_psnr": "dB over the pixels within 3 % of the width of the drawn hands, all "
            "frames of a clip together",
            "object_psnr": f"dB over the white pixels of {OBJECT_MASK}, all frames of a clip "
            "together",
        }

    def settings(self, window: Window) -> Any:
        """Return the parameters of the regions, and the hashes of their files."""
        files = [p for p in (window.files.hands, _object_mask(window)) if p.exists()]
        return DRAWN_LEVEL, REGION_MARGIN, [sha256(path) for path in files]

    def against(self, truth: GroundTruth) -> Scorer:
        """Return a function that computes both measures; NaN for a missing region."""
        regions = {"hand_psnr": hand_region(truth), "object_psnr": self._object(truth)}
        first = truth.first

        def score(video: np.ndarray) -> Mapping[str, float]:
            return {
                key: region_psnr(video[first:], truth.counted, region[first:])
                for key, region in regions.items()
            }

        return score

    def _object(self, truth: GroundTruth) -> Bool[np.ndarray, "f h w"]:
        path = _object_mask(truth.window)
        if not path.exists():
            return np.zeros(truth.frames.shape[:3], bool)
        return read_at(path, _shape(truth), truth.window.start).min(axis=-1) > 127


@dataclass(frozen=True, eq=False)
class DepthError:
    """Depth error between estimates of both videos."""

    estimator: DepthEstimator
    """Depth network."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Headings by key."""
        return {"depth_error": Column("depth error % (ours)", "{:.2f}", "lower")}

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definitions by key."""
        return {
            "depth_error": "ours; mean |depth - ground truth| / ground truth in percent over "
            f"{DEPTH_FRAMES} frames, both estimated by the depth network; depth of unknown scale "
            "is first multiplied by the ratio of the medians",
        }

    def settings(self, window: Window) -> Any:
        """Return the hash of the network."""
        return self.estimator, DEPTH_FRAMES

    def against(self, truth: GroundTruth) -> Scorer:
        """Return a function that estimates depth and compares it."""
        count = len(truth.counted)
        wanted = np.unique(np.linspace(0, count - 1, min(DEPTH_FRAMES, count)).astype(int)).tolist()
        target = self._estimate(truth.counted, wanted)
        known = np.isfinite(target.depth_m)

        def score(video: np.ndarray) -> Mapping[str, float]:
            found = self._estimate(video[truth.first :], wanted)
            depth_m = found.depth_m
            both = known & np.isfinite(depth_m)
            if not (found.metric and target.metric) and both.any():
                ratio = np.median(target.depth_m[both]) / np.median(depth_m[both])
                depth_m = (depth_m * ratio).astype(np.float32)
            return {"depth_error": depth_error(depth_m, target.depth_m, known)}

        return score

    def _estimate(self, frames: UInt8[np.ndarray, "f h w 3"], wanted: list[int]) -> Any:
        return self.estimator(frames, np.zeros(frames.shape[:3], bool), _UNKNOWN, wanted)


@dataclass(frozen=True, eq=False)
class CameraError:
    """Camera path errors between estimates of both videos."""

    estimator: CameraEstimator
    """Camera estimator, which needs no weights."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Headings by key."""
        return {
            "camera_rotation": Column("camera rotation ° (ours)", "{:.3f}", "lower"),
            "camera_error": Column("camera error (ours)", "{:.4f}", "lower"),
            "camera_ate": Column("camera ATE (ours)", "{:.4f}", "lower"),
        }

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definitions by key."""
        return {
            "camera_rotation": "ours; RMS angle between rotations since the first frame, both "
            "paths estimated from the videos without the pixels near hands",
            "camera_error": "ours; RMS distance between positions since the first frame, each path "
            "divided by its largest distance from there; not measured where the true camera stays "
            f"within {MIN_EXTENT:g} of it",
            "camera_ate": "ours; RMS distance between positions since the first frame after the "
            "least-squares scale, divided by the extent of the ground truth's path",
        }

    def settings(self, window: Window) -> Any:
        """Return the estimator's options, and the hash of the hands, which are ignored."""
        return self.estimator, DRAWN_LEVEL, REGION_MARGIN, sha256(window.files.hands)

    def against(self, truth: GroundTruth) -> Scorer:
        """Return a function that estimates cameras and compares them; NaN if it fails."""
        moving = hand_region(truth)
        wanted = self.estimator(truth.frames, moving).cameras

        def score(video: np.ndarray) -> Mapping[str, float]:
            found = None if wanted is None else self.estimator(video, moving).cameras
            if wanted is None or found is None:
                return dict.fromkeys(self.columns, NAN)
            target = wanted.world_from_camera.astype(float)
            errors = path_errors(found.world_from_camera.astype(float), target)
            extent = float(np.linalg.norm(target[:, :3, 3] - target[0, :3, 3], axis=1).max())
            return {
                "camera_rotation": errors.rotation_deg,
                "camera_error": errors.translation if extent > MIN_EXTENT else NAN,
                "camera_ate": errors.ate / extent if extent > MIN_EXTENT else NAN,
            }

        return score


@dataclass(frozen=True, eq=False)
class HandScores:
    """Agreement of the hands detected in both videos."""

    estimator: HandEstimator
    """Hand detector."""

    @property
    def columns(self) -> Mapping[str, Column]:
        """Headings by key."""
        return {
            "hand_iou": Column("hand IoU", "{:.3f}", "higher"),
            "keypoint_error": Column("keypoint error %", "{:.2f}", "lower"),
            "hand_recall": Column("hand recall", "{:.3f}", "higher"),
        }

    @property
    def definitions(self) -> Mapping[str, str]:
        """Definitions by key."""
        return {
            "hand_iou": "ours; IoU of the convex hulls of the keypoints detected in both videos, "
            "mean over frames with a hand in the ground truth",
            "keypoint_error": "ours; mean distance of the keypoints of hands detected in both "
            "videos, in percent of the width",
            "hand_recall": "ours; share of the hands detected in the ground truth that are "
            "detected in the video",
        }

    def settings(self, window: Window) -> Any:
        """Return the detector's options."""
        return self.estimator

    def against(self, truth: GroundTruth) -> Scorer:
        """Return a function that detects hands and compares them."""
        target = self.estimator(truth.counted).joints_px
        _, height, width, _ = truth.frames.shape

        def score(video: np.ndarray) -> Mapping[str, float]:
            found = self.estimator(video[truth.first :]).joints_px
            errors = keypoint_errors(found, target)
            return {
                "hand_iou": hand_iou(found, target, height=height, width=width),
                "keypoint_error": 100 * float(errors.mean()) / width if len(errors) else NAN,
                "hand_recall": hand_recall(found, target),
            }

        return score
