"""Estimates from raw video, and the Protocols of their estimators.

Networks and methods without weights satisfy the same Protocols, so the annotation of recorded
videos and the perception of generated clips share them. Videos are uint8 RGB; cameras have OpenCV
axes. An unknown value is NaN, infinite or None, never a guess.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, no_type_check, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from egosim_jax.types import Cameras
from egosim_jax.types.arrays import IdMaps, Masks, Video

LEFT, RIGHT = 0, 1
"""Index of a hand's side in `HandTracks`."""
Rung = Literal[
    "given", "network", "static", "incremental", "focal", "global", "rotation", "refused"
]
"""Method of a camera estimate: a rung of the ladder, best first, or `network`."""
ChosenRung = Literal["static", "incremental", "focal", "global", "rotation"]
"""Rung that a user can choose if the cameras are not known."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class HandTracks:
    """Hands of a video: at most one left and one right hand of the wearer in each frame."""

    joints_px: Float[np.ndarray, "f 2 21 2"]
    """Columns and rows of the 21 keypoints in pixels, left hand first; NaN where missing."""
    joints_hand_m: Float[np.ndarray, "f 2 21 3"]
    """Keypoints of a hand of mean size in meters, in camera axes, up to a translation."""
    presence: Float[np.ndarray, "f 2"]
    """Confidence from 0 to 1 that the hand is in the frame; 0 where it was not detected."""
    filled: Bool[np.ndarray, "f 2"] | None = None
    """True for hands interpolated between nearby frames; None if there are no such hands."""
    mirrored: Bool[np.ndarray, "f 2"] | None = None
    """True for hands whose joints look like the other side's; None if there are no such hands."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class SparsePoints:
    """Triangulated points of a scene and the pixels that observe them."""

    points_m: Float[np.ndarray, "p 3"]
    """World positions in the unit of the cameras (meters, or unknown)."""
    error_px: Float[np.ndarray, " p"]
    """Mean reprojection error of each point, in pixels."""
    frames: Int32[np.ndarray, " o"]
    """Frame of each observation."""
    indices: Int32[np.ndarray, " o"]
    """Point of each observation."""
    pixels_px: Float[np.ndarray, "o 2"]
    """Column and row of each observation, in pixels."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Decision about estimated cameras, with its evidence."""

    rung: Rung
    """Method whose result was accepted, or `refused`."""
    reason: str
    """Reason, for the report."""
    figures: Mapping[str, float]
    """Measured figures by name, such as the median triangulation angle in degrees."""


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Radial distortion of recorded frames: x (1 + `radial` r²), as COLMAP's SIMPLE_RADIAL."""

    focal_px: float
    """Focal length of the recorded frames in pixels; the principal point is the image center."""
    radial: float
    """Coefficient of r², the squared distance from the axis at depth 1."""


@dataclass(frozen=True, kw_only=True)
class CameraEstimate:
    """Cameras of a video, or the reason for their refusal."""

    cameras: Cameras | None
    """Camera of every frame; None if refused."""
    metric: bool
    """True if the unit is the meter; False if the scale is unknown."""
    verdict: Verdict
    points: SparsePoints | None = None
    """Triangulated points, if the method has any."""
    lens: Lens | None = None
    """Lens of the recorded frames, if it distorts them.

    `cameras` and `points` then describe undistorted frames (`cameras.lens.undistort`).
    """


@no_type_check
@dataclass(frozen=True, kw_only=True)
class DepthEstimate:
    """Depth of some frames of a video."""

    frames: Int32[np.ndarray, " k"]
    """Frame of each map."""
    depth_m: Float32[np.ndarray, "k h w"]
    """Depth along the camera's z axis, in the unit of the cameras; infinite where unknown."""
    confident: Bool[np.ndarray, "k h w"]
    """Measured pixels; the others are completed from them."""
    metric: bool
    """True if the depth is in meters whatever the cameras' unit, as from a metric network."""
    reason: str = ""
    """Method, for the report; it says if depth was assumed instead of measured."""

    @classmethod
    def measured(
        cls, frames: Sequence[int], depth_m: Float[np.ndarray, "k h w"], *, metric: bool
    ) -> DepthEstimate:
        """Return an estimate whose valid pixels (finite and positive) are all measured."""
        valid = np.isfinite(depth_m) & (depth_m > 0)
        return cls(
            frames=np.asarray(frames, np.int32),
            depth_m=np.where(valid, depth_m, np.inf).astype(np.float32),
            confident=valid,
            metric=metric,
        )


@runtime_checkable
class HandEstimator(Protocol):
    """Estimator of the wearer's hands."""

    def __call__(self, frames: Video) -> HandTracks:
        """Return the hands of a video."""
        ...


@runtime_checkable
class CameraEstimator(Protocol):
    """Estimator of camera poses and intrinsics."""

    def __call__(
        self, frames: Video, moving: Masks, *, focal_px: float | None = None
    ) -> CameraEstimate:
        """Return the cameras of a video. Pixels in `moving` (hands, arms) are ignored."""
        ...


@runtime_checkable
class DepthEstimator(Protocol):
    """Estimator of depth maps."""

    def __call__(
        self, frames: Video, moving: Masks, estimate: CameraEstimate, wanted: Sequence[int]
    ) -> DepthEstimate:
        """Return depth maps of the wanted frames, given estimated cameras."""
        ...


@runtime_checkable
class Segmenter(Protocol):
    """Segmentation and tracking of objects named by phrases."""

    def __call__(
        self, frames: Video, phrases: Sequence[str], hands: HandTracks | None = None
    ) -> tuple[IdMaps, Mapping[int, str]]:
        """Return the id of each pixel (0: none, negative: hands and arms) and each id's name."""
        ...


@runtime_checkable
class Captioner(Protocol):
    """Captioning of videos and naming of moved objects."""

    def __call__(self, frames: Video) -> tuple[str, tuple[str, ...]]:
        """Return the caption of a video and the names of its moved objects."""
        ...
