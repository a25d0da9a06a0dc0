"""Initial scene state from one RGB-D image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from egosim_jax.geometry import pixel_rays, transform, upsample_intrinsics
from egosim_jax.types import InputError, SceneState, check_counts

DEPTH_M = (0.05, 50.0)
"""Minimum and maximum median depth, in meters."""
EDGE = 0.03
"""Maximum relative change of depth by interpolation; beyond it, a pixel keeps its own depth."""


@no_type_check  # shapes and dtypes are checked with messages for users
def state_from_depth(
    image: UInt8[np.ndarray, "_ _ 3"],
    depth_m: Float[np.ndarray, "h w"],
    intrinsics_px: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
    *,
    object_ids: Int[np.ndarray, "_ _"] | None = None,
    names: Mapping[int, str] | None = None,
    points_per_pixel: int = 1,
) -> SceneState:
    """Return the state of one RGB-D image without hands: points of the pixels with known depth.

    Depth is in meters along the camera's z axis; 0, NaN and infinity mean unknown. Pixel centers
    are at integer coordinates. Without `object_ids` all points are background. Each pixel gives
    `points_per_pixel` squared points, interpolated: a camera that moves nearer by this factor sees
    no gaps. Raises `InputError` if shapes or dtypes differ, if no depth is known, or if the depth
    does not look like meters.
    """
    check_counts({"points_per_pixel": points_per_pixel})
    for name, value, rule, fits in (
        ("depth_m", depth_m, "(height, width)", np.ndim(depth_m) == 2),
        (
            "image",
            image,
            "uint8 (height, width, 3)",
            np.ndim(image) == 3 and image.shape[2] == 3 and image.dtype == np.uint8,
        ),
    ):
        if not fits:
            raise InputError(f"{name} is {value.dtype} {value.shape}: it must be {rule}.")
    height, width = depth_m.shape
    shapes = {"image": image.shape[:2]}
    if object_ids is not None:
        shapes["object_ids"] = object_ids.shape
    for name, shape in shapes.items():
        if shape != (height, width):
            raise InputError(
                f"{name} is {shape[1]}x{shape[0]} and depth_m is {width}x{height} pixels: they "
                "must have the same size. Resize one of them."
            )
    known = np.isfinite(depth_m) & (depth_m > 0)
    if not known.any():
        raise InputError(
            "depth_m has no positive finite value: at least one pixel must have depth."
        )
    median = float(np.median(depth_m[known]))
    if not DEPTH_M[0] <= median <= DEPTH_M[1]:
        raise InputError(
            f"The median depth is {median:.4g}: in meters it must be from {DEPTH_M[0]} to "
            f"{DEPTH_M[1]}. Convert depth_m to meters (millimeters / 1000)."
        )
    ids = np.zeros(depth_m.shape, np.int32) if object_ids is None else object_ids
    matrix = upsample_intrinsics(np.asarray(intrinsics_px, float), points_per_pixel)
    if points_per_pixel > 1:
        image, depth_m, known, ids = _split(image, depth_m, known, ids, points_per_pixel)
    rays = pixel_rays(matrix, height=depth_m.shape[0], width=depth_m.shape[1])[known]
    points = transform(world_from_camera, rays * depth_m[known][:, None])
    return SceneState(
        points_m=points.astype(np.float32),
        colors=image[known],
        object_ids=ids[known].astype(np.int32),
        last_seen=np.zeros(len(points), np.int32),
        intrinsics_px=intrinsics_px,
        names=dict(names or {}),
        provenance={"source": "depth image"},
    )


def _split(
    image: UInt8[np.ndarray, "h w 3"],
    depth_m: Float[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    ids: Int[np.ndarray, "h w"],
    times: int,
) -> tuple[
    UInt8[np.ndarray, "r c 3"],
    Float[np.ndarray, "r c"],
    Bool[np.ndarray, "r c"],
    Int[np.ndarray, "r c"],
]:
    """Return an RGB-D image with each pixel split into `times` x `times`.

    Inverse depth, which is affine on planes, is interpolated between known pixels. At an edge that
    would make points between two surfaces, so a pixel there keeps its own depth.
    """
    import cv2

    height, width = depth_m.shape
    size = times * width, times * height
    inverse = np.where(known, 1 / np.where(known, depth_m, 1), 0).astype(np.float64)
    weight, total = (
        cv2.resize(x, size, interpolation=cv2.INTER_LINEAR)
        for x in (known.astype(np.float64), inverse)
    )
    own, known, ids = (
        np.repeat(np.repeat(x, times, axis=0), times, axis=1) for x in (inverse, known, ids)
    )
    between = total / np.maximum(weight, 1e-12)
    smooth = np.abs(between - own) <= EDGE * own
    with np.errstate(divide="ignore"):
        fine = 1 / np.where(smooth, between, own)
    return cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), fine, known, ids
