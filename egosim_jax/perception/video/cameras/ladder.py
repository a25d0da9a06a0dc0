"""Cameras of a recorded video by a ladder of methods. The first trusted result is accepted.

    static       the background does not move
    incremental  structure from motion, self-calibrated
    focal        the same with the focal length of the device
    global       global structure from motion
    rotation     the camera turns without moving, so there is no parallax
    refused      no method gives a trusted result; the verdict has the reasons

Structure from motion must always pass the gate (`gate.py`). The first camera is the world frame.
The unit is unknown; the median depth in the first frame is 1 if there are points.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, UInt8

from egosim_jax.perception.video.cameras.colmap import ColmapConfig, ColmapError, Scene, open_scene
from egosim_jax.perception.video.cameras.flow import (
    Background,
    Breaks,
    background,
    find_breaks,
    still_fraction,
)
from egosim_jax.perception.video.cameras.gate import GateConfig, measure, refusals
from egosim_jax.perception.video.cameras.path import complete_path, estimate_from, pinhole
from egosim_jax.perception.video.cameras.rotation import (
    Tracks,
    find_focal,
    follow_corners,
    solve_rotations,
)
from egosim_jax.perception.video.estimates import CameraEstimate, ChosenRung, Rung, Verdict
from egosim_jax.runtime.progress import track
from egosim_jax.types import Cameras, InputError, check_video
from egosim_jax.types.arrays import Masks, Poses, Video

ASSUMED_VIEW_DEG = 90.0
"""Assumed field of view if the focal length of a static or turning camera is unknown."""
_LADDER: tuple[Rung, ...] = ("static", "incremental", "focal", "global", "rotation")


@dataclass(frozen=True, kw_only=True)
class CameraLadder:
    """Estimator of cameras that tries methods from the most certain one down to refusal."""

    focal_px: float | None = None
    """Known focal length in pixels; it replaces self-calibration and the device's value."""
    rung: ChosenRung | None = None
    """Only method to try, or None for all. A static or turning camera is then assumed."""
    max_images: int = 240
    """Maximum number of matched frames; longer videos are subsampled by 2 to 6."""
    gate: GateConfig = field(default_factory=GateConfig)
    colmap: ColmapConfig = field(default_factory=ColmapConfig)

    def __call__(
        self, frames: Video, moving: Masks, *, focal_px: float | None = None
    ) -> CameraEstimate:
        """Return the cameras of a video. `focal_px` is the device's focal length, if known.

        Raises `InputError` for bad input, and if pycolmap is needed but not installed.
        """
        check_video("The video", frames)
        if moving.shape != frames.shape[:3] or moving.dtype != bool:
            raise InputError(
                f"The mask of moving pixels is {moving.dtype} {moving.shape}: it must be bool "
                f"{frames.shape[:3]}, like the video."
            )
        if self.rung == "focal" and self.focal_px is None and focal_px is None:
            raise InputError(
                "The rung focal needs a focal length, but it is unknown. Give one. (focal_px)"
            )
        for focal in (self.focal_px, focal_px):
            _check_focal(focal, frames)
        with ExitStack() as stack:
            return _Climb(self, frames, moving, focal_px, stack).run()


def _check_focal(focal_px: float | None, frames: np.ndarray) -> None:
    """Raise `InputError` for an implausible focal length."""
    if focal_px is None:
        return
    size = max(frames.shape[1:3])
    if not 0.1 * size <= focal_px <= 20 * size:
        raise InputError(
            f"A focal length of {focal_px:g} pixels is implausible for frames of "
            f"{frames.shape[2]} x {frames.shape[1]}: it must be {0.1 * size:g} to {20 * size:g}. "
            "Scale it to the size of the video. (focal_px)"
        )


