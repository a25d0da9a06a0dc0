"""HaMeR's hands, as JSON of EgoSim's `mano_full`: a source of joints for a recording.

    {"frames": [{"frame_idx": 0, "hands": [{"is_right": 1, "confidence": .9,
        "cam_t_full": [x, y, z], "keypoints_3d": 21 x 3, ...}]}]}

The keypoints describe a right hand in meters, in our order, without its position. A left hand is
mirrored in x. `cam_t_full` is the hand's position in HaMeR's camera: its focal length is 5000 / 256
of the image's longer side, and its principal point is the image center, counted from the corner.
The recording has another camera, so the hand is moved until that camera sees it at the same pixels,
by linear least squares. If a side has several hands, the most confident one is used. EgoSim's
script lists every frame, also without hands: a list from 0 without gaps has the video's length.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from egosim_jax.data.pairing import alike
from egosim_jax.geometry import transform
from egosim_jax.io.bounded import quote, quote_path, read_json
from egosim_jax.io.video import VideoInfo
from egosim_jax.types import Cameras, InputError

FOCAL = 5000 / 256
"""Focal length of HaMeR's camera, relative to the longer side of the image."""
MAX_BYTES = 1 << 28
"""Maximum size of a file in bytes."""


def read_hamer(path: Path, cameras: Cameras, info: VideoInfo) -> Float[np.ndarray, "f 2 21 3"]:
    """Return joints in the world, left before right, NaN where there is no hand.

    Hands of frames without a camera are omitted. Raises `InputError` if the file is not HaMeR's,
    names frames that the video does not have, or lists frames at another rate than the video's.
    """
    written = read_json(path, limit=MAX_BYTES)
    entries = written.get("frames") if isinstance(written, dict) else None
    if not isinstance(entries, list):
        raise InputError(f"{quote_path(path)} has no frames: it is not a result of HaMeR.")
    count = len(cameras.world_from_camera)
    frames = max(count, len(info.timeline.listed_s))
    joints = np.full((count, 2, 21, 3), np.nan)
    best = np.full((count, 2), -np.inf)
    numbers: list[int] = []
    for entry in entries:
        number = entry.get("frame_idx") if isinstance(entry, dict) else None
        hands = entry.get("hands") if isinstance(entry, dict) else None
        if type(number) is not int or not 0 <= number < frames or not isinstance(hands, list):
            raise InputError(
                f"{quote_path(path)}: frame {quote(number)} with hands {quote(hands)}: frame_idx "
                f"must be from 0 to {frames - 1}. Run HaMeR on the same video."
            )
        numbers.append(number)
        for hand in hands if number < count else ():
            side, confidence, points, position = _hand(hand, path)
            if confidence > best[number, side]:
                best[number, side] = confidence
                local = place_hand(points, position, cameras)
                joints[number, side] = transform(cameras.world_from_camera[number], local)
    _check_rate(path, numbers, info)
    return joints


def _check_rate(path: Path, numbers: Sequence[int], info: VideoInfo) -> None:
    """Raise `InputError` for a list of all frames, from 0, that has another length than a video."""
    rows = len(numbers)
    lengths = (info.frames, len(info.timeline.listed_s))
    if set(numbers) != set(range(rows)) or any(alike(rows, length) for length in lengths):
        return
    rate = float(info.fps) * rows / info.frames
    raise InputError(
        f"{quote_path(path)} lists {rows} frames, and the video has {info.frames}, as at "
        f"{rate:.4g} frames per second instead of {float(info.fps):.4g}: frame_idx must be the "
        "number of the frame. Run HaMeR on the same video."
    )


def place_hand(
    points: Float[np.ndarray, "21 3"], position: Float[np.ndarray, " 3"], cameras: Cameras
) -> Float[np.ndarray, "21 3"]:
    """Return a hand in camera coordinates that projects to the same pixels as in HaMeR's camera."""
    seen = points + position
    focal = FOCAL * max(cameras.height, cameras.width)
    center = np.array([cameras.width / 2, cameras.height / 2]) - 0.5
    pixels = focal * seen[:, :2] / seen[:, 2:] + center
    rays = (pixels - cameras.intrinsics_px[:2, 2]) / cameras.intrinsics_px[[0, 1], [0, 1]]
    # Each pixel gives two linear equations for the translation t: t_xy - ray t_z = ray z - xy.
    rows = np.zeros((21, 2, 3))
    rows[:, 0, 0] = rows[:, 1, 1] = 1
    rows[:, :, 2] = -rays
    right = rays * points[:, 2:] - points[:, :2]
    translation = np.linalg.lstsq(rows.reshape(-1, 3), right.reshape(-1), rcond=None)[0]
    return points + translation


def _hand(hand: Any, path: Path) -> tuple[int, float, np.ndarray, np.ndarray]:
    """Return side, confidence, keypoints and position of a hand."""
    written: dict[str, Any] = hand if isinstance(hand, dict) else {}
    try:
        right = _first(written.get("is_right"))
        confidence = _first(written.get("confidence", 0.0))
        points = np.array(written.get("keypoints_3d"), float).reshape(21, 3)
        position = np.array(written.get("cam_t_full"), float).reshape(3)
    except (TypeError, ValueError, IndexError) as error:
        raise InputError(
            f"{quote_path(path)}: a hand must have is_right, cam_t_full of 3 and keypoints_3d of "
            "21 x 3 numbers. Run EgoSim's reconstruct_full_mano.py first."
        ) from error
    finite = np.isfinite([right, confidence]).all() and np.isfinite(points).all()
    if right not in (0.0, 1.0) or not finite or not np.isfinite(position).all():
        raise InputError(f"{quote_path(path)}: a hand has values that are not finite.")
    if (points[:, 2] + position[2] <= 0).any():
        raise InputError(f"{quote_path(path)}: a hand is behind the camera.")
    return int(right), confidence, points * [2 * right - 1, 1, 1], position


def _first(value: Any) -> float:
    """Return a number, or the first number of a list."""
    return float(np.ravel(value)[0])
