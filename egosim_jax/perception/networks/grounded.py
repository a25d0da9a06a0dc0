"""Segmentation by two networks: Grounding DINO finds what phrases name, a tracker follows it.

Detections are made in every so many frames. What no track covers yet becomes a new one, which is
followed from there forwards and backwards, so that an object that appears late is found, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Int32, UInt8

from egosim_jax.io.digest import fingerprint
from egosim_jax.perception.estimates import HandTracks
from egosim_jax.perception.networks.checkpoint import DType
from egosim_jax.perception.networks.grounding_dino import Detection, GroundingDino, box_iou
from egosim_jax.perception.networks.tracking import Box, EdgeTam, Sam2Tracker, Sam3Tracker, Tracker
from egosim_jax.state.filter import is_hand
from egosim_jax.types import check_counts

HAND_MARGIN = 0.25
"""Border around the keypoints of a hand, as a fraction of their extent."""


@dataclass(frozen=True, kw_only=True)
class _Track:
    """An object through a video."""

    phrase: str
    score: float
    mask: Bool[np.ndarray, "f h w"]

    def covers(self, frame: int, found: Detection, least: float) -> bool:
        """Return whether a detection in a frame is of this object, hand or not."""
        if is_hand(self.phrase) != is_hand(found.phrase) or not self.mask[frame].any():
            return False
        rows = np.flatnonzero(self.mask[frame].any(axis=1))
        columns = np.flatnonzero(self.mask[frame].any(axis=0))
        box = (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
        return box_iou(box, found.box_px) > least


@dataclass(frozen=True)
class Grounded:
    """Segmentation and tracking of what phrases name, by a detector and a tracker."""

    tracker_type: ClassVar[type[Tracker]]

    detector: Path
    """Folder of Grounding DINO."""
    segmenter: Path
    """Folder of the tracker, which segments what it follows."""
    _: KW_ONLY
    device: str = "auto"
    """Device of the workers: cpu, cuda, cuda:N, or auto for the first GPU if there is one."""
    dtype: DType = "float32"
    """Floating-point type of the networks."""
    timeout_s: float = 1800.0
    """Longest time of a network for one clip in seconds, with its loading."""
    every: int = 16
    """Objects are looked for in every so many frames."""
    threshold: float = 0.35
    """Least score of a detection."""
    same_overlap: float = 0.5
    """A detection belongs to a track whose box it overlaps more than this (IoU)."""

    def __post_init__(self) -> None:
        """Check both folders, and the number of frames."""
        check_counts({"every": self.every})
        self._networks  # noqa: B018 - made here, so that wrong folders are refused here

    @cached_property
    def _networks(self) -> tuple[GroundingDino, Tracker]:
        common = {"device": self.device, "dtype": self.dtype, "timeout_s": self.timeout_s}
        return (
            GroundingDino(self.detector, threshold=self.threshold, **common),
            self.tracker_type(self.segmenter, **common),
        )

    def check_installed(self) -> None:
        """Raise `InputError` naming the packages of the workers that are not installed."""
        for network in self._networks:
            network.check_installed()

    def fingerprint(self) -> str:
        """Return the hash of both networks and the parameters; the folders' paths are not in it."""
        parameters = (type(self).__name__, self.every, self.same_overlap)
        return fingerprint((parameters, *(n.fingerprint() for n in self._networks)))

    def __call__(
        self,
        frames: UInt8[np.ndarray, "f h w 3"],
        phrases: Sequence[str],
        hands: HandTracks | None = None,
    ) -> tuple[Int32[np.ndarray, "f h w"], Mapping[int, str]]:
        """Return instance ids and their names; those of phrases for hands and arms are negative.

        Known hands are followed also where the detector finds none. Where tracks overlap, the one
        of the larger score counts.
        """
        detector, tracker = self._networks
        keys = np.arange(0, len(frames), self.every)
        tracks: list[_Track] = []
        for frame, found in zip(keys.tolist(), detector(frames[keys], phrases), strict=True):
            known = [] if hands is None else list(_hand_detections(hands, frame, frames.shape[1:3]))
            new = self._new([*found, *known], tracks, frame)
            if new:
                labels = tracker(frames, frame, [one.box_px for one in new])
                tracks += [
                    _Track(phrase=one.phrase, score=one.score, mask=labels == number)
                    for number, one in enumerate(new, start=1)
                ]
        return _paint(tracks, frames.shape[:3])

    def _new(
        self, found: Sequence[Detection], tracks: Sequence[_Track], frame: int
    ) -> list[Detection]:
        """Return the detections in a frame that are of no track and of no better detection."""
        new: list[Detection] = []
        for one in found:
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
    """Yield the known hands of a frame as detections, with a border around their keypoints."""
    height, width = size
    for joints, presence in zip(hands.joints_px[frame], hands.presence[frame], strict=True):
        if np.isfinite(joints).all():
            border = HAND_MARGIN * np.ptp(joints, axis=0)
            low = np.clip(joints.min(axis=0) - border, 0, (width, height))
            high = np.clip(joints.max(axis=0) + border, 0, (width, height))
            if (high - low).min() >= 1:
                box: Box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
                yield Detection(phrase="hand", score=float(presence), box_px=box)


def _paint(
    tracks: Sequence[_Track], shape: tuple[int, ...]
) -> tuple[Int32[np.ndarray, "f h w"], dict[int, str]]:
    """Return ids and names of tracks, the best on top; hands and arms count down from -1."""
    ids, names = np.zeros(shape, np.int32), {}
    for track in sorted(tracks, key=lambda track: track.score):
        hands = sum(number < 0 for number in names)
        number = -1 - hands if is_hand(track.phrase) else 1 + len(names) - hands
        ids[track.mask] = number
        names[number] = track.phrase
    return ids, names
