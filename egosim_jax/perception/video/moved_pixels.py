"""Pixels of an object that a hand moves in a video, from its motion in the image.

A pixel of the first frame belongs to the object if moving with it explains the pixel's later colors
better than resting does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from egosim_jax.geometry import invert, project, transform
from egosim_jax.types import Cameras
from egosim_jax.types.arrays import Colors, DepthMap, Mask, Masks, RgbImage, Video

WINDOW_PX = 21
"""Width of the border around hands that has no corners, because hands drag them along."""
TOLERANCE_PX = 3.0
"""Maximum distance of an object's corner from the object's similarity transform, in pixels."""
COMPARED = 20
"""Number of frames whose colors decide between motion and rest."""
MIN_CHANGE = 18.0
"""Minimum color change at the first place of a moved object, in 8-bit levels."""
MAX_CHANGE = 40.0
"""Maximum color change of a moved object, in 8-bit levels."""
MAX_LIGHT = 1.35
"""Maximum ratio of the light on a pixel in two frames."""
PALETTE = 1000
"""Approximate number of an object's colors to which hidden pixels are compared."""
PASSES = 4
"""Number of passes of the segmentation; the first takes the hull of the corners as the object.

The object that a pass has found hides its own first place in later frames from the next one, and is
searched beyond its border: a tall cup has corners at its lid alone."""
UNSEEN = 12.0
"""Assumed color change along the motion of a pixel that hands always hide, in 8-bit levels."""
HAND_MARGIN = 1 / 280
"""Border around hands that is not compared, in image widths."""
NOTCH = 0.15
"""Maximum width of a notch in an object's outline, relative to its extent."""
AROUND = 2.0
"""Width of the searched border around an object's corners, relative to their extent."""
BEYOND = 0.5
"""Width of the searched border around an object of an earlier pass, relative to its extent."""


