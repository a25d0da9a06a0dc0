"""Objects that a hand moves in a recorded video, found in its first frame and followed.

Corners of the first frame are tracked. Corners that leave the place where the camera's motion would
take them, next to a hand and by about the hand's own motion, are on an object that the hand moves.
Their common similarity transform follows the object in the image. A pixel of the first frame
belongs to the object if moving with it explains the pixel's later colors better than resting does.
An object that moves with the hand and continues to the border of the image is the wearer's sleeve.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from egosim_jax.perception.video.cameras.flow import Background, background
from egosim_jax.perception.video.estimates import HandTracks
from egosim_jax.perception.video.moved_pixels import (
    TOLERANCE_PX,
    WINDOW_PX,
    grown,
    move,
    resting_places,
    segment_moved,
    warp,
)
from egosim_jax.types import Cameras
from egosim_jax.types.arrays import DepthMap, Mask, Masks, Video

FOLLOWED_FPS = 10.0
"""Least rate of the frames in which corners are followed: with more steps, they drift."""
CORNERS, QUALITY, APART_PX = 1500, 0.002, 4
"""Maximum number of corners, their minimum relative strength, and their minimum distance."""
MAX_OBJECTS = 4
"""Maximum number of objects that hands move in one clip."""
MIN_MOTION = 0.015
"""Minimum displacement of a moved corner, in image widths."""
START_MOTION = 0.05
"""Displacement of an object up to which it begins to move, in image widths."""
MIN_CORNERS = 6
"""Minimum number of corners of an object, and of an object that is found again in a frame."""
MAX_SHARE = 0.5
"""Largest share of the first frame that an object covers: what covers more is the scene."""
MAX_HAND_DISTANCE = 1.5
"""Maximum distance of a moved corner from the hand's nearest joint, in hand sizes."""
MAX_HAND_DIFFERENCE = 0.6
"""Maximum difference of a corner's displacement from the hand's, relative to the hand's."""
PALM = [0, 5, 9, 13, 17]
"""Joints that determine the motion of a hand in the image."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class Moved:
    """An object that a hand moves."""

    first: Bool[np.ndarray, "h w"]
    """Pixels of the object in the first frame."""
    start: Float32[np.ndarray, "n 2"]
    """Corners of the object in the first frame."""
    shown: Bool[np.ndarray, "f h w"]
    """Pixels of the object in each frame, also where a hand may be in front of it."""
    motion_px: Float[np.ndarray, "f 2 3"]
    """Affine transform of pixels (column, row, 1) from the first frame to each frame."""
    contacts: tuple[tuple[int, int], ...]
    """Frames in which it begins to move, each with the side of the hand at it."""
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
    frames: Video,
    hidden: Masks,
    hands: HandTracks,
    cameras: Cameras,
    depth_m: DepthMap,
    *,
    fps: float,
) -> list[Moved]:
    """Return the objects of the first frame that hands move later, the largest group first.

    `hidden` are the pixels of hands, and `depth_m` is the depth of the first frame in the unit of
    the cameras. Objects without texture, and objects that turn away from the camera, may be missed.
    At a high frame rate, every second or n-th frame is searched, and motions are interpolated.
    """
    every = max(1, int(fps // FOLLOWED_FPS))
    keys = np.union1d(np.arange(0, len(frames), every), [len(frames) - 1])
    objects = _find_moved(
        frames[keys],
        hidden[keys],
        replace(hands, **{n: x[keys] for n, x in vars(hands).items() if x is not None}),
        replace(cameras, world_from_camera=cameras.world_from_camera[keys]),
        depth_m,
    )
    return [_in_all_frames(moved, keys, hands) for moved in objects]


def _in_all_frames(moved: Moved, keys: Int[np.ndarray, " k"], hands: HandTracks) -> Moved:
    """Return an object that was followed in some frames, in all of them."""
    if len(keys) == len(hands.joints_px):
        return moved
    every = np.arange(len(hands.joints_px))
    flat = moved.motion_px.reshape(len(keys), -1)
    motion = np.stack([np.interp(every, keys, column) for column in flat.T], axis=1)
    motion = motion.reshape(-1, 2, 3)
    contacts = _contacts(moved.start, motion, hands, moved.first.shape[1])
    shown = np.stack([warp(moved.first, matrix) for matrix in motion])
    return replace(moved, motion_px=motion, shown=shown, contacts=contacts)


def _find_moved(
    frames: Video, hidden: Masks, hands: HandTracks, cameras: Cameras, depth_m: DepthMap
) -> list[Moved]:
    video = background(frames, hidden)
    tracks = _follow(video, _corners(video, hands), cameras, depth_m)
    away = np.linalg.norm(tracks.places - tracks.resting, axis=-1)
    width = frames.shape[2]
    left = np.nan_to_num(away) > MIN_MOTION * width
    held = _with_hands(tracks, left, hands)
    objects = []
    for _ in range(MAX_OBJECTS):
        group = _largest_group(tracks, held & left.any(axis=0))
        if group.sum() < MIN_CORNERS:
            break
        held &= ~group
        motion = _follow_object(video, tracks.start[group], tracks.places[:, group], hands)
        start = tracks.start[group & _always_on(tracks, motion)]
        if len(start) < MIN_CORNERS:
            continue
        first = segment_moved(frames, hidden, start, motion, cameras, depth_m)
        shown = np.stack([warp(first, matrix) for matrix in motion])
        column, row = np.rint(tracks.start).astype(int).T
        passed = grown(np.asarray(shown.any(axis=0)), 3)  # an object that passes drags corners
        held &= ~passed[row, column]
        if first.sum() >= MIN_CORNERS**2 and first.mean() <= MAX_SHARE:
            worn = _touches_border(first) and bool((first & grown(hidden[0], 5)).any())
            contacts = _contacts(start, motion, hands, width)
            objects.append(
                Moved(
                    first=first,
                    start=start,
                    shown=shown,
                    motion_px=motion,
                    contacts=contacts,
                    worn=worn,
                )
            )
    return objects


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
    corners = cv2.goodFeaturesToTrack(video.gray[0], CORNERS, QUALITY, APART_PX, mask=near & still)
    return np.zeros((0, 2), np.float32) if corners is None else corners.reshape(-1, 2)


def _follow(
    video: Background, start: Float32[np.ndarray, "n 2"], cameras: Cameras, depth_m: DepthMap
) -> _Tracks:
    """Track corners of the first frame from frame to frame."""
    pixels = (start + 0.5) * video.reduction - 0.5
    resting = resting_places(pixels, cameras, depth_m)
    finite = np.isfinite(resting).all(axis=(0, 2))
    start, pixels, resting = start[finite], pixels[finite], resting[:, finite]
    places = np.full((len(video.gray), len(start), 2), np.nan, np.float32)
    places[0] = pixels
    alive, here = np.arange(len(start)), start
    for frame in range(1, len(video.gray)):
        there, good = video.follow(frame - 1, frame, here)
        alive, here = alive[good], there[good]
        places[frame, alive] = (here + 0.5) * video.reduction - 0.5
    return _Tracks(start=pixels.astype(np.float32), places=places, resting=resting)


def _with_hands(
    tracks: _Tracks, left: Bool[np.ndarray, "f n"], hands: HandTracks
) -> Bool[np.ndarray, " n"]:
    """Return the corners that move near a hand and as the hand does."""
    held = np.zeros(len(tracks.start), bool)
    size = np.ptp(hands.joints_px, axis=2).max(axis=-1)
    for side in range(hands.joints_px.shape[1]):
        joints = hands.joints_px[:, side]
        tracked = np.isfinite(joints).all(axis=(1, 2))
        for corner in np.flatnonzero(left.any(axis=0)):
            place = tracks.places[:, corner]
            shown = np.flatnonzero(tracked & np.isfinite(place[:, 0]))
            apart = np.linalg.norm(joints[shown] - place[shown, None], axis=-1).min(axis=1)
            near = shown[apart <= MAX_HAND_DISTANCE * size[shown, side]]
            if not left[near, corner].any():
                continue
            offset = place - tracks.resting[:, corner]
            away = near[np.linalg.norm(offset[near], axis=1).argmax()]
            grasped = max(near[(near < away) & ~left[near, corner]], default=near[0])
            palm = joints[[grasped, away]][:, PALM].mean(axis=1)
            of_hand, of_corner = palm[1] - palm[0], offset[away] - offset[grasped]
            difference = np.linalg.norm(of_corner - of_hand)
            held[corner] |= bool(difference < MAX_HAND_DIFFERENCE * np.linalg.norm(of_hand))
    return held


def _largest_group(tracks: _Tracks, wanted: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Return the largest set of wanted corners with a common motion in some frame."""
    best = np.zeros(len(wanted), bool)
    for frame in range(1, len(tracks.places)):
        away = np.linalg.norm(tracks.places[frame] - tracks.resting[frame], axis=-1)
        movers = np.flatnonzero(wanted & np.isfinite(away) & (away > TOLERANCE_PX))
        if len(movers) > best.sum():
            _, inside = _similarity(tracks.start[movers], tracks.places[frame, movers])
            if inside.sum() > best.sum():
                best = np.zeros(len(wanted), bool)
                best[movers[inside]] = True
    return best


