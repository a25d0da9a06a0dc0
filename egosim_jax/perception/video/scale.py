"""Scale of estimated cameras in meters per unit, with its source and uncertainty.

Structure from motion by one camera has an unknown unit. Hands give the scale: the mean size of a
hand gives its depth in meters, and a hand in view is in front of the scene or touches it. So
z_hand / z_scene, over fingertips and frames, is at most the scale, and near it at contact. The
estimate is the 90th percentile of that ratio, because errors exceed the maximum.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from egosim_jax.geometry import invert, pixel_rays, pixels_of, transform
from egosim_jax.perception.video.estimates import CameraEstimate, DepthEstimate
from egosim_jax.rendering.reference import splat
from egosim_jax.state.planes import fit_plane
from egosim_jax.types import Cameras, InputError
from egosim_jax.types.arrays import DepthMap, DepthMaps, Masks

Source = Literal["given", "cameras", "camera height", "metric depth", "hands", "median depth"]
"""Origin of a scale, from the most to the least certain."""
FINGERTIPS = (4, 8, 12, 16, 20)
"""Keypoints of the tips of thumb, index, middle, ring and little finger."""
CONTACT_PERCENTILE = 90
"""Percentile of z_hand / z_scene that counts as contact."""
HAND_SIZE_ERROR = 0.1
"""Relative standard deviation of the size of human hands around their mean."""
ASSUMED_MEDIAN_M = 0.6
"""Assumed median depth in meters if there is no source of scale."""
ASSUMED_ERROR = 0.5
"""Relative uncertainty of a scale from the assumed median depth."""
MIN_TIPS = 20
"""Minimum number of samples (fingertips or pixels) for a scale."""
MAX_DEPTH_RATIO = 3.0
"""Maximum ratio of measured depth to a hand's distance: units of depth differ by 4, 5 or 10."""
REDUCTION = 2
"""Downscaling factor of the scene's depth for the comparison with fingertips."""


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Meters per unit of cameras and depth."""

    meters_per_unit: float
    """Factor from camera units to meters, for positions and depths."""
    uncertainty: float
    """Relative standard deviation of the factor."""
    source: Source
    """Origin of the scale."""
    reason: str
    """Explanation for the report."""

    def __post_init__(self) -> None:
        """Check that the scale is positive and finite."""
        if not (np.isfinite(self.meters_per_unit) and self.meters_per_unit > 0):
            raise InputError(
                f"The scale is {self.meters_per_unit:.4g} m per unit: it must be positive and "
                "finite. Give another. (--scale)"
            )


def estimate_scale(
    estimate: CameraEstimate,
    depth: DepthEstimate,
    joints_camera_m: Float[np.ndarray, "f n 21 3"] | None = None,
    moving: Masks | None = None,
    *,
    meters_per_unit: float | None = None,
    camera_height_m: float | None = None,
    metric_depth: DepthEstimate | None = None,
) -> Scale:
    """Return the scale of estimated cameras from the best available source.

    The sources in order of preference:

    1. the given `meters_per_unit`
    2. metric cameras
    3. the camera's height above the surface in the lower half of the first frame
    4. a metric depth map of some of the same frames
    5. hands: `joints_camera_m` has their joints in meters in the camera of each frame
    6. an assumed median depth; `source` and `uncertainty` report the assumption

    Pixels in `moving` do not count as scene.
    """
    if meters_per_unit is not None:
        return Scale(
            meters_per_unit=meters_per_unit, uncertainty=0.0, source="given", reason="given"
        )
    cameras = estimate.cameras
    if cameras is None:
        raise InputError(
            "Refused cameras have no scale: it needs estimated cameras. Give cameras, or another "
            f"clip. Reason of the refusal: {estimate.verdict.reason}"
        )
    if estimate.metric:
        return Scale(
            meters_per_unit=1.0, uncertainty=0.0, source="cameras", reason="cameras are in meters"
        )
    scene = _without(depth, moving)
    if camera_height_m is not None:
        return _from_height(cameras, scene, camera_height_m)
    if metric_depth is not None:
        return _from_depth(scene, metric_depth)
    depths = scene.depth_m[np.isfinite(scene.depth_m)]
    _require(depths.size > 0, "all depth is unknown")
    if joints_camera_m is not None:
        by_hands = _from_hands(cameras, scene, joints_camera_m)
        if by_hands is not None:
            return by_hands
    return Scale(
        meters_per_unit=ASSUMED_MEDIAN_M / float(np.median(depths)),
        uncertainty=ASSUMED_ERROR,
        source="median depth",
        reason=f"assumed: no hand, camera height or metric depth gives the scale, so the median "
        f"depth is set to {ASSUMED_MEDIAN_M} m",
    )


def contact_scale(
    cameras: Cameras,
    depth_m: DepthMap,
    object_ids: Int[np.ndarray, "h w"],
    joints_camera_m: Float[np.ndarray, "f n 21 3"],
    contacts: Int[np.ndarray, "c 3"],
) -> Scale | None:
    """Return the scale at which fingertips touch the objects that they begin to move.

    `depth_m` and `object_ids` are the first frame's. A contact has frame, hand and object. Return
    None with too few fingertips.
    """
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    ratios: list[float] = []
    for frame, hand, number in contacts.tolist():
        shown = (object_ids == number) & np.isfinite(depth_m)
        if shown.any():
            center = np.median(rays[shown] * depth_m[shown][:, None], axis=0)
            world = transform(cameras.world_from_camera[0], center[None])
            local = transform(invert(cameras.world_from_camera[frame]), world)[0]
            ratios += (joints_camera_m[frame, hand, FINGERTIPS, 2] / local[2]).tolist()
    finite = np.array(ratios)[np.isfinite(ratios)] if ratios else np.zeros(0)
    if len(finite) < len(FINGERTIPS):
        return None
    low, middle, high = np.percentile(finite, (16, 50, 84))
    return Scale(
        meters_per_unit=float(middle),
        uncertainty=float(np.hypot(HAND_SIZE_ERROR, (high - low) / 2 / middle)),
        source="hands",
        reason=f"median of {len(finite)} fingertips at objects that they begin to move",
    )


def check_depth_unit(
    cameras: Cameras,
    depth_m: Float[np.ndarray, "f h w"],
    joints_camera_m: Float[np.ndarray, "f n j 3"],
) -> None:
    """Raise `InputError` if measured depth contradicts the distance of hands.

    A hand is before the scene or touches it somewhere, so some joints have about their own depth.
    """
    joints = joints_camera_m.reshape(len(depth_m), -1, 3)
    row, column, inside = pixels_of(cameras, np.where(np.isfinite(joints), joints, -1.0))
    behind = depth_m[np.arange(len(depth_m))[:, None], row, column]
    seen = inside & np.isfinite(behind) & (behind > 0)
    ratios = behind[seen] / joints[..., 2][seen]
    if len(ratios) < MIN_TIPS:
        return
    low, middle, high = np.percentile(
        ratios, (100 - CONTACT_PERCENTILE, 50, CONTACT_PERCENTILE)
    ).tolist()
    if low > MAX_DEPTH_RATIO or high < 1 / MAX_DEPTH_RATIO:
        raise InputError(
            f"the measured depth at the hands is {middle:.3g} times their own distance of "
            f"{np.median(joints[..., 2][seen]):.2g} m: they must be of one unit, the meter."
        )


def scale_cameras(estimate: CameraEstimate, scale: Scale) -> CameraEstimate:
    """Return cameras and sparse points in meters."""
    cameras, factor = estimate.cameras, scale.meters_per_unit
    if cameras is None:
        return estimate
    poses = cameras.world_from_camera.copy()
    poses[:, :3, 3] *= factor
    points = estimate.points
    return replace(
        estimate,
        cameras=replace(cameras, world_from_camera=poses),
        points=points and replace(points, points_m=points.points_m * factor),
        metric=True,
    )


def scale_depth(depth: DepthEstimate, scale: Scale) -> DepthEstimate:
    """Return depth in meters. Metric depth is returned unchanged."""
    if depth.metric:
        return depth
    depth_m = (depth.depth_m * scale.meters_per_unit).astype(np.float32)
    return replace(depth, depth_m=depth_m, metric=True)


def _from_hands(
    cameras: Cameras, scene: DepthEstimate, joints_camera_m: Float[np.ndarray, "f n 21 3"]
) -> Scale | None:
    """Return the scale at which hands touch the scene; None with too few fingertips."""
    small, depth = _scene_depth(cameras, scene)
    tips = joints_camera_m[:, :, FINGERTIPS].reshape(len(joints_camera_m), -1, 3)
    row, column, inside = pixels_of(small, np.where(np.isfinite(tips), tips, -1.0))
    behind = np.take_along_axis(depth.reshape(len(depth), -1), row * small.width + column, axis=1)
    ratios = (tips[..., 2] / behind)[inside & np.isfinite(behind)]
    if len(ratios) < MIN_TIPS:
        return None
    low, middle, high = np.percentile(
        ratios, (CONTACT_PERCENTILE - 5, CONTACT_PERCENTILE, CONTACT_PERCENTILE + 5)
    )
    spread = (high - low) / 2 / middle
    return Scale(
        meters_per_unit=float(middle),
        uncertainty=float(np.hypot(HAND_SIZE_ERROR, spread)),
        source="hands",
        reason=f"{len(ratios)} fingertips before the scene, in contact at the "
        f"{CONTACT_PERCENTILE}th percentile of their depth ratios; percentiles "
        f"{CONTACT_PERCENTILE - 5} and {CONTACT_PERCENTILE + 5} differ from it by "
        f"{(low / middle - 1):+.1%} and {(high / middle - 1):+.1%}",
    )


def _scene_depth(cameras: Cameras, scene: DepthEstimate) -> tuple[Cameras, DepthMaps]:
    """Return downscaled cameras, and the depth of the static scene that each of them sees."""
    step = REDUCTION
    matrix = cameras.intrinsics_px.astype(float).copy()
    matrix[:2] /= step
    small = replace(
        cameras,
        intrinsics_px=matrix,
        height=-(-cameras.height // step),
        width=-(-cameras.width // step),
    )
    points = []
    rays = pixel_rays(matrix, height=small.height, width=small.width)
    for frame, depth in zip(scene.frames, scene.depth_m, strict=True):
        sampled = depth[::step, ::step]
        finite = np.isfinite(sampled)
        local = rays[finite] * sampled[finite][:, None]
        points.append(transform(cameras.world_from_camera[frame], local))
    unit = np.median(scene.depth_m[np.isfinite(scene.depth_m)])  # within the renderer's range
    poses = small.world_from_camera.copy()
    poses[:, :3, 3] /= unit
    poses, view = np.unique(poses, axis=0, return_inverse=True)  # one view of a still camera
    depth, _ = splat(
        np.concatenate(points) / unit, replace(small, world_from_camera=poses), point_px=1
    )
    return small, (depth * np.float32(unit))[view.reshape(-1)]


def _from_height(cameras: Cameras, scene: DepthEstimate, height_m: float) -> Scale:
    """Return the scale that puts the first camera at a height above the surface below it."""
    first, frame = scene.depth_m[0], int(scene.frames[0])
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    lower = np.isfinite(first)
    lower[: cameras.height // 2] = False
    points = (rays[lower] * first[lower][:, None])[:: max(1, lower.sum() // 20_000)]
    _require(len(points) >= 100, "the lower half of the first frame has no depth")
    plane, inliers = fit_plane(points, 0.02 * float(np.median(points[:, 2])))
    distance, share = abs(float(plane[3])), len(inliers) / len(points)
    _require(distance > 0, "the plane in the lower half of the first frame meets the camera")
    return Scale(
        meters_per_unit=height_m / distance,
        uncertainty=float(np.std(points[inliers] @ plane[:3]) / distance),
        source="camera height",
        reason=f"camera {height_m:g} m above the plane of {share:.0%} of the lower half of "
        f"frame {frame}",
    )


def _from_depth(scene: DepthEstimate, metric: DepthEstimate) -> Scale:
    """Return the median ratio of a metric depth map to the depth of the scene."""
    ratios = [
        (metric.depth_m[list(metric.frames).index(frame)] / depth)[confident]
        for frame, depth, confident in zip(
            scene.frames, scene.depth_m, scene.confident, strict=True
        )
        if frame in metric.frames
    ]
    all_ratios = np.concatenate([*ratios, np.zeros(0)])
    all_ratios = all_ratios[np.isfinite(all_ratios) & (all_ratios > 0)]
    _require(len(all_ratios) >= MIN_TIPS, "no confident pixel of the scene has metric depth")
    middle = np.median(all_ratios)
    spread = 1.4826 * np.median(np.abs(all_ratios - middle)) / middle
    return Scale(
        meters_per_unit=float(middle),
        uncertainty=float(spread),
        source="metric depth",
        reason=f"median over {len(all_ratios)} confident pixels with metric depth",
    )


def _without(depth: DepthEstimate, moving: Masks | None) -> DepthEstimate:
    """Return depth without moving pixels."""
    if moving is None:
        return depth
    hidden = moving[depth.frames]
    return replace(
        depth,
        depth_m=np.where(hidden, np.float32(np.inf), depth.depth_m),
        confident=depth.confident & ~hidden,
    )


def _require(fits: bool, problem: str) -> None:
    if not fits:
        raise InputError(
            f"The scale cannot be estimated: {problem}. Give meters per unit. (--scale)"
        )
