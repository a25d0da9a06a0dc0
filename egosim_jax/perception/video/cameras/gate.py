"""Gate that separates correct reconstructions from degenerate ones.

Registered frames and the reprojection error are not enough. Structure from motion can register all
frames of a camera that barely moves, at an error of one pixel, with depths over many orders of
magnitude. So the gate also checks that depths, angles, steps and lens are plausible for a
head-mounted or hand-held camera.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Int32

from egosim_jax.io.bounded import unlike

UNBOUNDED = 1e12
"""Upper limit of reported ratios, which may be infinite."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Reconstruction:
    """Cameras and points from structure from motion; pixel centers have integer coordinates."""

    frames: Int32[np.ndarray, " r"]
    """Registered frames, ascending."""
    camera_from_world: Float[np.ndarray, "r 3 4"]
    """Pose of each registered frame, in an unknown unit."""
    focal_px: float
    radial: float
    """Radial coefficient of the lens (`estimates.Lens`)."""
    points: Float[np.ndarray, "p 3"]
    """Triangulated points, in the same unit."""
    error_px: Float[np.ndarray, " p"]
    """Mean reprojection error of each point."""
    observed_in: Int32[np.ndarray, " o"]
    """Registered frame of each observation, as an index of `frames`."""
    observed: Int32[np.ndarray, " o"]
    """Point of each observation."""
    pixels_px: Float[np.ndarray, "o 2"]
    """Column and row of each observation in the recorded frame."""


@dataclass(frozen=True, kw_only=True)
class GateConfig:
    """Thresholds for accepting a rung of the ladder."""

    max_shift_px: float = 1.0
    """Maximum median shift of the background in a still frame, in pixels at working size."""
    min_still: float = 0.9
    """Minimum fraction of still frames of a static camera."""
    max_residual_px: float = 1.5
    """Maximum median residual of a camera that only turns, in pixels at working size."""

    max_depth_spread: float = 20.0
    """Maximum ratio of the 95th to the 5th percentile of depth."""
    max_radial: float = 0.1
    """Maximum absolute radial coefficient."""
    min_angle_deg: float = 1.0
    """Minimum median triangulation angle, in degrees."""
    max_step: float = 20.0
    """Maximum step between frames, in median steps."""
    min_view_deg: float = 50.0
    """Minimum self-calibrated field of view along the longer side, in degrees."""
    max_view_deg: float = 115.0
    """Maximum self-calibrated field of view along the longer side, in degrees."""
    min_registered: float = 0.9
    """Minimum fraction of registered frames."""
    max_gap: int = 5
    """Maximum number of consecutive unregistered frames; they are interpolated."""
    min_shared: int = 15
    """Minimum number of points that two neighboring registered frames share."""


def measure(
    scene: Reconstruction, *, frames: int, images: int, height: int, width: int
) -> dict[str, float]:
    """Return the figures that the gate compares with its thresholds.

    The reconstruction uses `images` of the `frames` of a video.
    """
    registered = len(scene.frames)
    figures = {
        "registered": registered / images,
        "points": float(len(scene.points)),
        "focal_px": scene.focal_px,
        "radial": scene.radial,
        "view_deg": float(np.degrees(2 * np.arctan2(max(height, width) / 2, scene.focal_px))),
        "gap": float(_longest_gap(scene.frames, frames)),
    }
    if registered < 2 or not len(scene.points):
        return figures
    rotation, offset = scene.camera_from_world[:, :, :3], scene.camera_from_world[:, :, 3]
    centers = -np.einsum("fji,fj->fi", rotation, offset)
    points, viewers = scene.points[scene.observed], scene.observed_in
    depth = np.einsum("oj,oj->o", rotation[viewers, 2], points) + offset[viewers, 2]
    near, far = np.percentile(depth, [5, 95])
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1) / np.diff(scene.frames)
    figures |= {
        "error_px": float(np.mean(scene.error_px)),
        "depth_spread": float(min(far / near, UNBOUNDED)) if near > 0 else UNBOUNDED,
        "angle_deg": float(np.median(_angles_deg(scene, centers))),
        "step": float(min(steps.max() / max(np.median(steps), 1e-12), UNBOUNDED)),
        "shared": float(_min_shared(scene)),
    }
    return figures


