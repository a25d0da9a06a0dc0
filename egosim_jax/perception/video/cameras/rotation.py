"""Rotations of a camera that turns without moving, by robust least squares on tracked corners.

The corners of a key frame are tracked through the following frames until too few remain; then a new
key frame begins. The rotation R of a frame minimizes the soft L1 loss of K R K⁻¹ x - y over the
tracks (x, y). If the camera also moves, parallax remains as a residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import no_type_check

import numpy as np
from jaxtyping import Float, Float32

from egosim_jax.perception.video.cameras.flow import MIN_CORNERS, Background
from egosim_jax.perception.video.cameras.path import pinhole
from egosim_jax.types.arrays import Matrix, Vector

MIN_KEPT = 0.4
"""Minimum fraction of a key frame's corners; below it, a new key frame begins."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Tracks:
    """Corners of key frames and their places in later frames, at working size."""

    keys: tuple[int, ...]
    """Key frame of each frame; itself in the first frame, -1 where tracking failed."""
    starts: tuple[Float32[np.ndarray, "n 2"], ...]
    """Corners in the key frame, for each frame."""
    ends: tuple[Float32[np.ndarray, "n 2"], ...]
    """The same corners in the frame."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Rotations:
    """Rotations of a camera, and their residuals."""

    world_from_camera: Float[np.ndarray, "f 3 3"]
    """Rotation of each frame; NaN where tracking failed."""
    residual_px: Float[np.ndarray, " f"]
    """Median residual of each frame, in pixels at working size."""
    turn_deg: float
    """Maximum angle between the first and another frame, in degrees."""


def follow_corners(video: Background, *, bridge: int = 5) -> Tracks:
    """Track corners through a video; at most `bridge` consecutive frames may fail."""
    keys, starts, ends = [0], [video.corners(0)], [video.corners(0)]
    key, corners = 0, starts[0]
    guess, last = corners, 0
    for frame in range(1, len(video.gray)):
        there, good = video.follow(key, frame, corners, guess)
        if good.sum() < max(MIN_CORNERS / 2, MIN_KEPT * len(corners)) and last != key:
            key, corners = last, video.corners(last)
            guess = corners
            there, good = video.follow(key, frame, corners, guess)
        keep = good.sum() >= MIN_CORNERS / 2 and frame - last <= bridge + 1
        keys.append(key if keep else -1)
        starts.append(corners[good] if keep else corners[:0])
        ends.append(there[good] if keep else corners[:0])
        if keep:
            last = frame
            shift = np.median(there[good] - guess[good], axis=0)
            # Lost corners may return: guess that they move as the others do.
            guess = np.where(good[:, None], there, guess + shift).astype(np.float32)
    return Tracks(keys=tuple(keys), starts=tuple(starts), ends=tuple(ends))


def solve_rotations(tracks: Tracks, intrinsics_px: Matrix) -> Rotations:
    """Return the rotations that best explain the tracks, for intrinsics at working size."""
    count = len(tracks.keys)
    poses = np.full((count, 3, 3), np.nan)
    poses[0] = np.eye(3)
    residual = np.full(count, np.nan)
    residual[0] = 0
    last = np.eye(3)
    for frame in range(1, count):
        key = tracks.keys[frame]
        if key < 0:
            continue
        first = poses[key].T @ last
        turned, residual[frame] = _solve(
            tracks.starts[frame], tracks.ends[frame], intrinsics_px, first.T
        )
        poses[frame] = last = poses[key] @ turned.T
    solved = poses[~np.isnan(poses[:, 0, 0])]
    cosine = (np.trace(solved, axis1=1, axis2=2) - 1) / 2
    turn = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).max())
    return Rotations(world_from_camera=poses, residual_px=residual, turn_deg=turn)


def find_focal(
    tracks: Tracks, *, height: int, width: int, views_deg: tuple[float, float]
) -> float | None:
    """Return the focal length that best explains the turns, in pixels at working size, or None.

    The minimum residual must be a third, and half a pixel, below the residuals at both ends of the
    range of views. Otherwise the turn is too small to determine the focal length.
    """
    views = np.radians(np.linspace(*views_deg, 14))
    focals = max(height, width) / 2 / np.tan(views / 2)
    costs = []
    for focal in focals:
        intrinsics = pinhole(float(focal), height=height, width=width)
        costs.append(float(np.nanmean(solve_rotations(tracks, intrinsics).residual_px)))
    best = int(np.argmin(costs))
    lowest, ends = costs[best], min(costs[0], costs[-1])
    if best in (0, len(costs) - 1) or lowest > min(0.67 * ends, ends - 0.5):
        return None
    around = slice(best - 1, best + 2)
    # The views are coarse: take the minimum of a parabola through the three around the best.
    a, b, _ = np.polyfit(np.log(focals[around]), costs[around], 2)
    return float(np.exp(-b / (2 * a)))


def _solve(
    starts: Float32[np.ndarray, "n 2"],
    ends: Float32[np.ndarray, "n 2"],
    intrinsics_px: Matrix,
    rotation: Matrix,
) -> tuple[Matrix, float]:
    """Return the rotation from the key frame's axes to the frame's, and the median residual."""
    import cv2
    from scipy.optimize import least_squares

    focal, center = intrinsics_px[0, 0], intrinsics_px[:2, 2]
    rays = np.concatenate([(starts - center) / focal, np.ones((len(starts), 1))], axis=1)

    def gaps(step: Vector) -> Float[np.ndarray, " m"]:
        turned = rays @ (cv2.Rodrigues(step)[0] @ rotation).T
        return (turned[:, :2] / np.maximum(turned[:, 2:], 1e-6) * focal + center - ends).ravel()

    step = least_squares(gaps, np.zeros(3), loss="soft_l1").x
    residual = float(np.median(np.linalg.norm(gaps(step).reshape(-1, 2), axis=1)))
    return cv2.Rodrigues(step)[0] @ rotation, residual
