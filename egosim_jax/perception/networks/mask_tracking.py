"""Motion of objects with known masks, from features tracked inside the masks.

The object's pose in the first frame is the state's, so each feature has a 3D point. Features are
tracked by optical flow with a forward-backward check (Lucas and Kanade, 1981). Robust least squares
from the previous pose fits each frame's pose to the features' pixels and known depths. New features
replace lost ones; their 3D points come from the object in its pose of that frame. `pose_refinement`
refines the last pose.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32, UInt8

from egosim_jax.geometry import cameras_in_object_frame, invert, project, transform
from egosim_jax.perception.object_models import ObjectModels, Support
from egosim_jax.perception.pipeline import Observation
from egosim_jax.perception.pose_refinement import (
    ColorCost,
    ObjectModel,
    ObjectMotion,
    Refinement,
    refine_pose,
)
from egosim_jax.rendering.reference import splat
from egosim_jax.types import Action, Cameras, Clip, InputError, SceneState, check_counts

ROUNDS = 8
"""Number of Gauss-Newton steps; each one updates the outliers."""


@dataclass(frozen=True, kw_only=True)
class TrackMasks:
    """Stage that sets the motions and supporting planes of the state's objects."""

    min_motion_px: float = 2.0
    """Minimum median motion of a moved object's points in the image, in pixels."""
    min_features: int = 8
    """Minimum number of features for a pose; with fewer, the last pose is kept."""
    max_features: int = 200
    """Maximum number of features of an object."""
    refill_frames: int = 4
    """Interval in frames at which new features are added."""
    max_error_px: float = 1.5
    """Maximum reprojection error and forward-backward error of a feature, in pixels."""
    depth_error: float = 0.02
    """Relative depth error with the same cost as one pixel."""
    point_px: int = 2
    """Size of the object's rendered points, in pixels."""
    support: Support = field(default_factory=Support)
    """Fit of the supporting planes."""
    color: ColorCost = field(default_factory=ColorCost)
    """Comparison of the clip's colors with the predicted colors."""
    refinement: Refinement = field(default_factory=Refinement)
    """Refinement of each object's last pose."""

    def __post_init__(self) -> None:
        """Check that the numbers and the depth error are positive."""
        names = ("min_features", "max_features", "refill_frames", "point_px")
        check_counts({name: getattr(self, name) for name in names})
        if not self.depth_error > 0:
            raise InputError(f"depth_error must be positive, not {self.depth_error}.")

    def __call__(
        self, clip: Clip, action: Action, state: SceneState, so_far: Observation
    ) -> Observation:
        """Set `motions` and `support_planes` of moved objects."""
        cameras, ids, depth = (
            so_far.require(name, "TrackMasks") for name in ("cameras", "object_ids", "depth_m")
        )
        gray = gray_frames(clip.frames)
        known = set(np.unique(state.object_ids[state.object_ids > 0]).tolist())
        motions, planes = {}, {}
        models = ObjectModels(state, cameras.world_from_camera[0], self.support)
        for number in sorted(known & set(np.unique(ids).tolist())):
            points = state.points_m[state.object_ids == number].astype(float)
            path = self.follow(points, gray, ids == number, depth, cameras)
            moving = _moving_frames(points, path, cameras, self.min_motion_px)
            if moving.any():
                model = models.of(number)
                motions[number] = self._refine(model, path, moving, clip, cameras, state, ids)
                planes[number] = model.plane
        return replace(so_far, motions=motions, support_planes=planes)

    def follow(
        self,
        points_m: Float[np.ndarray, "n 3"],
        gray: UInt8[np.ndarray, "f h w"],
        mask: Bool[np.ndarray, "f h w"],
        depth_m: Float32[np.ndarray, "f h w"],
        cameras: Cameras,
    ) -> Float[np.ndarray, "f 4 4"]:
        """Return the motion of an object in each frame, relative to the first frame.

        Depth that is not finite is unknown.
        """
        path = np.repeat(np.eye(4)[None], len(gray), axis=0)
        pixels, places = np.zeros((0, 2), np.float32), np.zeros((0, 3))
        for frame in range(1, len(gray)):
            before = frame - 1
            if before % self.refill_frames == 0 or len(pixels) < self.min_features:
                new = self._features(points_m, gray, mask, cameras, path, before, pixels)
                pixels = np.concatenate([pixels, new[0]])
                places = np.concatenate([places, new[1]])
            pixels, kept = flow(gray[before], gray[frame], pixels, self.max_error_px)
            kept &= _inside(mask[frame], pixels)
            pixels, places = pixels[kept], places[kept]
            guess = invert(cameras.world_from_camera[frame]) @ path[before]
            column, row = np.rint(pixels).astype(int).T
            pose, inliers = self._pose(
                places, pixels, depth_m[frame, row, column], guess, cameras.intrinsics_px
            )
            path[frame] = path[before]
            if pose is not None:
                path[frame] = cameras.world_from_camera[frame] @ pose
                pixels, places = pixels[inliers], places[inliers]
        return path

    def _features(
        self,
        points_m: Float[np.ndarray, "n 3"],
        gray: UInt8[np.ndarray, "f h w"],
        mask: Bool[np.ndarray, "f h w"],
        cameras: Cameras,
        path: Float[np.ndarray, "f 4 4"],
        frame: int,
        old: Float32[np.ndarray, "k 2"],
    ) -> tuple[Float32[np.ndarray, "m 2"], Float[np.ndarray, "m 3"]]:
        """Return new features of a frame: pixels, and points of the object in its first pose."""
        import cv2

        here = replace(cameras, world_from_camera=cameras.world_from_camera[[frame]])
        local = cameras_in_object_frame(here, path[[frame]])
        depth, index = splat(points_m, local, point_px=self.point_px)
        free = (mask[frame] & (index[0] >= 0)).astype(np.uint8)
        free = cv2.erode(free, np.ones((3, 3), np.uint8))  # the outline moves with the background
        for column, row in np.rint(old).astype(int).tolist():
            cv2.circle(free, (column, row), 2, 0, -1)
        found = cv2.goodFeaturesToTrack(
            gray[frame], max(1, self.max_features - len(old)), 0.01, 3, mask=free, blockSize=3
        )
        if found is None or len(old) >= self.max_features:
            return np.zeros((0, 2), np.float32), np.zeros((0, 3))
        pixels = found[:, 0]
        column, row = np.rint(pixels).astype(int).T
        lens = cameras.intrinsics_px
        rays = (pixels - lens[:2, 2]) / np.diag(lens)[:2]  # subpixel, unlike the looked-up depth
        seen = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
        seen *= depth[0, row, column][:, None]
        return pixels, transform(local.world_from_camera[0], seen)

    def _pose(
        self,
        places_m: Float[np.ndarray, "k 3"],
        pixels: Float32[np.ndarray, "k 2"],
        depth_m: Float[np.ndarray, " k"],
        guess: Float[np.ndarray, "4 4"],
        lens: Float[np.ndarray, "3 3"],
    ) -> tuple[Float[np.ndarray, "4 4"] | None, Bool[np.ndarray, " k"]]:
        """Return the pose (camera from the first pose) and its inliers; None with few inliers.

        Gauss-Newton starts at the last pose, because a flat object has a second pose with almost
        the same image. An outlier's error is above both the median and `max_error_px`.
        """
        min_inliers = max(self.min_features, 4)
        pose, inliers = guess, np.ones(len(pixels), bool)
        gaps = np.zeros(len(pixels))
        for _ in range(ROUNDS):
            if inliers.sum() < min_inliers:
                return None, inliers
            local = transform(pose, places_m)
            errors, slopes = _residuals(local, pixels, depth_m, self.depth_error, lens)
            step = np.linalg.lstsq(
                slopes[inliers].reshape(-1, 6), -errors[inliers].reshape(-1), rcond=None
            )[0]
            pose = _small_motion(step) @ pose
            local = transform(pose, places_m)
            errors, _ = _residuals(local, pixels, depth_m, self.depth_error, lens)
            gaps = np.linalg.norm(errors[:, :2], axis=1)
            inliers = (gaps <= max(self.max_error_px, float(np.median(gaps)))) & (local[:, 2] > 0)
        inliers &= gaps <= self.max_error_px
        return (pose, inliers) if inliers.sum() >= min_inliers else (None, inliers)

    def _refine(
        self,
        model: ObjectModel,
        path: Float[np.ndarray, "f 4 4"],
        moving: Bool[np.ndarray, " f"],
        clip: Clip,
        cameras: Cameras,
        state: SceneState,
        ids: Int32[np.ndarray, "f h w"],
    ) -> Float[np.ndarray, "f 4 4"]:
        """Return the path with a refined last pose, if the last frames can be compared."""
        first, last = (int(f) for f in np.flatnonzero(moving)[[0, -1]])
        grasped = max(0, first - 1)
        motion = ObjectMotion(
            model=model, grasped=grasped, released=max(last, grasped + 1), path=path
        )
        shown = clip.frames.astype(np.float32)
        hidden = ids < 0
        return refine_pose(motion, cameras, state, shown, hidden, self.refinement, self.color).path


