"""Objects that a hand moves in a recorded video, found in its first frame and followed.

Corners of the first frame are tracked. Corners that leave the place where the camera's motion would
take them, beside a hand and by about the hand's own motion, are on an object that the hand moves.
Their common similarity transform follows the object in the image. A pixel of the first frame
belongs to the object if moving with it explains the pixel's later colors better than resting does.
An object that moves with the hand and continues to the border of the image is the wearer's sleeve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from egosim_jax.geometry import invert, project, transform
from egosim_jax.perception.cameras.flow import Background, background
from egosim_jax.perception.estimates import HandTracks
from egosim_jax.types import Cameras

CORNERS, QUALITY, APART_PX = 1500, 0.002, 4
"""Maximum number of corners, their minimum relative strength, and their minimum distance."""
WINDOW_PX = 21
"""Width of the border around hands that has no corners, because hands drag them along."""
MAX_OBJECTS = 4
"""Maximum number of objects that hands move in one clip."""
MIN_MOTION = 0.015
"""Minimum displacement of a moved corner, in image widths."""
MIN_CORNERS = 6
"""Minimum number of corners of an object, and of an object that is found again in a frame."""
TOLERANCE_PX = 3.0
"""Maximum distance of an object's corner from the object's similarity transform, in pixels."""
MAX_HAND_DISTANCE = 1.5
"""Maximum distance of a moved corner from the hand's nearest joint, in hand sizes."""
MAX_HAND_DIFFERENCE = 0.6
"""Maximum difference of a corner's displacement from the hand's, relative to the hand's."""
COMPARED = 20
"""Number of frames whose colors decide between motion and rest."""
MIN_CHANGE = 18.0
"""Minimum color change at the first place of a moved object, in 8-bit levels."""
MAX_CHANGE = 80.0
"""Color change to which larger ones are clipped; motion explains at most half of it."""
PASSES = 2
"""Number of passes of the segmentation; the first takes the hull of the corners as the object."""
UNSEEN = 12.0
"""Assumed color change along the motion of a pixel that hands always hide, in 8-bit levels."""
HAND_MARGIN = 1 / 280
"""Border around hands that is not compared, in image widths."""
AROUND = 0.5
"""Width of the searched border around an object's corners, relative to their extent."""
PALM = [0, 5, 9, 13, 17]
"""Joints that determine the motion of a hand in the image."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Moved:
    """An object that a hand moves."""

    first: Bool[np.ndarray, "h w"]
    """Pixels of the object in the first frame."""
    shown: Bool[np.ndarray, "f h w"]
    """Pixels of the object in each frame, also where a hand may be in front of it."""
    motion_px: Float[np.ndarray, "f 2 3"]
    """Affine transform of pixels (column, row, 1) from the first frame to each frame."""
    worn: bool
    """True if it continues to the border of the image, as a sleeve does."""


@dataclass(frozen=True)
class _Tracks:
    """Corners of the first frame, their tracks, and their places if they rested."""

    start: Float32[np.ndarray, "n 2"]
    places: Float32[np.ndarray, "f n 2"]
    """NaN from the frame on in which a corner is lost."""
    resting: Float[np.ndarray, "f n 2"]


def find_moved(
    frames: UInt8[np.ndarray, "f h w 3"],
    hidden: Bool[np.ndarray, "f h w"],
    hands: HandTracks,
    cameras: Cameras,
    depth_m: Float[np.ndarray, "h w"],
) -> list[Moved]:
    """Return the objects of the first frame that hands move later, the largest group first.

    `hidden` are the pixels of hands, and `depth_m` is the depth of the first frame in the unit of
    the cameras. Objects without texture, and objects that turn away from the camera, may be missed.
    """
    video = background(frames, hidden)
    tracks = _follow(video, _corners(video, hands), cameras, depth_m)
    away = np.linalg.norm(tracks.places - tracks.resting, axis=-1)
    width = frames.shape[2]
    left = np.nan_to_num(away) > MIN_MOTION * width
    held = _with_hands(tracks, left, hands)
    found = []
    for _ in range(MAX_OBJECTS):
        own = _largest_group(tracks, held & left.any(axis=0))
        if own.sum() < MIN_CORNERS:
            break
        held &= ~own
        motion = _follow_object(video, tracks.start[own], tracks.places[:, own], hands)
        start = tracks.start[own & _always_on(tracks, motion)]
        if len(start) < MIN_CORNERS:
            continue
        first = _segment(frames, hidden, start, motion, cameras, depth_m)
        shown = np.stack([_warp(first, matrix) for matrix in motion])
        column, row = np.rint(tracks.start).astype(int).T
        held &= ~_grown(shown.any(axis=0), 3)[row, column]  # an object that passes drags corners
        if first.sum() >= MIN_CORNERS**2:
            worn = _touches_border(first) and bool((first & _grown(hidden[0], 5)).any())
            found.append(Moved(first=first, shown=shown, motion_px=motion, worn=worn))
    return found


def _corners(video: Background, hands: HandTracks) -> Float32[np.ndarray, "n 2"]:
    """Return corners of the first frame, at working size, where hands come near."""
    import cv2

    near = np.zeros_like(video.still[0])
    joints = (hands.joints_px + 0.5) / video.reduction - 0.5
    for hand in joints[np.isfinite(joints).all(axis=(2, 3))]:
        center, size = hand[PALM].mean(axis=0), np.ptp(hand, axis=0).max()
        circle = tuple(np.rint(center).astype(int).tolist())
        cv2.circle(near, circle, int(MAX_HAND_DISTANCE * size), 255, -1)
    still = cv2.erode(video.still[0], np.ones((WINDOW_PX, WINDOW_PX), np.uint8))
    found = cv2.goodFeaturesToTrack(video.gray[0], CORNERS, QUALITY, APART_PX, mask=near & still)
    return np.zeros((0, 2), np.float32) if found is None else found.reshape(-1, 2)


def _follow(
    video: Background,
    start: Float32[np.ndarray, "n 2"],
    cameras: Cameras,
    depth_m: Float[np.ndarray, "h w"],
) -> _Tracks:
    """Track corners of the first frame from frame to frame."""
    pixels = (start + 0.5) * video.reduction - 0.5
    resting = _rest(pixels, cameras, depth_m)
    known = np.isfinite(resting).all(axis=(0, 2))
    start, pixels, resting = start[known], pixels[known], resting[:, known]
    places = np.full((len(video.gray), len(start), 2), np.nan, np.float32)
    places[0] = pixels
    alive, here = np.arange(len(start)), start
    for frame in range(1, len(video.gray)):
        there, good = video.follow(frame - 1, frame, here)
        alive, here = alive[good], there[good]
        places[frame, alive] = (here + 0.5) * video.reduction - 0.5
    return _Tracks(start=pixels.astype(np.float32), places=places, resting=resting)


def _rest(
    pixels: Float[np.ndarray, "n 2"], cameras: Cameras, depth_m: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "f n 2"]:
    """Return where static points of the first frame are in each frame; NaN if unknown."""
    column, row = np.rint(pixels).astype(int).T
    row, column = np.clip(row, 0, cameras.height - 1), np.clip(column, 0, cameras.width - 1)
    depth = depth_m[row, column]
    depth = np.where(np.isfinite(depth), depth, np.nan)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], 1)
    local = rays @ np.linalg.inv(cameras.intrinsics_px).T * depth[:, None]
    world = transform(cameras.world_from_camera[0], local)
    seen = transform(invert(cameras.world_from_camera), world[None])
    with np.errstate(divide="ignore", invalid="ignore"):
        places = np.stack(project(cameras.intrinsics_px, seen), axis=-1)
    return np.where(seen[..., 2:] > 0, places, np.nan)


def _with_hands(
    tracks: _Tracks, left: Bool[np.ndarray, "f n"], hands: HandTracks
) -> Bool[np.ndarray, " n"]:
    """Return the corners that move near a hand and as the hand does."""
    held = np.zeros(len(tracks.start), bool)
    size = np.ptp(hands.joints_px, axis=2).max(axis=-1)
    for side in range(hands.joints_px.shape[1]):
        joints = hands.joints_px[:, side]
        found = np.isfinite(joints).all(axis=(1, 2))
        for corner in np.flatnonzero(left.any(axis=0)):
            place, moves = tracks.places[:, corner], found & left[:, corner]
            shown = np.flatnonzero(found & np.isfinite(place[:, 0]))
            if not moves.any() or len(shown) < 3:
                continue
            apart = np.linalg.norm(joints[shown] - place[shown, None], axis=-1).min(axis=1)
            near = shown[apart <= MAX_HAND_DISTANCE * size[shown, side]]
            if len(near) < 3:
                continue
            offset = place[near] - tracks.resting[near, corner]
            distance = np.linalg.norm(offset, axis=1)
            low, high = near[distance.argmin()], near[distance.argmax()]
            if low == high:
                continue
            own = offset[distance.argmax()] - offset[distance.argmin()]
            palm = joints[[low, high]][:, PALM].mean(axis=1)
            of_hand = palm[1] - palm[0]
            length = np.linalg.norm(of_hand)
            held[corner] |= bool(
                length > 0 and np.linalg.norm(own - of_hand) <= MAX_HAND_DIFFERENCE * length
            )
    return held


def _largest_group(tracks: _Tracks, wanted: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return the largest set of wanted corners with a common motion in some frame."""
    best = np.zeros(len(wanted), bool)
    for frame in range(1, len(tracks.places)):
        away = np.linalg.norm(tracks.places[frame] - tracks.resting[frame], axis=-1)
        own = np.flatnonzero(wanted & np.isfinite(away) & (away > TOLERANCE_PX))
        if len(own) > best.sum():
            _, inside = _similarity(tracks.start[own], tracks.places[frame, own])
            if inside.sum() > best.sum():
                best = np.zeros(len(wanted), bool)
                best[own[inside]] = True
    return best


