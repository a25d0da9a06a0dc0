"""Undistortion of frames, masks and pixels by the radial lens of a `CameraEstimate`.

A lens with focal length f and radial coefficient k maps a point (x, y, 1) to the recorded pixel
c + f (1 + k r²) (x, y), with r² = x² + y² and c the image center. The undistorted image has the
same size and center. Its focal length F is the smallest at which every pixel was recorded:
F = f (1 + k R² / F²), where R is the distance from the center to the corner (k > 0) or to the
nearest border (k < 0).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Shaped

from egosim_jax.data.readers import lenses
from egosim_jax.perception.video.estimates import CameraEstimate, Lens
from egosim_jax.types import InputError
from egosim_jax.types.arrays import Matrix


def pinhole_focal(lens: Lens, *, height: int, width: int) -> float:
    """Return the focal length of the undistorted frames, in pixels."""
    reach = np.hypot(height, width) / 2 if lens.radial > 0 else min(height, width) / 2
    focal = lens.focal_px
    for _ in range(60):  # fixed-point iteration for F
        focal = lens.focal_px * (1 + lens.radial * (reach / focal) ** 2)
    return float(focal)


def undistort(
    frames: Shaped[np.ndarray, "f h w *c"], estimate: CameraEstimate
) -> Shaped[np.ndarray, "f h w *c"]:
    """Return undistorted frames, as the cameras of an estimate see them.

    Masks are resampled by nearest pixel. Frames are unchanged if the estimate has no lens.
    """
    if estimate.lens is None or estimate.cameras is None:
        return frames
    import cv2

    cameras, lens = estimate.cameras, estimate.lens
    if frames.shape[1:3] != (cameras.height, cameras.width):
        raise InputError(
            f"Frames of {frames.shape[2]} x {frames.shape[1]} pixels cannot be undistorted by "
            f"cameras of {cameras.width} x {cameras.height}: the sizes must be the same."
        )
    rows, columns = np.mgrid[: cameras.height, : cameras.width].astype(np.float64)
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    rays = pixels @ np.linalg.inv(cameras.intrinsics_px).T
    recorded = _model(lens, cameras.intrinsics_px).project(rays).astype(np.float32)
    columns, rows = recorded[..., 0].copy(), recorded[..., 1].copy()
    image = frames.dtype == np.uint8 and frames.ndim == 4
    method = cv2.INTER_LINEAR if image else cv2.INTER_NEAREST
    source = frames.astype(np.uint8) if frames.dtype == bool else frames
    remapped = [
        cv2.remap(f, columns, rows, method, borderMode=cv2.BORDER_REPLICATE) for f in source
    ]
    return np.stack(remapped).reshape(frames.shape).astype(frames.dtype)


def undistort_pixels(
    pixels_px: Float[np.ndarray, "*b 2"], estimate: CameraEstimate
) -> Float[np.ndarray, "*b 2"]:
    """Return the places of recorded pixels in undistorted frames; NaN stays NaN."""
    if estimate.lens is None or estimate.cameras is None:
        return pixels_px
    return to_pinhole(pixels_px, estimate.lens, estimate.cameras.intrinsics_px)


def to_pinhole(
    pixels_px: Float[np.ndarray, "*b 2"], lens: Lens, intrinsics_px: Matrix
) -> Float[np.ndarray, "*b 2"]:
    """Return the places of recorded pixels in a pinhole camera with the same center."""
    rays = _model(lens, intrinsics_px).unproject(pixels_px.reshape(-1, 2))
    return rays.reshape(pixels_px.shape) * intrinsics_px[0, 0] + intrinsics_px[:2, 2]


def _model(lens: Lens, intrinsics_px: Matrix) -> lenses.Lens:
    """Return the lens of the recorded frames; it shares the pinhole camera's center."""
    recorded = intrinsics_px.astype(float).copy()
    recorded[[0, 1], [0, 1]] = lens.focal_px
    height, width = (round(2 * center + 1) for center in intrinsics_px[[1, 0], 2])
    return lenses.Lens(
        model="brown",
        coefficients=(lens.radial, 0.0, 0.0, 0.0, 0.0),
        intrinsics_px=recorded,
        height=height,
        width=width,
    )