def _always_on(tracks: _Tracks, motion: Float[np.ndarray, "f 2 3"]) -> Bool[np.ndarray, " n"]:
    """Return the corners that follow a motion in all frames; others are only dragged along."""
    expected = np.stack([move(matrix, tracks.start) for matrix in motion])
    return np.nanmax(np.linalg.norm(tracks.places - expected, axis=-1), 0) <= 2 * TOLERANCE_PX


def _similarity(
    start: Float[np.ndarray, "n 2"], end: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "2 3"] | None, Bool[np.ndarray, " n"]]:
    """Return the similarity transform of most points (RANSAC), and the points that follow it.

    Points whose end is NaN are not known. The transform is None if too few points follow it.
    """
    import cv2

    finite = np.flatnonzero(np.isfinite(end).all(axis=1))
    followers = np.zeros(len(start), bool)
    if len(finite) < MIN_CORNERS:
        return None, followers
    matrix, inside = cv2.estimateAffinePartial2D(
        start[finite].astype(float), end[finite].astype(float), ransacReprojThreshold=TOLERANCE_PX
    )
    if matrix is None or inside.sum() < MIN_CORNERS:
        return None, followers
    followers[finite[inside[:, 0] > 0]] = True
    return matrix, followers


def _follow_object(
    video: Background,
    start: Float32[np.ndarray, "n 2"],
    places: Float32[np.ndarray, "f n 2"],
    hands: HandTracks,
) -> Float[np.ndarray, "f 2 3"]:
    """Return the object's motion in the image from the first frame to each frame.

    The first frame is warped by a guess and its corners are searched near by: the guess is the
    motion of the corners' tracks, of a hand at the object, or the last frame's motion. Where too
    few corners are found, the object moves with the hand, or rests if no hand is there.
    """
    motion = np.tile(np.eye(2, 3), (len(places), 1, 1))
    for frame in range(1, len(places)):
        tracked, _ = _similarity(start, places[frame])
        carried = _carried(motion[frame - 1], start, hands, frame)
        for guess in (tracked, carried, motion[frame - 1]):
            near = None if guess is None else _found_near(video, start, guess, frame)
            if near is not None:
                break
        motion[frame] = next(m for m in (near, tracked, carried) if m is not None)
    return motion


