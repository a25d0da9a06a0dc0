"""Plane sweep: depth of a frame by correlation with other posed frames.

For each plane z = d of the reference camera, the homography K (R + t n^T / d) K^-1 warps the other
frames onto the reference. Small windows are compared by zero-mean normalized cross-correlation
(ZNCC). A pixel's depth is the plane with the best mean score over the better half of the views; the
other half may be occluded. Sources: Collins 1996; Kang, Szeliski, Chai 2001 (temporal selection of
views); Hosni et al. 2013 (guided filter of the costs).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32

from egosim_jax.geometry import invert
from egosim_jax.types import Cameras, Counted
from egosim_jax.types.arrays import Mask, Masks, RgbImage, Video

PARALLAX = 0.12
"""Best baseline of a view, in median depths."""
TURN = 0.35
"""Turn of a view in radians that costs as much as half or twice the best baseline."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class SweptFrame:
    """Result of a plane sweep in one frame, at the sweep's resolution."""

    inverse: Float32[np.ndarray, "h w"]
    """Inverse depth, in the inverse unit of the cameras."""
    score: Float32[np.ndarray, "h w"]
    """Correlation at that depth, from -1 to 1; -1 where no other frame shows the pixel."""
    confident: Bool[np.ndarray, "h w"]
    """Pixels whose depth is measured: correlated, textured and unambiguous."""


@dataclass(frozen=True, kw_only=True)
class PlaneSweep(Counted):
    """Parameters of a plane sweep."""

    planes: int = 72
    """Number of planes, evenly spaced in inverse depth."""
    views: int = 6
    """Number of other frames to compare a frame with."""
    window: int = 7
    """Side of the correlation window, in pixels of the sweep's resolution."""
    guide_radius: int = 4
    """Radius of the guided filter of the scores in pixels."""
    guide_epsilon: float = 1e-3
    """Regularization of the guided filter, in squared gray levels from 0 to 1."""
    min_score: float = 0.6
    """Minimum correlation of a confident pixel."""
    min_texture: float = 0.01
    """Minimum standard deviation of a confident pixel's window, in gray levels from 0 to 1."""
    second_peak: float = 0.02
    """Minimum lead in correlation over all planes more than three planes away."""

    def __call__(
        self,
        frames: Video,
        moving: Masks,
        cameras: Cameras,
        frame: int,
        views: list[int],
        inverse_range: tuple[float, float],
    ) -> SweptFrame:
        """Sweep planes between two inverse depths through a frame, and compare it with the views.

        All arrays are at the sweep's resolution.
        """
        gray, hidden = _gray(frames[frame]), moving[frame]
        others = [np.stack([_gray(frames[v]), ~moving[v]], axis=-1) for v in views]
        inverses = np.linspace(*inverse_range, self.planes)
        moments = _Moments.of(gray, self.window)
        scores = np.empty((self.planes, *gray.shape), np.float32)
        keep = (len(views) + 1) // 2
        for number, inverse in enumerate(inverses):
            each = np.stack(
                [
                    self._compare(moments, other, _homography(cameras, frame, view, inverse))
                    for other, view in zip(others, views, strict=True)
                ]
            )
            best = np.partition(each, len(views) - keep, axis=0)[len(views) - keep :]
            scores[number] = best.mean(axis=0)  # occluded views are in the worse half
        scores = guided_filter(gray, scores, self.guide_radius, self.guide_epsilon)
        return self._choose(scores, inverses, moments.deviation, hidden)

    def _compare(
        self, reference: _Moments, other: Float32[np.ndarray, "h w 2"], matrix: np.ndarray
    ) -> Float32[np.ndarray, "h w"]:
        """Return the correlation of a warped frame with the reference; -1 where it is hidden."""
        import cv2

        height, width = reference.gray.shape
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        warped, seen = cv2.split(cv2.warpPerspective(other, matrix, (width, height), flags=flags))
        score = reference.correlate(warped)
        # The homography mirrors the part of the plane behind the other camera into view.
        bottom = matrix[2] @ np.array([[0, width, 0, width], [0, 0, height, height], [1, 1, 1, 1]])
        if bottom.min() <= 0:
            rows, columns = np.mgrid[:height, :width]
            seen *= matrix[2, 0] * columns + matrix[2, 1] * rows + matrix[2, 2] > 0
        return np.where(seen > 0.99, score, np.float32(-1))

    def _choose(
        self,
        scores: Float32[np.ndarray, "d h w"],
        inverses: Float[np.ndarray, " d"],
        deviation: Float32[np.ndarray, "h w"],
        hidden: Mask,
    ) -> SweptFrame:
        """Return the best depth of each pixel, interpolated between planes by a parabola."""
        count = len(inverses)
        best = scores.argmax(axis=0)
        inner = np.clip(best, 1, count - 2)
        low, middle, high = (
            np.take_along_axis(scores, (inner + step)[None], axis=0)[0] for step in (-1, 0, 1)
        )
        curve = low - 2 * middle + high
        with np.errstate(divide="ignore", invalid="ignore"):
            offset = np.where(curve < -1e-6, 0.5 * (low - high) / curve, 0)
        place = np.where(best == inner, inner + np.clip(offset, -0.5, 0.5), best)
        score = scores.max(axis=0)
        planes = np.arange(count)[:, None, None]
        other = np.abs(planes - best) > 3
        second = np.where(other, scores, np.float32(-1)).max(axis=0)
        confident = (score > self.min_score) & (deviation > self.min_texture) & ~hidden
        confident &= (score - second > self.second_peak) & (best > 0) & (best < count - 1)
        step = inverses[1] - inverses[0]
        return SweptFrame(
            inverse=(inverses[0] + step * place).astype(np.float32),
            score=score,
            confident=confident,
        )