def segment_moved(
    frames: Video,
    hidden: Masks,
    start: Float32[np.ndarray, "n 2"],
    motion: Float[np.ndarray, "f 2 3"],
    cameras: Cameras,
    depth_m: DepthMap,
) -> Mask:
    """Return the pixels of the first frame that move with the corners rather than rest."""
    import cv2

    mask = np.zeros(frames.shape[1:3], np.uint8)
    outline = cv2.convexHull(np.rint(start).astype(np.int32))
    cv2.fillConvexPoly(mask, outline, 1)
    # corners may be next to the object
    mask = cv2.erode(mask, np.ones((WINDOW_PX // 2 + 1,) * 2, np.uint8))
    chosen = _compared(start, motion)
    poses = replace(cameras, world_from_camera=cameras.world_from_camera[[0, *chosen]])
    smooth = [cv2.GaussianBlur(frames[frame], (0, 0), 1.0) for frame in (0, *chosen)]
    margin = max(1, round(HAND_MARGIN * mask.shape[1]))
    hands = [grown(hidden[frame], margin) for frame in (0, *chosen)]
    for _ in range(PASSES):
        rows, columns = _searched(start, mask)
        pixels = np.stack([columns, rows], axis=1).astype(float)
        resting = resting_places(pixels, poses, depth_m)[1:]
        expected = smooth[0][rows, columns].astype(np.float32)
        changes = np.full((2, len(chosen), len(rows)), np.nan, np.float32)
        for n, frame in enumerate(chosen):
            covered = hands[n + 1] | grown(warp(mask > 0, motion[frame]), 2)
            for way, hide, places in (
                (0, covered, resting[n]),
                (1, hands[n + 1], move(motion[frame], pixels)),
            ):
                colors, seen = _look_up(smooth[n + 1], hide, places)
                changes[way, n] = np.where(seen, _change(colors, expected), np.nan)
        (at_rest, moving), (seen_at_rest, seen_moving) = _medians(changes)
        moves = (at_rest > MIN_CHANGE) & (at_rest > moving + MIN_CHANGE / 2)
        moves = np.where(seen_at_rest, moves, mask[rows, columns] > 0) & (moving < MAX_CHANGE)
        moves[moves & ~seen_moving] = _alike(
            expected[moves & ~seen_moving], expected[moves & seen_moving]
        )
        mask = np.zeros_like(mask)
        mask[rows, columns] = moves & ~hands[0][rows, columns]
        mask = _cleaned(mask, start)
    return (mask > 0) & ~hidden[0]


def _searched(
    start: Float32[np.ndarray, "n 2"], mask: UInt8[np.ndarray, "h w"]
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Return rows and columns around the corners and the object; it may be empty."""
    places = np.concatenate([start, np.argwhere(mask)[:, ::-1]])
    low, high = places.min(axis=0), places.max(axis=0)
    border = max(BEYOND * (high - low).max(), AROUND * np.ptp(start, axis=0).max()) + 4
    left, top = np.maximum(low - border, 0).astype(int)
    right, bottom = np.minimum(high + border + 1, mask.shape[::-1]).astype(int)
    rows, columns = (x.reshape(-1) for x in np.mgrid[top:bottom, left:right])
    return rows, columns


def resting_places(
    pixels: Float[np.ndarray, "n 2"], cameras: Cameras, depth_m: DepthMap
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


def move(motion: Float[np.ndarray, "2 3"], pixels: np.ndarray) -> np.ndarray:
    """Return pixels moved by an affine transform of the image."""
    return pixels @ motion[:, :2].T + motion[:, 2]


def warp(mask: Mask, motion: Float[np.ndarray, "2 3"]) -> np.ndarray:
    """Return a mask moved by an affine transform of the image."""
    import cv2

    size = mask.shape[1], mask.shape[0]
    return cv2.warpAffine(mask.astype(np.uint8), motion, size, flags=cv2.INTER_NEAREST) > 0


def grown(mask: Mask, radius: int) -> Mask:
    """Return a mask with a border around it; the radius is in pixels."""
    import cv2

    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * radius + 1,) * 2, np.uint8)) > 0


def _cleaned(
    mask: UInt8[np.ndarray, "h w"], start: Float32[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "h w"]:
    """Return a mask without specks, gaps and parts without corners."""
    import cv2

    size = max(3, round(mask.shape[1] / 200) | 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    mask = cv2.morphologyEx(mask, cv2.MORPH_OPEN, kernel)
    mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel, iterations=2)
    mask = _at_corners(mask, start)
    # Notches: where the object has the color of the background, nothing shows that it moves.
    size = round(NOTCH * np.ptp(np.argwhere(mask), axis=0).max()) | 1 if mask.any() else 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    around = np.pad(mask, size)
    closed = cv2.morphologyEx(around, cv2.MORPH_CLOSE, kernel)
    return _filled(closed[size:-size, size:-size].copy())


def _compared(start: Float32[np.ndarray, "n 2"], motion: Float[np.ndarray, "f 2 3"]) -> list[int]:
    """Return frames to compare: half with the object far from its first place."""
    shift = np.linalg.norm(np.stack([move(m, start) for m in motion]) - start, axis=-1).mean(1)
    far = np.flatnonzero(shift >= min(0.5 * shift.max(), np.ptp(start, axis=0).max()))
    chosen = [
        some[np.linspace(0, len(some) - 1, COMPARED // 2).astype(int)]
        for some in (far, np.flatnonzero(shift >= TOLERANCE_PX))
    ]
    return np.unique(np.concatenate(chosen)).tolist()


def _change(colors: Colors, expected: Colors) -> Float32[np.ndarray, " n"]:
    """Return the changes of colors under the best light: shadows and exposure are no change."""
    light = (colors * expected).sum(axis=1) / np.maximum((colors**2).sum(axis=1), 1)
    light = np.clip(light, 1 / MAX_LIGHT, MAX_LIGHT)
    return np.abs(light[:, None] * colors - expected).max(axis=1)


def _medians(
    changes: Float32[np.ndarray, "w f n"],
) -> tuple[Float32[np.ndarray, "w n"], Bool[np.ndarray, "w n"]]:
    """Return medians over frames, `UNSEEN` where all are NaN, and True for the other ones."""
    count = np.isfinite(changes).sum(axis=1)
    ordered = np.sort(changes, axis=1)  # NaN last
    middle = np.maximum(count - 1, 0) // 2
    medians = np.take_along_axis(ordered, middle[:, None], axis=1)[:, 0]
    return np.where(count > 0, medians, np.float32(UNSEEN)), count > 0


def _alike(colors: Colors, others: Float32[np.ndarray, "m 3"]) -> Bool[np.ndarray, " n"]:
    """Return the colors that are like one of some others."""
    from scipy.spatial import KDTree

    if not len(colors) or not len(others):
        return np.zeros(len(colors), bool)
    some = others[:: max(1, len(others) // PALETTE)]
    return KDTree(some).query(colors, distance_upper_bound=MIN_CHANGE)[0] < MIN_CHANGE


def _look_up(
    image: RgbImage, hide: Mask, places: Float[np.ndarray, "n 2"]
) -> tuple[Float32[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Return the colors at places in an image, and True for places in view and not hidden."""
    height, width = hide.shape
    column, row = np.rint(np.nan_to_num(places, nan=-1)).astype(int).T
    seen = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    row, column = np.where(seen, row, 0), np.where(seen, column, 0)
    return image[row, column].astype(np.float32), seen & ~hide[row, column]


def _at_corners(
    mask: UInt8[np.ndarray, "h w"], start: Float32[np.ndarray, "n 2"]
) -> UInt8[np.ndarray, "h w"]:
    """Return the connected parts of a mask that have corners in or next to them."""
    import cv2

    _, parts = cv2.connectedComponents(mask)
    near = cv2.dilate(parts.astype(np.float32), np.ones((9, 9), np.uint8))
    column, row = np.rint(start).astype(int).T
    at = near[np.clip(row, 0, mask.shape[0] - 1), np.clip(column, 0, mask.shape[1] - 1)]
    numbers, count = np.unique(at[at > 0].astype(int), return_counts=True)
    return np.isin(parts, numbers[count >= 2]).astype(np.uint8)


def _filled(mask: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Return a mask without holes."""
    import cv2

    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(np.zeros_like(mask), outlines, -1, 1, cv2.FILLED)