def _found_near(
    video: Background,
    start: Float32[np.ndarray, "n 2"],
    guess: Float[np.ndarray, "2 3"],
    frame: int,
) -> Float[np.ndarray, "2 3"] | None:
    """Return the motion to a frame near a guess, by optical flow; None with too few corners."""
    import cv2

    corners = ((start + 0.5) / video.reduction - 0.5).astype(np.float32)
    to_work = np.array([[1 / video.reduction] * 2, [(0.5 / video.reduction - 0.5)] * 2])
    linear = guess[:, :2]
    shift = to_work[0] * guess[:, 2] + to_work[1] - linear @ to_work[1]
    scaled = np.concatenate([linear, shift[:, None]], axis=1)
    size = video.gray[0].shape[::-1]
    views = [cv2.warpAffine(video.gray[0], scaled, size, borderMode=cv2.BORDER_REPLICATE)]
    warped = Background(
        gray=[*views, video.gray[frame]],
        still=[video.still[0], video.still[frame]],
        reduction=video.reduction,
    )
    there, good = warped.follow(0, 1, move(scaled, corners).astype(np.float32))
    there = (there + 0.5) * video.reduction - 0.5
    return _similarity(start[good], there[good])[0]


def _carried(
    motion: Float[np.ndarray, "2 3"],
    start: Float32[np.ndarray, "n 2"],
    hands: HandTracks,
    frame: int,
) -> Float[np.ndarray, "2 3"]:
    """Return the last frame's motion, shifted as a hand at the object is."""
    here = move(motion, start)
    for side in range(hands.joints_px.shape[1]):
        before, now = hands.joints_px[frame - 1, side], hands.joints_px[frame, side]
        if not (np.isfinite(before).all() and np.isfinite(now).all()):
            continue
        apart = np.linalg.norm(here[:, None] - before[None], axis=-1).min()
        if apart <= MAX_HAND_DISTANCE / 2 * np.ptp(before, axis=0).max():
            shift = (now[PALM] - before[PALM]).mean(axis=0)
            return motion + np.array([[0, 0, shift[0]], [0, 0, shift[1]]])
    return motion


def _contacts(
    start: Float32[np.ndarray, "n 2"],
    motion: Float[np.ndarray, "f 2 3"],
    hands: HandTracks,
    width: int,
) -> tuple[tuple[int, int], ...]:
    """Return the frames around the start of a motion, each with the side of the nearest hand."""
    places = np.stack([move(matrix, start) for matrix in motion])
    shift = np.linalg.norm(places - start, axis=-1).mean(axis=1) / width
    first = int(np.argmax(shift > MIN_MOTION))
    later = shift[first:] > START_MOTION
    last = first + (int(np.argmax(later)) if later.any() else len(later))
    contacts = []
    for frame in range(max(0, first - 2), max(last, first + 1)):
        apart = [
            np.linalg.norm(joints[:, None] - places[frame], axis=-1).min()
            for joints in hands.joints_px[frame]
        ]
        if np.isfinite(apart).any():
            contacts.append((frame, int(np.nanargmin(apart))))
    return tuple(contacts)


def _touches_border(mask: Mask) -> bool:
    edge = np.concatenate([mask[:3].ravel(), mask[-3:].ravel(), mask[:, :3].ravel(),
                           mask[:, -3:].ravel()])  # fmt: skip
    return bool(edge.any())