@no_type_check
@dataclass
class _Climb:
    """One video's descent of the ladder, which collects figures and reasons."""

    config: CameraLadder
    frames: UInt8[np.ndarray, "f h w 3"]
    moving: Bool[np.ndarray, "f h w"]
    device_focal_px: float | None
    stack: ExitStack
    figures: dict[str, float] = field(default_factory=dict)
    reasons: list[str] = field(default_factory=list)

    def run(self) -> CameraEstimate:
        """Return the result of the first accepted rung."""
        if problem := self._unusable():
            self.reasons.append(problem)
            return self._refused()
        methods = {
            "static": self._static,
            "incremental": lambda: self._reconstruct("incremental"),
            "focal": lambda: self._reconstruct("focal"),
            "global": lambda: self._reconstruct("global"),
            "rotation": self._rotation,
        }
        rungs = [rung for rung in _LADDER if self.config.rung in (None, rung)]
        if self.config.rung is None and self.known_focal_px is not None:
            if self.config.focal_px is not None:
                rungs.remove("incremental")
        elif self.config.rung is None:
            rungs.remove("focal")
        for rung in track(rungs, "trying cameras", total=len(rungs)):
            if (estimate := methods[rung]()) is not None:
                return estimate
        return self._refused()

    @property
    def known_focal_px(self) -> float | None:
        """User's focal length, or else the device's."""
        return self.config.focal_px or self.device_focal_px

    @cached_property
    def video(self) -> Background:
        """Gray frames and masks at working size."""
        return background(self.frames, self.moving)

    @cached_property
    def breaks(self) -> Breaks:
        """Blank frames and cuts."""
        return find_breaks(self.video, bridge=self.config.gate.max_gap)

    @cached_property
    def scene(self) -> Scene:
        """Images with matched features. Raises `ColmapError`."""
        scene = self.stack.enter_context(
            open_scene(self.video, self._images(), config=self.config.colmap)
        )
        scene.match()
        return scene

    def _images(self) -> tuple[int, ...]:
        """Return the matched frames, which include the first and the last one."""
        last = len(self.frames) - 1
        number = min(last + 1, self.config.max_images)
        return tuple(int(i) for i in np.rint(np.linspace(0, last, number)))

    def _unusable(self) -> str | None:
        """Return the reason why no method can work, or None."""
        count = len(self.frames)
        blank, cuts = self.breaks.blank, self.breaks.cuts
        self.figures |= {"blank_frames": float(len(blank)), "cuts": float(len(cuts))}
        if self.breaks.survival:
            self.figures["tracked"] = float(np.median(self.breaks.survival))
        if cuts:
            shown = ", ".join(map(str, cuts[:5]))
            return (
                f"a cut: frame {shown} shares no background with the frames before it. Cut the "
                "video there"
            )
        if len(blank) > (1 - self.config.gate.min_registered) * count or 0 in blank:
            return (
                f"{len(blank)} of {count} frames, from frame {blank[0]} on, have too little "
                "texture outside of the hands: they are dark, blurred, blank or covered"
            )
        return None

    def _static(self) -> CameraEstimate | None:
        gate = self.config.gate
        forced = self.config.rung == "static"
        still, shift = still_fraction(
            self.video, max_shift_px=gate.max_shift_px, stop_below=0.0 if forced else gate.min_still
        )
        self.figures |= {"static_still": still, "static_shift_px": min(shift, 1e12)}
        reason = f"the background is where frame 0 has it in {still:.0%} of the frames"
        if forced or still >= gate.min_still:
            poses = np.tile(np.eye(4), (len(self.frames), 1, 1))
            return self._pinhole("static", poses, self._focal("static"), reason)
        return self._fail("static", "the background moves")

    def _reconstruct(self, rung: Rung) -> CameraEstimate | None:
        """Return a rung's reconstruction if it passes the gate."""
        if len(self.frames) < 3:
            return self._fail(rung, "it needs at least 3 frames")
        if len(self.frames) > (self.config.gate.max_gap + 1) * self.config.max_images:
            return self._fail(
                rung,
                f"{len(self.frames)} frames are too many to reconstruct: cut the video into clips "
                "first",
            )
        focal = None if rung == "incremental" else self.known_focal_px
        try:
            mapper = "global" if rung == "global" else "incremental"
            scene = self.scene.reconstruct(mapper, focal_px=focal)
        except ColmapError as error:
            return self._fail(rung, str(error))
        count, height, width = self.frames.shape[:3]
        figures = measure(
            scene, frames=count, images=len(self.scene.frames), height=height, width=width
        )
        self.figures |= {f"{rung}_{name}": value for name, value in figures.items()}
        if problems := refusals(figures, self.config.gate, calibrated=focal is not None):
            return self._fail(rung, ", ".join(problems))
        reason = (
            f"{figures['registered']:.0%} of the frames registered at an error of "
            f"{figures['error_px']:.2f} pixels, triangulation angle {figures['angle_deg']:.1f} "
            f"degrees, {count - len(scene.frames)} frames interpolated"
        )
        verdict = self._verdict(rung, reason)
        return estimate_from(scene, verdict, frames=count, height=height, width=width)

    def _rotation(self) -> CameraEstimate | None:
        gate = self.config.gate
        tracks = follow_corners(self.video, bridge=gate.max_gap)
        height, width = self.video.gray[0].shape
        focal = self._focal("rotation", tracks)
        intrinsics = pinhole(focal / self.video.reduction, height=height, width=width)
        solution = solve_rotations(tracks, intrinsics)
        tracked = np.flatnonzero(~np.isnan(solution.residual_px))
        residuals = solution.residual_px[tracked[1:]] if len(tracked) > 1 else np.zeros(1)
        residual, worst = np.percentile(residuals, [50, 90])
        self.figures |= {
            "rotation_tracked": len(tracked) / len(self.frames),
            "rotation_residual_px": float(residual),
            "rotation_worst_px": float(worst),
            "rotation_turn_deg": solution.turn_deg,
        }
        if tracked[-1] != len(self.frames) - 1:
            return self._fail("rotation", f"the background is lost after frame {tracked[-1]}")
        if self.config.rung is None and residual > gate.max_residual_px:
            return self._fail(
                "rotation",
                f"turning alone leaves {residual:.2f} pixels, above {gate.max_residual_px:g}",
            )
        poses = np.tile(np.eye(4), (len(tracked), 1, 1))
        poses[:, :3, :3] = solution.world_from_camera[tracked]
        poses = complete_path(tracked, poses, len(self.frames))
        reason = (
            f"the camera turns by {solution.turn_deg:.1f} degrees, "
            f"which leaves {residual:.2f} pixels"
        )
        return self._pinhole("rotation", poses, focal, reason)

    def _focal(self, rung: str, tracks: Tracks | None = None) -> float:
        """Return the known, estimated or assumed focal length; record the latter two."""
        if self.known_focal_px is not None:
            return self.known_focal_px
        if tracks is not None:
            height, width = self.video.gray[0].shape
            views = self.config.gate.min_view_deg, self.config.gate.max_view_deg
            lens = find_focal(tracks, height=height, width=width, views_deg=views)
            if lens is not None:
                self.figures[f"{rung}_focal_px"] = lens * self.video.reduction
                return lens * self.video.reduction
        self.figures[f"{rung}_assumed_view_deg"] = ASSUMED_VIEW_DEG
        half = np.radians(ASSUMED_VIEW_DEG / 2)
        return float(max(self.frames.shape[1:3]) / 2 / np.tan(half))

    def _pinhole(self, rung: Rung, poses: Poses, focal_px: float, reason: str) -> CameraEstimate:
        """Return an accepted estimate without points."""
        height, width = self.frames.shape[1:3]
        if f"{rung}_assumed_view_deg" in self.figures:
            reason += f"; the view is assumed to be {ASSUMED_VIEW_DEG:g} degrees wide"
        cameras = Cameras(
            world_from_camera=poses,
            intrinsics_px=pinhole(focal_px, height=height, width=width),
            height=height,
            width=width,
        )
        verdict = self._verdict(rung, reason)
        return CameraEstimate(cameras=cameras, metric=False, verdict=verdict)

    def _fail(self, rung: str, reason: str) -> None:
        """Record why a rung was rejected."""
        self.reasons.append(f"{rung}: {reason}")

    def _verdict(self, rung: Rung, reason: str) -> Verdict:
        """Return a verdict with the reasons of the earlier rungs."""
        return Verdict(rung=rung, reason="; ".join([reason, *self.reasons]), figures=self.figures)

    def _refused(self) -> CameraEstimate:
        verdict = Verdict(rung="refused", reason="; ".join(self.reasons), figures=self.figures)
        return CameraEstimate(cameras=None, metric=False, verdict=verdict)
