"""Estimator of hands by MediaPipe's networks, with tracking over the video."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from egosim_jax.perception.video.estimates import LEFT, RIGHT, HandTracks
from egosim_jax.perception.video.hands.detect import Candidates, find_candidates, find_other_side
from egosim_jax.perception.video.hands.litert import HandNetworks, fetch_weights
from egosim_jax.perception.video.hands.track import (
    TrackConfig,
    choose_tracks,
    fill_gaps,
    find_gaps,
    smooth,
    smoothing,
)
from egosim_jax.types import check_video
from egosim_jax.types.arrays import Video

SKIN_RGB = (224, 172, 140)
"""Color for painting the luminance, to detect hands in gloves."""


@dataclass(frozen=True, kw_only=True)
class LandmarkHands:
    """Estimator of hands (`estimates.HandEstimator`) by palm detection and landmarks."""

    weights: Path | None = None
    """Folder of the two tflite files; None for the user's cache, downloaded on first use."""
    offline: bool = False
    """True to raise an error instead of downloading weights."""
    threads: int = 2
    """Number of threads of each network on the CPU."""
    min_palm: float = 0.3
    """Minimum confidence of a detected palm."""
    min_presence: float = 0.4
    """Minimum confidence of the landmark network in the presence of a hand."""
    same_hand: float = 0.4
    """Distance in hand sizes below which two detections in a frame are one hand."""
    gloves: bool = True
    """True to search frames without a hand again, painted in skin color."""
    min_gloved: float = 0.7
    """Minimum confidence of the landmark network in a painted frame."""
    max_side: int = 1280
    """Maximum side of a searched frame in pixels; larger frames are downscaled."""
    max_gap: int = 3
    """Maximum length of an interpolated gap in frames; `filled` marks its frames."""
    tracking: TrackConfig = field(default_factory=TrackConfig)
    networks: HandNetworks | None = None
    """Loaded networks; None to load them from `weights`."""

    def __call__(self, frames: Video) -> HandTracks:
        """Return the hands of a video."""
        check_video("The video", frames)
        smaller, scale = _shrunk(frames, self.max_side)
        tracks = self.tracks(self.candidates(smaller), len(frames))
        return replace(tracks, joints_px=(tracks.joints_px + 0.5) / scale - 0.5)

    def candidates(self, frames: Video) -> Candidates:
        """Return the possible hands of all frames, searched at the frames' size.

        Frames without a hand are searched again for gloves. A tracked hand whose joints look like
        the other side's is searched again for its own side.
        """
        search = partial(
            find_candidates,
            networks=self._networks,
            min_palm=self.min_palm,
            min_presence=self.min_presence,
            same_hand=self.same_hand,
        )
        candidates = search(frames)
        if (
            self.gloves
            and (empty := np.all(self._choose(candidates, len(frames)) < 0, axis=1)).any()
        ):
            gloved = search(paint_skin(frames), wanted=empty)
            candidates = candidates.join(gloved.take(gloved.presence >= self.min_gloved))
        path = self._choose(candidates, len(frames))
        for side in (LEFT, RIGHT):
            hands = candidates.take(path[path[:, side] >= 0, side])
            other = find_other_side(
                frames,
                self._networks,
                hands.take(hands.seems_right != (side == RIGHT)),
                right=side == RIGHT,
                min_presence=self.min_presence,
                same_hand=self.same_hand / 2,
            )
            candidates = candidates.join(other)
        return candidates.take(np.argsort(candidates.frame, kind="stable"))

    def tracks(self, candidates: Candidates, frames: int) -> HandTracks:
        """Return the best tracks among the candidates of a video."""
        path = self._choose(candidates, frames)
        return _as_tracks(
            candidates, path, max_gap=self.max_gap, max_motion=self.tracking.max_motion
        )

    @cached_property
    def _networks(self) -> HandNetworks:
        if self.networks is not None:
            return self.networks
        palms, landmarks = fetch_weights(self.weights, offline=self.offline)
        return HandNetworks(palms, landmarks, threads=self.threads)

    def _choose(self, candidates: Candidates, frames: int) -> np.ndarray:
        return choose_tracks(candidates, frames, self.tracking, same_hand=self.same_hand)


def _shrunk(frames: np.ndarray, max_side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return frames of at most `max_side`, and the scales of their columns and rows."""
    height, width = frames.shape[1:3]
    factor = min(1.0, max_side / max(height, width))
    if factor == 1:
        return frames, np.ones(2)
    size = max(round(width * factor), 1), max(round(height * factor), 1)
    smaller = np.stack([cv2.resize(f, size, interpolation=cv2.INTER_AREA) for f in frames])
    return smaller, np.array(size) / [width, height]


def paint_skin(frames: Video) -> Video:
    """Return frames with their luminance in skin color."""
    gray = np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames])
    table = np.round(np.arange(256)[:, None] * np.array(SKIN_RGB) / max(SKIN_RGB)).astype(np.uint8)
    return table[gray]


def _as_tracks(
    candidates: Candidates, path: np.ndarray, *, max_gap: int, max_motion: float
) -> HandTracks:
    """Return the chosen candidates, smoothed, with short gaps filled; NaN where missing."""
    there = path >= 0

    def along_path(values: np.ndarray, missing: Any) -> np.ndarray:
        result = np.full((*path.shape, *values.shape[1:]), missing)
        result[there] = values[path[there]]
        return result

    joints_px = along_path(candidates.joints_px, np.nan)
    joints_hand_m = along_path(candidates.joints_hand_m, np.nan)
    gaps = find_gaps(joints_px, max_gap=max_gap, max_motion=max_motion)
    joints_px = fill_gaps(joints_px, gaps)
    weights = smoothing(joints_px, max_motion=max_motion / 2)
    right = np.arange(2) == RIGHT
    return HandTracks(
        joints_px=smooth(joints_px, weights),
        joints_hand_m=smooth(fill_gaps(joints_hand_m, gaps), weights),
        presence=along_path(candidates.presence, 0.0),
        filled=gaps,
        mirrored=along_path(candidates.seems_right, right) != right,
    )
