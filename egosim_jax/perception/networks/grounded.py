"""Segmentation by two networks: Grounding DINO detects named objects, and a tracker follows them.

The detector runs at a fixed interval of frames. A detection that no track covers starts a new
track, which is followed forward and backward. So an object that appears late is also found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Bool

from egosim_jax.io.digest import fingerprint
from egosim_jax.perception.networks.checkpoint import DType
from egosim_jax.perception.networks.grounding_dino import Detection, GroundingDino
from egosim_jax.perception.networks.tracking import Box, EdgeTam, Sam2Tracker, Sam3Tracker, Tracker
from egosim_jax.perception.video.estimates import HandTracks
from egosim_jax.state.filter import box_iou, is_hand, mask_box
from egosim_jax.types import check_counts
from egosim_jax.types.arrays import IdMaps, Video

HAND_MARGIN = 0.25
"""Border around a hand's keypoints, as a fraction of their extent."""


@dataclass(frozen=True, kw_only=True)
class _Track:
    """An object through a video."""

    phrase: str
    score: float
    mask: Bool[np.ndarray, "f h w"]

    def covers(self, frame: int, detection: Detection, min_overlap: float) -> bool:
        """Return True if a detection in a frame is this object; a hand never matches an object."""
        if is_hand(self.phrase) != is_hand(detection.phrase) or not self.mask[frame].any():
            return False
        return box_iou(mask_box(self.mask[frame]), detection.box_px) > min_overlap


@dataclass(frozen=True)
class Grounded:
    """Segmentation and tracking of named objects by a detector and a tracker."""

    tracker_type: ClassVar[type[Tracker]]

    detector: Path
    """Folder of Grounding DINO."""
    segmenter: Path
    """Folder of the tracker, which also segments."""
    _: KW_ONLY
    device: str = "auto"
    """Device of the workers: cpu, cuda, cuda:N, or auto for the first GPU if there is one."""
    dtype: DType = "float32"
    """Floating-point type of the networks."""
    timeout_s: float = 1800.0
    """Timeout of each network for one clip in seconds, including its loading."""
    every: int = 16
    """Interval of frames between detections."""
    threshold: float = 0.35
    """Minimum score of a detection."""
    same_overlap: float = 0.5
    """Overlap (IoU) above which a detection belongs to a track."""

    def __post_init__(self) -> None:
        """Check both folders and the interval."""
        check_counts({"every": self.every})
        self._networks  # noqa: B018 - checks the folders

    @cached_property
    def _networks(self) -> tuple[GroundingDino, Tracker]:
        common = {"device": self.device, "dtype": self.dtype, "timeout_s": self.timeout_s}
        return (
            GroundingDino(self.detector, threshold=self.threshold, **common),
            self.tracker_type(self.segmenter, **common),
        )

    def check_installed(self) -> None:
        """Raise `InputError` with the missing packages of the workers."""
        for network in self._networks:
            network.check_installed()

    def fingerprint(self) -> str:
        """Return the hash of both networks and the parameters, without the folders' paths."""
        parameters = (type(self).__name__, self.every, self.same_overlap)
        return fingerprint((parameters, *(n.fingerprint() for n in self._networks)))

    def __call__(
        self, frames: Video, phrases: Sequence[str], hands: HandTracks | None = None
    ) -> tuple[IdMaps, Mapping[int, str]]:
        """Return instance ids and their names; ids of hands and arms are negative.

        Known hands are followed even if the detector misses them. Where tracks overlap, the higher
        score wins.
        """
        detector, tracker = self._networks
        keys = np.arange(0, len(frames), self.every)
        tracks: list[_Track] = []
        for frame, detections in zip(keys.tolist(), detector(frames[keys], phrases), strict=True):
            by_hands = (
                [] if hands is None else list(_hand_detections(hands, frame, frames.shape[1:3]))
            )
            new = self._new([*detections, *by_hands], tracks, frame)
            if new:
                labels = tracker(frames, frame, [one.box_px for one in new])
                tracks += [
                    _Track(phrase=one.phrase, score=one.score, mask=labels == number)
                    for number, one in enumerate(new, start=1)
                ]
        return _paint(tracks, frames.shape[:3])

    def _new(
        self, detections: Sequence[Detection], tracks: Sequence[_Track], frame: int
    ) -> list[Detection]:
        """Return a frame's detections that belong to no track and no better detection."""
        new: list[Detection] = []
        for one in detections:
            twice = any(
                is_hand(one.phrase) == is_hand(other.phrase)
                and box_iou(one.box_px, other.box_px) > self.same_overlap
                for other in new
            )
            if not twice and not any(t.covers(frame, one, self.same_overlap) for t in tracks):
                new.append(one)
        return new


@dataclass(frozen=True)
class GroundedSam3(Grounded):
    """Grounding DINO and the tracker of SAM 3; a `Segmenter`."""

    tracker_type: ClassVar[type[Tracker]] = Sam3Tracker


@dataclass(frozen=True)
class GroundedSam2(Grounded):
    """Grounding DINO and SAM 2; a `Segmenter`."""

    tracker_type: ClassVar[type[Tracker]] = Sam2Tracker


@dataclass(frozen=True)
class GroundedEdgeTam(Grounded):
    """Grounding DINO and EdgeTAM; a `Segmenter`."""

    tracker_type: ClassVar[type[Tracker]] = EdgeTam


def _hand_detections(hands: HandTracks, frame: int, size: tuple[int, ...]) -> Iterator[Detection]:
    """Yield the known hands of a frame as detections."""
    height, width = size
    for joints, presence in zip(hands.joints_px[frame], hands.presence[frame], strict=True):
        if np.isfinite(joints).all():
            border = HAND_MARGIN * np.ptp(joints, axis=0)
            low = np.clip(joints.min(axis=0) - border, 0, (width, height))
            high = np.clip(joints.max(axis=0) + border, 0, (width, height))
            if (high - low).min() >= 1:
                box: Box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
                yield Detection(phrase="hand", score=float(presence), box_px=box)


def _paint(tracks: Sequence[_Track], shape: tuple[int, ...]) -> tuple[IdMaps, dict[int, str]]:
    """Return ids and names of tracks, the best on top; ids of hands and arms are negative."""
    ids, names = np.zeros(shape, np.int32), {}
    for track in sorted(tracks, key=lambda track: track.score):
        hands = sum(number < 0 for number in names)
        number = -1 - hands if is_hand(track.phrase) else 1 + len(names) - hands
        ids[track.mask] = number
        names[number] = track.phrase
    return ids, names