@dataclass(frozen=True, kw_only=True)
class _Moments:
    """Local mean and deviation of the reference frame."""

    gray: Float32[np.ndarray, "h w"]
    mean: Float32[np.ndarray, "h w"]
    deviation: Float32[np.ndarray, "h w"]
    window: int

    @classmethod
    def of(cls, gray: Float32[np.ndarray, "h w"], window: int) -> _Moments:
        mean = _mean(gray, window)
        variance = np.maximum(_mean(gray * gray, window) - mean * mean, 0)
        return cls(gray=gray, mean=mean, deviation=np.sqrt(variance), window=window)

    def correlate(self, other: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
        """Return the zero-mean normalized cross-correlation with another image."""
        mean = _mean(other, self.window)
        variance = np.maximum(_mean(other * other, self.window) - mean * mean, 0)
        covariance = _mean(other * self.gray, self.window) - mean * self.mean
        return covariance / (self.deviation * np.sqrt(variance) + np.float32(1e-5))


def choose_views(cameras: Cameras, frame: int, depth: float, views: int) -> list[int]:
    """Return the frames to compare a frame with, in temporal order.

    The best baseline is `PARALLAX` times the median depth. Half or twice as much costs the same as
    a turn by `TURN` radians. The chosen frames are spread over time, so a passing hand hides few.
    """
    poses = cameras.world_from_camera
    others = np.array([f for f in range(len(poses)) if f != frame])
    baseline = np.linalg.norm(poses[others, :3, 3] - poses[frame, :3, 3], axis=1) / depth
    turn = np.arccos(np.clip(poses[others, :3, 2] @ poses[frame, :3, 2], -1, 1))
    cost = np.abs(np.log2(np.maximum(baseline, 1e-6) / PARALLAX)) + turn / TURN
    best = np.sort(others[np.argsort(cost, kind="stable")[: 2 * views]])
    return best[np.linspace(0, len(best) - 1, min(views, len(best))).astype(int)].tolist()


def guided_filter(
    guide: Float32[np.ndarray, "h w"],
    images: Float32[np.ndarray, "n h w"],
    radius: int,
    epsilon: float,
) -> Float32[np.ndarray, "n h w"]:
    """Smooth images along the edges of a gray guide. Source: He, Sun, Tang 2010, equations 5-8."""
    side = 2 * radius + 1
    mean = _mean(guide, side)
    variance = _mean(guide * guide, side) - mean * mean + np.float32(epsilon)
    smooth = np.empty_like(images)
    for number, image in enumerate(images):
        average = _mean(image, side)
        slope = (_mean(guide * image, side) - mean * average) / variance
        smooth[number] = _mean(slope, side) * guide + _mean(average - slope * mean, side)
    return smooth


def _homography(cameras: Cameras, frame: int, view: int, inverse: float) -> np.ndarray:
    """Return the matrix from a frame's to a view's pixels by the plane z = 1 / `inverse`."""
    matrix = cameras.intrinsics_px
    motion = invert(cameras.world_from_camera[view]) @ cameras.world_from_camera[frame]
    plane = motion[:3, :3].copy()
    plane[:, 2] += inverse * motion[:3, 3]
    return matrix @ plane @ np.linalg.inv(matrix)


def _mean(image: Float32[np.ndarray, "h w"], side: int) -> Float32[np.ndarray, "h w"]:
    import cv2

    return cv2.boxFilter(image, cv2.CV_32F, (side, side), borderType=cv2.BORDER_REFLECT)


def _gray(image: RgbImage) -> Float32[np.ndarray, "h w"]:
    import cv2

    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255