def _residuals(
    local_m: Float[np.ndarray, "k 3"],
    pixels: Float32[np.ndarray, "k 2"],
    depth_m: Float[np.ndarray, " k"],
    depth_error: float,
    lens: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 6"]]:
    """Return the errors of column, row and depth in pixels, and their Jacobian.

    The Jacobian's columns are a small rotation vector and a translation in camera axes. The error
    of an unknown depth is 0.
    """
    x, y = local_m[:, 0], local_m[:, 1]
    z = np.maximum(local_m[:, 2], 1e-3)
    u, v = project(lens, np.stack([x, y, z], axis=1))
    known = np.isfinite(depth_m)
    weight = known / (depth_error * z)
    along = weight * (z - np.where(known, depth_m, z))
    errors = np.stack([u - pixels[:, 0], v - pixels[:, 1], along], axis=1)
    zero, (fx, fy) = np.zeros_like(z), np.diag(lens)[:2]
    image = np.stack(
        [
            np.stack([fx / z, zero, -fx * x / z**2], axis=1),
            np.stack([zero, fy / z, -fy * y / z**2], axis=1),
            np.stack([zero, zero, weight], axis=1),
        ],
        axis=1,
    )
    turning = np.stack(  # of each point, by a rotation about x, y and z
        [
            np.stack([zero, -z, y], axis=1),
            np.stack([z, zero, -x], axis=1),
            np.stack([-y, x, zero], axis=1),
        ],
        axis=2,
    )
    return errors, np.concatenate([image @ turning, image], axis=2)


def _small_motion(step: Float[np.ndarray, " 6"]) -> Float[np.ndarray, "4 4"]:
    """Return the transform of a rotation vector and a translation."""
    import cv2

    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = cv2.Rodrigues(step[:3])[0], step[3:]
    return motion


def gray_frames(frames: UInt8[np.ndarray, "f h w 3"]) -> UInt8[np.ndarray, "f h w"]:
    """Return the luminance of a video."""
    import cv2

    return np.stack([cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in frames])


def flow(
    before: UInt8[np.ndarray, "h w"],
    after: UInt8[np.ndarray, "h w"],
    pixels: Float32[np.ndarray, "k 2"],
    max_error_px: float,
) -> tuple[Float32[np.ndarray, "k 2"], Bool[np.ndarray, " k"]]:
    """Return the places of pixels in the next frame, and True where backward flow agrees."""
    import cv2

    if not len(pixels):
        return pixels, np.zeros(0, bool)
    options: Any = {"winSize": (11, 11), "maxLevel": 3, "nextPts": None}
    moved, found, _ = cv2.calcOpticalFlowPyrLK(before, after, pixels[:, None], **options)
    back, returned, _ = cv2.calcOpticalFlowPyrLK(after, before, moved, **options)
    error = np.linalg.norm(back[:, 0] - pixels, axis=1)
    good = (found[:, 0] == 1) & (returned[:, 0] == 1) & (error <= max_error_px)
    return moved[:, 0], good


def _inside(
    mask: Bool[np.ndarray, "h w"], pixels: Float32[np.ndarray, "k 2"]
) -> Bool[np.ndarray, " k"]:
    column, row = np.rint(pixels).astype(int).T
    height, width = mask.shape
    within = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    within[within] = mask[row[within], column[within]]
    return within


def _moving_frames(
    points_m: Float[np.ndarray, "n 3"],
    path: Float[np.ndarray, "f 4 4"],
    cameras: Cameras,
    min_motion_px: float,
) -> Bool[np.ndarray, " f"]:
    """Return True for frames with an object between its first and last place in the image.

    All False if it ends where it began.
    """
    some = points_m[:: max(1, len(points_m) // 200)]
    ends = np.stack([np.eye(4), path[-1]])
    last = invert(cameras.world_from_camera[-1])
    begin, end = (_pixels(transform(last @ pose, some), cameras) for pose in ends)
    if not np.median(np.linalg.norm(end - begin, axis=1)) > min_motion_px:
        return np.zeros(len(path), bool)
    gaps = []
    for pose in path:
        here = _pixels(transform(last @ pose, some), cameras)
        still = min(
            np.median(np.linalg.norm(here - begin, axis=1)),
            np.median(np.linalg.norm(here - end, axis=1)),
        )
        gaps.append(still > 0.5)
    return np.array(gaps)


def _pixels(local_m: Float[np.ndarray, "n 3"], cameras: Cameras) -> Float[np.ndarray, "n 2"]:
    safe = local_m.copy()
    safe[:, 2] = np.maximum(safe[:, 2], 1e-3)
    return np.stack(project(cameras.intrinsics_px, safe), axis=1)
