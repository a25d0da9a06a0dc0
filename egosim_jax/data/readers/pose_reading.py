"""Decide from the video whether poses are camera to world or world to camera.

Points are tracked between frames `GAP` apart. The tracks satisfy the epipolar constraint for the
relative pose of the right reading only. The evidence is the median Sampson distance of each reading
in pixels (Hartley and Zisserman, Multiple View Geometry, 11.4.3).
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, UInt8

from egosim_jax.geometry import invert

PAIRS = 6
"""Number of frame pairs to compare."""
GAP = 8
"""Distance between the frames of a pair."""
MIN_TRACKS = 20
"""Minimum number of tracks for a pair to count."""
MAX_ERROR_PX = 3.0
"""Maximum median Sampson distance of an accepted reading, in pixels."""
MIN_RATIO = 1.5
"""Minimum ratio between the two readings' distances for a decision."""


def read_poses(
    frames: UInt8[np.ndarray, "f h w 3"],
    matrices: Float[np.ndarray, "f 4 4"],
    intrinsics_px: Float[np.ndarray, "3 3"],
) -> tuple[Float[np.ndarray, "f 4 4"] | None, Mapping[str, str]]:
    """Return `world_from_camera` by the reading that fits the video, or None; and the evidence."""
    readings = {"camera_to_world": matrices, "world_to_camera": invert(matrices)}
    errors: dict[str, list[float]] = {name: [] for name in readings}
    for start in np.linspace(0, max(0, len(frames) - 1 - GAP), PAIRS).astype(int).tolist():
        stop = min(start + GAP, len(frames) - 1)
        points, moved = _track(frames[start], frames[stop])
        if len(points) < MIN_TRACKS:
            continue
        for name, poses in readings.items():
            relative = invert(poses[stop]) @ poses[start]
            errors[name].append(_sampson_px(relative, points, moved, intrinsics_px))
    medians = {n: float(np.median(e)) if e else float("nan") for n, e in errors.items()}
    evidence = {f"epipolar_error_px_{name}": f"{value:.2f}" for name, value in medians.items()}
    best, other = sorted(medians, key=lambda name: medians[name])
    clear = medians[best] <= MAX_ERROR_PX and medians[other] >= MIN_RATIO * medians[best]
    if not clear:
        return None, {"poses": "unknown: no reading clearly fits the video", **evidence}
    return readings[best], {"poses": best, **evidence}


def _track(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels in the first frame and in the second, tracked forward and backward."""
    import cv2

    gray = [cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY) for frame in (first, second)]
    points = cv2.goodFeaturesToTrack(gray[0], 400, 0.01, 5)
    if points is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    there, found, _ = cv2.calcOpticalFlowPyrLK(gray[0], gray[1], points, points.copy())
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(gray[1], gray[0], there, there.copy())
    good = np.asarray(found, bool)[:, 0] & np.asarray(found_back, bool)[:, 0]
    good &= np.linalg.norm(back - points, axis=-1)[:, 0] < 0.5
    return points[good, 0].astype(float), there[good, 0].astype(float)


def _sampson_px(
    relative: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "n 2"],
    moved: Float[np.ndarray, "n 2"],
    intrinsics_px: Float[np.ndarray, "3 3"],
) -> float:
    """Return the median Sampson distance in pixels for a pose `second_from_first`."""
    x, y, z = relative[:3, 3] / max(float(np.linalg.norm(relative[:3, 3])), 1e-12)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    inverse = np.linalg.inv(intrinsics_px)
    fundamental = inverse.T @ cross @ relative[:3, :3] @ inverse
    one = np.ones((len(points), 1))
    first, second = np.hstack([points, one]), np.hstack([moved, one])
    lines, back = first @ fundamental.T, second @ fundamental
    size = np.hypot.reduce([*lines[:, :2].T, *back[:, :2].T])
    distance = np.abs((second * lines).sum(axis=1)) / np.maximum(size, 1e-12)
    return float(np.median(distance))