def _always_on(tracks: _Tracks, motion: Float[np.ndarray, "f 2 3"]) -> Bool[np.ndarray, " n"]:
    """Return the corners that follow a motion in all frames; others are only dragged along."""
    expected = np.stack([_move(matrix, tracks.start) for matrix in motion])
    return np.nanmax(np.linalg.norm(tracks.places - expected, axis=-1), 0) <= 2 * TOLERANCE_PX


def _similarity(
    start: Float[np.ndarray, "n 2"], end: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "2 3"] | None, Bool[np.ndarray, " n"]]:
    """Return the similarity transform of most points (RANSAC), and the points that follow it."""
    import cv2

    if len(start) < MIN_CORNERS:
        return None, np.zeros(len(start), bool)
    matrix, inside = cv2.estimateAffinePartial2D(
        start.astype(np.float64), end.astype(np.float64), ransacReprojThreshold=TOLERANCE_PX
    )
    if matrix is None or inside.sum() < MIN_CORNERS:
        return None, np.zeros(len(start), bool)
    return matrix, inside[:, 0] > 0


def _follow_object(
    video: Background,
    start: Float32[np.ndarray, "n 2"],
    places: Float32[np.ndarray, "f n 2"],
    hands: HandTracks,
) -> Float[np.ndarray, "f 2 3"]:
    """Return the object's motion in the image from the first frame to each frame.

    Its corners are searched where the last frame's motion predicts them. Where too few are found,
    it moves with the nearest hand, or rests if no hand is near.
    """
    motion = np.tile(np.eye(2, 3), (len(places), 1, 1))
    corners = ((start + 0.5) / video.reduction - 0.5).astype(np.float32)
    for frame in range(1, len(places)):
        guess = _move(motion[frame - 1], start)
        guess = np.where(np.isfinite(places[frame]), places[frame], guess)
        there, good = video.follow(0, frame, corners, (guess + 0.5) / video.reduction - 0.5)
        there = (there + 0.5) * video.reduction - 0.5
        tracked = np.isfinite(places[frame]).all(axis=1)
        good, there = good | tracked, np.where(good[:, None], there, places[frame])
        found, _ = _similarity(start[good], there[good])
        if found is None:
            found = _carried(motion[frame - 1], start, hands, frame)
        motion[frame] = found
    return motion