def refusals(
    figures: Mapping[str, float], config: GateConfig, *, calibrated: bool = False
) -> tuple[str, ...]:
    """Return the reasons why figures of `measure` fail the gate; empty if they pass.

    The field of view is not judged if the camera was `calibrated` by other means.
    """
    if "angle_deg" not in figures:
        return (f"only {figures['registered']:.0%} of the frames were registered",)
    rules = [
        (figures["registered"] >= config.min_registered,
         f"{unlike(100 * figures['registered'], 100 * config.min_registered, '.0f')}% of the "
         f"frames were registered, below {config.min_registered:.0%}"),
        (figures["gap"] <= config.max_gap,
         f"{figures['gap']:.0f} frames in a row, or at an end, were not registered"),
        (figures["depth_spread"] < config.max_depth_spread,
         f"depth spreads by a factor of "
         f"{unlike(figures['depth_spread'], config.max_depth_spread)}, above "
         f"{config.max_depth_spread:g}"),
        (abs(figures["radial"]) < config.max_radial,
         f"radial distortion is {unlike(figures['radial'], config.max_radial, '.2f')}, above "
         f"{config.max_radial:g}"),
        (figures["angle_deg"] > config.min_angle_deg,
         f"the median triangulation angle is "
         f"{unlike(figures['angle_deg'], config.min_angle_deg, '.2f')} degrees, below "
         f"{config.min_angle_deg:g}"),
        (figures["step"] < config.max_step,
         f"the longest step is {unlike(figures['step'], config.max_step)} median steps, above "
         f"{config.max_step:g}"),
        (calibrated or config.min_view_deg <= figures["view_deg"] <= config.max_view_deg,
         f"the view is {_beyond(figures['view_deg'], config)} degrees wide: it must be from "
         f"{config.min_view_deg:g} to {config.max_view_deg:g}"),
        (figures["shared"] >= config.min_shared,
         f"two neighboring frames share {figures['shared']:.0f} points, fewer than "
         f"{config.min_shared}"),
    ]  # fmt: skip
    return tuple(reason for passed, reason in rules if not passed)


def _beyond(view_deg: float, config: GateConfig) -> str:
    limits = config.min_view_deg, config.max_view_deg
    return unlike(view_deg, min(limits, key=lambda limit: abs(limit - view_deg)), ".0f")


def _longest_gap(registered: Int32[np.ndarray, " r"], frames: int) -> int:
    """Return the longest gap in frames; `frames` if the first or last one is missing."""
    if not len(registered) or registered[0] != 0 or registered[-1] != frames - 1:
        return frames
    return int(np.diff(registered).max(initial=1)) - 1


def _angles_deg(
    scene: Reconstruction, centers: Float[np.ndarray, "r 3"]
) -> Float[np.ndarray, " p"]:
    """Return the maximum angle between two rays to each point, in degrees."""
    rays = centers[scene.observed_in] - scene.points[scene.observed]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-300)
    order = np.argsort(scene.observed, kind="stable")
    ends = np.cumsum(np.bincount(scene.observed, minlength=len(scene.points)))
    groups = np.split(rays[order], ends[:-1])
    cosine = [float((group @ group.T).min()) if len(group) else 1.0 for group in groups]
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def _min_shared(scene: Reconstruction) -> int:
    """Return the minimum number of points shared by two neighboring registered frames."""
    seen = np.zeros((len(scene.frames), len(scene.points)), bool)
    seen[scene.observed_in, scene.observed] = True
    return int((seen[1:] & seen[:-1]).sum(axis=1).min())
