"""Stub estimators for tests, and videos that they annotate quickly."""

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from egosim_jax.annotate.config import AnnotateConfig, Estimators
from egosim_jax.io.writing import write_video
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimate, HandTracks, Verdict
from tests.scenes import pinhole

FOCAL = 50.0
DEPTH = 2.0
FINGERS = np.arange(1, 21).reshape(5, 4)


def mean_hand() -> np.ndarray:
    """Return 21 joints of an open hand in meters, fingers upward, around the wrist."""
    joints = np.zeros((21, 3))
    for finger, ids in enumerate(FINGERS):
        angle = np.radians(25 * (finger - 2))
        direction = np.array([np.sin(angle), -np.cos(angle), 0])
        joints[ids] = direction * np.linspace(0.08, 0.17, 4)[:, None]
    return joints


@dataclass(frozen=True)
class StubHands:
    """One right hand in the middle of the frames up to `stop`."""

    stop: float
    log: Path | None

    def __call__(self, frames):
        note(self.log, "hands")
        count, height, width, _ = frames.shape
        hand = mean_hand()
        pixels = FOCAL * hand[:, :2] / 0.5 + [(width - 1) / 2, (height - 1) / 2]
        shown = np.arange(count) < self.stop * count
        joints_px = np.full((count, 2, 21, 2), np.nan)
        joints_px[shown, 1] = pixels
        joints_hand_m = np.full((count, 2, 21, 3), np.nan)
        joints_hand_m[shown, 1] = hand
        presence = np.zeros((count, 2))
        presence[shown, 1] = 0.9
        return HandTracks(joints_px=joints_px, joints_hand_m=joints_hand_m, presence=presence)


@dataclass(frozen=True)
class StubCameras:
    """A fixed camera, or no camera: always, or in dark videos without a focal length."""

    refuse: bool
    log: Path | None
    refuse_dark: bool = False

    def __call__(self, frames, moving, *, focal_px=None):
        note(self.log, "cameras")
        count, height, width, _ = frames.shape
        dark = self.refuse_dark and focal_px is None and frames.mean() < 100
        if self.refuse or dark:
            verdict = Verdict(rung="refused", reason="nothing to see", figures={"registered": 0.1})
            return CameraEstimate(cameras=None, metric=False, verdict=verdict)
        focal = FOCAL if focal_px is None else focal_px
        cameras = pinhole(count, focal, height, width)
        rung = "incremental" if self.refuse_dark else "static"
        verdict = Verdict(rung=rung, reason="still", figures={"still": 1.0})
        return CameraEstimate(cameras=cameras, metric=False, verdict=verdict)


@dataclass(frozen=True)
class StubDepth:
    """A wall across the view."""

    log: Path | None

    def __call__(self, frames, moving, estimate, wanted):
        note(self.log, "depth")
        shape = (len(wanted), *frames.shape[1:3])
        return DepthEstimate(
            frames=np.array(wanted, np.int32),
            depth_m=np.full(shape, DEPTH, np.float32),
            confident=np.ones(shape, bool),
            metric=False,
        )


@dataclass(frozen=True)
class StubSegmenter:
    """A hand on the left, and a cup on the right."""

    log: Path | None

    def __call__(self, frames, phrases, hands=None):
        note(self.log, "+".join(phrases))
        ids = np.zeros(frames.shape[:3], np.int32)
        ids[:, 10:20, 10:20] = -1
        ids[:, 10:20, 60:70] = 5
        return ids, {-1: "hand", 5: "cup"}


@dataclass(frozen=True, kw_only=True)
class StubConfig(AnnotateConfig):
    """Configuration whose estimators are stubs; `log` has a line per call."""

    hands_until: float = 1.0
    refuse: bool = False
    refuse_dark: bool = False
    segment: bool = False
    log: Path | None = None

    def build(self) -> Estimators:
        """Return the stubs."""
        return Estimators(
            hands=StubHands(self.hands_until, self.log),
            cameras=StubCameras(self.refuse, self.log, self.refuse_dark),
            depth=StubDepth(self.log),
            segmenter=StubSegmenter(self.log) if self.segment else None,
        )


def note(log, name):
    if log is not None:
        with log.open("a") as file:
            file.write(f"{name}\n")


def textured_video(frames=17, height=48, width=80, *, seed=0, shift=1.0):
    """Return a video of a sharp random texture that moves by `shift` pixels per frame."""
    rng = np.random.default_rng(seed)
    margin = int(np.ceil(abs(shift) * frames)) + 4
    texture = rng.integers(40, 216, (height, width + margin, 3), np.uint8)
    texture = cv2.GaussianBlur(texture, (0, 0), 1.2)
    texture = cv2.normalize(texture, None, 40, 215, cv2.NORM_MINMAX)
    moved = []
    for frame in range(frames):
        matrix = np.array([[1, 0, -shift * frame], [0, 1, 0]], np.float32)
        moved.append(cv2.warpAffine(texture, matrix, (width, height), flags=cv2.INTER_LINEAR))
    return np.stack(moved)


def write(path, frames, fps=16):
    """Write a video and return its path."""
    write_video(path, frames, fps)
    return path


def config(**changes):
    """Return a stub configuration with the NumPy renderer."""
    return replace(StubConfig(renderer="numpy"), **changes)
