"""Clean plate: the first frame without hands.

Each pixel behind a hand comes from the nearest frame in time that sees the same scene point. That
frame must also look alike around the point, and nothing that a hand moves may be there. So an
object that a hand moves later stays at its first place; a temporal median would erase it. Pixels
that no frame shows are inpainted with patches of the background (PatchMatch; Barnes et al. 2009),
or by Telea's method if that library is not installed. Moved objects are never copied.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from egosim_jax.geometry import invert, pixel_rays, project, transform
from egosim_jax.types import Cameras
from egosim_jax.types.arrays import DepthMap, Mask, Masks, Points, RgbImage, Vector, Video

Inpainter = Literal["patchmatch", "telea", "none"]
"""Inpainting method for the pixels that no frame shows."""
PATCH = 5
"""Radius of the compared patches in pixels."""
RING_PX = 7
"""Width of the ring around the hidden pixels that is compared, in pixels."""
AROUND = 0.08
"""Radius in image widths of the comparison of another frame with the first one."""
MAX_DIFFERENCE = 40
"""Maximum difference of pixels that look alike, in 8-bit levels."""
MIN_AGREEMENT = 0.7
"""Minimum fraction of pixels that look alike around a pixel from another frame."""
MAX_GAIN = 1.25
"""Maximum brightness factor between two frames."""


@no_type_check
@dataclass(frozen=True, kw_only=True)
class CleanPlate:
    """First frame without hands."""

    image: UInt8[np.ndarray, "h w 3"]
    seen: Bool[np.ndarray, "h w"]
    """Hidden pixels that other frames show."""
    method: Inpainter
    """Inpainting method of the other hidden pixels; `none` if there are no others."""


def clean_plate(
    frames: Video,
    moving: Masks,
    cameras: Cameras,
    depth_m: DepthMap,
    *,
    moved: Masks | None = None,
    margin_px: int = 3,
) -> CleanPlate:
    """Return the first frame with its `moving` pixels replaced by the scene behind them.

    `depth_m` is the first frame's depth in the unit of the cameras, completed behind the hands. A
    pixel of unknown depth is inpainted. `moved` are the pixels of objects that hands move: they
    stay in the first frame, and nothing is taken from them. Both masks are widened by a margin.
    """
    import cv2

    margin = np.ones((2 * margin_px + 1,) * 2, np.uint8)
    hide = np.stack([cv2.dilate(m.astype(np.uint8), margin) for m in moving]) > 0
    image, missing = frames[0].copy(), hide[0].copy()
    carried = np.zeros_like(missing)
    if moved is not None:
        carried = cv2.dilate(moved[0].astype(np.uint8), margin) > 0
        hide[1:] |= np.stack([cv2.dilate(m.astype(np.uint8), margin) > 0 for m in moved[1:]])
    ring = cv2.dilate(missing.astype(np.uint8), np.ones((2 * RING_PX + 1,) * 2, np.uint8)) > 0
    rows, columns = np.nonzero(ring & np.isfinite(depth_m))
    rays = pixel_rays(cameras.intrinsics_px, height=cameras.height, width=cameras.width)
    points = transform(
        cameras.world_from_camera[0], rays[rows, columns] * depth_m[rows, columns][:, None]
    )
    for frame in range(1, len(frames)):
        wanted = missing[rows, columns]
        if not wanted.any():
            break
        colors, free = _look_up(frames[frame], hide[frame], cameras, frame, points)
        border = free & ~(hide[0] | carried)[rows, columns]
        gain = _gain(image[rows, columns][border], colors[border])
        alike = _agreement(image, colors * gain, rows, columns, border)
        taken = free & wanted & (alike >= MIN_AGREEMENT)
        image[rows[taken], columns[taken]] = np.clip(colors[taken] * gain + 0.5, 0, 255)
        missing[rows[taken], columns[taken]] = False
    image, method = _inpaint(image, missing, carried & ~missing)
    return CleanPlate(image=image, seen=hide[0] & ~missing, method=method)


def _look_up(
    image: RgbImage, hide: Mask, cameras: Cameras, frame: int, points: Points
) -> tuple[Points, Bool[np.ndarray, " n"]]:
    """Return the colors of points in a frame, and True for those in view and not hidden."""
    import cv2

    local = transform(invert(cameras.world_from_camera[frame]), points)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (x.astype(np.float32) for x in project(cameras.intrinsics_px, local))
        free = (local[:, 2] > 0) & (u >= 0) & (v >= 0)
        free &= (u <= cameras.width - 1) & (v <= cameras.height - 1)
    u, v = np.where(free, u, 0), np.where(free, v, 0)
    colors = _sample(image, u, v, cv2.INTER_LINEAR)
    free &= _sample(hide.astype(np.uint8), u, v, cv2.INTER_NEAREST) == 0
    return colors.astype(float), free


def _sample(image: np.ndarray, u: np.ndarray, v: np.ndarray, method: int) -> np.ndarray:
    """Return the values of an image at some pixels."""
    import cv2

    width = 1024  # in rows: OpenCV limits the length of one side
    missing = -len(u) % width
    u, v = (np.pad(x, (0, missing)).reshape(-1, width) for x in (u, v))
    values = cv2.remap(image, u, v, method, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(-1, *image.shape[2:])[: values.shape[0] * width - missing]


def _gain(here: np.ndarray, there: np.ndarray) -> Vector:
    """Return the factor of each channel that equalizes the brightness of two views."""
    if len(here) < 50:
        return np.ones(3)
    ratio = np.median(here.astype(float) + 1, axis=0) / np.median(there + 1, axis=0)
    return np.clip(ratio, 1 / MAX_GAIN, MAX_GAIN)


def _agreement(
    image: RgbImage,
    colors: Points,
    rows: Int[np.ndarray, " n"],
    columns: Int[np.ndarray, " n"],
    border: Bool[np.ndarray, " n"],
) -> Float[np.ndarray, " n"]:
    """Return the fraction of visible pixels around each pixel that look alike in both frames.

    Where it is low, an object has moved, and the other frame does not show the first one's scene.
    """
    import cv2

    size = 2 * round(AROUND * image.shape[1]) + 1
    counts = np.zeros((2, *image.shape[:2]), np.float32)
    difference = np.abs(colors - image[rows, columns]).max(axis=1)
    counts[0][rows[border], columns[border]] = difference[border] < MAX_DIFFERENCE
    counts[1][rows[border], columns[border]] = 1
    total = counts.sum(axis=(1, 2)) / max(counts[1].sum(), 1)  # for pixels far from the border
    counts += 1e-6 * total[:, None, None]
    alike, seen = (cv2.blur(c, (size, size), borderType=cv2.BORDER_CONSTANT) for c in counts)
    return (alike / np.maximum(seen, 1e-9))[rows, columns].astype(float)


def _inpaint(image: RgbImage, missing: Mask, excluded: Mask) -> tuple[RgbImage, Inpainter]:
    """Return the inpainted image and the name of the method; `excluded` pixels are no source."""
    if not missing.any():
        return image, "none"
    try:
        from patchmatch import patch_match
    except ImportError:
        import cv2

        hole = (missing | excluded).astype(np.uint8)
        filled = cv2.inpaint(image, hole, PATCH, cv2.INPAINT_TELEA)
        return np.where(missing[..., None], filled, image), "telea"
    hole, ignored = (mask[..., None].astype(np.uint8) for mask in (missing, excluded))
    return patch_match.inpaint(image, hole, global_mask=ignored, patch_size=PATCH), "patchmatch"