def _carried(
    motion: Float[np.ndarray, "2 3"],
    start: Float32[np.ndarray, "n 2"],
    hands: HandTracks,
    frame: int,
) -> Float[np.ndarray, "2 3"]:
    """Return the last frame's motion, continued by the motion of a hand at the object."""
    import cv2

    here = _move(motion, start)
    for side in range(hands.joints_px.shape[1]):
        before, now = hands.joints_px[frame - 1, side], hands.joints_px[frame, side]
        if not (np.isfinite(before).all() and np.isfinite(now).all()):
            continue
        apart = np.linalg.norm(here[:, None] - before[None], axis=-1).min()
        if apart <= MAX_HAND_DISTANCE / 2 * np.ptp(before, axis=0).max():
            step, _ = cv2.estimateAffinePartial2D(before[PALM], now[PALM], method=cv2.LMEDS)
            if step is not None:
                return step @ np.concatenate([motion, [[0, 0, 1]]])
    return motion


def _segment(
    frames: UInt8[np.ndarray, "f h w 3"],
    hidden: Bool[np.ndarray, "f h w"],
    start: Float32[np.ndarray, "n 2"],
    motion: Float[np.ndarray, "f 2 3"],
    cameras: Cameras,
    depth_m: Float[np.ndarray, "h w"],
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the first frame that move with the corners rather than rest."""
    import cv2

    own = np.zeros(frames.shape[1:3], np.uint8)
    outline = cv2.convexHull(np.rint(start).astype(np.int32))
    cv2.fillConvexPoly(own, outline, 1)
    own = cv2.erode(own, np.ones((WINDOW_PX // 2 + 1,) * 2, np.uint8))  # corners may be beside it
    chosen = _compared(start, motion)
    low, high = start.min(axis=0), start.max(axis=0)
    border = AROUND * (high - low).max() + 4
    left, top = np.maximum(low - border, 0).astype(int)
    right, bottom = np.minimum(high + border + 1, own.shape[::-1]).astype(int)
    rows, columns = (x.reshape(-1) for x in np.mgrid[top:bottom, left:right])
    pixels = np.stack([columns, rows], axis=1).astype(float)
    poses = cameras.world_from_camera[[0, *chosen]]
    resting = _rest(pixels, replace(cameras, world_from_camera=poses), depth_m)[1:]
    smooth = [cv2.GaussianBlur(frames[frame], (0, 0), 1.0) for frame in (0, *chosen)]
    expected = smooth[0][rows, columns].astype(np.float32)
    margin = max(1, round(HAND_MARGIN * own.shape[1]))
    hands = [_grown(hidden[frame], margin) for frame in (0, *chosen)]
    for _ in range(PASSES):
        costs, counts = np.zeros((2, 2, len(rows)), np.float32)
        for n, frame in enumerate(chosen):
            covered = hands[n + 1] | _grown(_warp(own > 0, motion[frame]), 2)
            for way, hide, places in (
                (0, covered, resting[n]),
                (1, hands[n + 1], _move(motion[frame], pixels)),
            ):
                colors, seen = _look_up(smooth[n + 1], hide, places)
                change = np.abs(colors - expected).max(axis=1)
                costs[way] += np.where(seen, np.minimum(change, MAX_CHANGE), 0)
                counts[way] += seen
        rest, move = costs / np.maximum(counts, 1)
        move = np.where(counts[1] > 0, move, UNSEEN)
        moves = (rest > MIN_CHANGE) & (rest > move + MIN_CHANGE / 2)
        moves = np.where(counts[0] > 0, moves, own[rows, columns] > 0)
        own = np.zeros_like(own)
        own[rows, columns] = moves & (move < MAX_CHANGE / 2) & ~hands[0][rows, columns]
        own = _cleaned(own, start)
    return (own > 0) & ~hidden[0]


def _cleaned(
    own: UInt8[np.ndarray, "h w"], start: Float32[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "h w"]:
    """Return a mask without specks, gaps and parts without corners."""
    import cv2

    size = max(3, round(own.shape[1] / 200) | 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    own = cv2.morphologyEx(own, cv2.MORPH_OPEN, kernel)
    own = cv2.morphologyEx(own, cv2.MORPH_CLOSE, kernel, iterations=2)
    return _filled(_at_corners(own, start))


def _compared(start: Float32[np.ndarray, "n 2"], motion: Float[np.ndarray, "f 2 3"]) -> list[int]:
    """Return frames to compare: half with the object far from its first place."""
    shift = np.linalg.norm(np.stack([_move(m, start) for m in motion]) - start, axis=-1).mean(1)
    far = np.flatnonzero(shift >= min(0.5 * shift.max(), np.ptp(start, axis=0).max()))
    chosen = [
        some[np.linspace(0, len(some) - 1, COMPARED // 2).astype(int)]
        for some in (far, np.flatnonzero(shift >= TOLERANCE_PX))
    ]
    return np.unique(np.concatenate(chosen)).tolist()


def _look_up(
    image: UInt8[np.ndarray, "h w 3"],
    hide: Bool[np.ndarray, "h w"],
    places: Float[np.ndarray, "n 2"],
) -> tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Return the colors at places in an image, and True for places in view and not hidden."""
    height, width = hide.shape
    column, row = np.rint(np.nan_to_num(places, nan=-1)).astype(int).T
    seen = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    row, column = np.where(seen, row, 0), np.where(seen, column, 0)
    return image[row, column].astype(np.float32), seen & ~hide[row, column]


def _at_corners(
    own: UInt8[np.ndarray, "h w"], start: Float32[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "h w"]:
    """Return the connected parts of a mask that have corners in or beside them."""
    import cv2

    _, parts = cv2.connectedComponents(own)
    near = cv2.dilate(parts.astype(np.float32), np.ones((9, 9), np.uint8))
    column, row = np.rint(start).astype(int).T
    at = near[np.clip(row, 0, own.shape[0] - 1), np.clip(column, 0, own.shape[1] - 1)]
    numbers, count = np.unique(at[at > 0].astype(int), return_counts=True)
    return np.isin(parts, numbers[count >= 2]).astype(np.uint8)


def _filled(own: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Return a mask without holes."""
    import cv2

    outlines, _ = cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros_like(own), outlines, -1, 1, cv2.FILLED)


def _grown(mask: Bool[np.ndarray, "h w"], radius: int) -> Bool[np.ndarray, "h w"]:
    import cv2

    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0


def _move(motion: Float[np.ndarray, "2 3"], pixels: np.ndarray) -> np.ndarray:
    return pixels @ motion[:, :2].T + motion[:, 2]


def _warp(mask: Bool[np.ndarray, "h w"], motion: Float[np.ndarray, "2 3"]) -> np.ndarray:
    import cv2

    size = mask.shape[1], mask.shape[0]
    return cv2.warpAffine(mask.astype(np.uint8), motion, size, flags=cv2.INTER_NEAREST) > 0


def _touches_border(mask: Bool[np.ndarray, "h w"]) -> bool:
    edge = np.concatenate([mask[:3].ravel(), mask[-3:].ravel(), mask[:, :3].ravel(),
                           mask[:, -3:].ravel()])  # fmt: skip
    return bool(edge.any())
